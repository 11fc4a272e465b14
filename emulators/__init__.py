"""The devices of `drivers`, played byte for byte over real pseudo-terminals and sockets.

`boards`, `skin`, `gripper` and `ur_robot` play one device each, over `ports`. `scene` has
the physics that they share; `emulated_rig` plays them all together.
"""
