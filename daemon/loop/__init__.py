"""The closed loop: what is sensed, what is wrong, what the wrist does about it. Only `task` has I/O."""
