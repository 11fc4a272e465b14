"""The tasks that read sensors and estimate: fingertips, shear skin, load cell.

`sessions` opens the fingertips' files. `fingertip_boards` reads boards, `frame_pairing` pairs their frames,
`fingertip_task` estimates, and `fingertip_messages` makes the messages. `skin_task` and `skin_estimator` serve
the shear skin, `load_cell_task` serves the load cell. `zero_request` is a zero that was asked of any of them.
For a replay, the recorder stores what comes before a frame by `session_inputs`, and states by `snapshots`, so that a
recording can begin in the middle of a run.
"""
