"""The tasks that read sensors and estimate: fingertips, shear skin, load cell.

`sessions` opens the fingertips' files. `fingertip_boards` reads boards, `frame_pairing` pairs their frames,
`fingertip_task` estimates, and `fingertip_messages` has what it publishes. `skin_task` and `skin_estimator` are
the shear skin's, `load_cell_task` the load cell's. `snapshots` keeps states, so that a recording can begin in
the middle of a run.
"""
