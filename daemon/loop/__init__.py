"""The closed loop: what is sensed, what is wrong, what the wrist does about it. Its I/O is in `daemon/loop_task.py`."""
