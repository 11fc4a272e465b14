"""What a person runs by hand, beside the daemon.

At the desk: recordings, calibrations, evaluation, checks of files. At the rig: `doctor` examines the devices,
`commission` moves the real robot and the gripper, and `service.py` installs the daemon on this computer.
"""
