"""Recordings at the desk; `daemon/recorder` writes them.

Read: `reader` opens closed files, `intact_records` damaged ones; `tables` and `frames` give arrays; `summary`
and `listing` give numbers. Mend: `repair`. Play: `replay`, `replayed_skin`. Bring out: `export`, `lerobot_export`,
`rerun_export`, `slice_export`. Bring in: `matlab_import`.
"""
