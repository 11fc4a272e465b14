"""The closed loop: what is sensed, what is wrong, what the wrist does about it. No I/O: `daemon/loop_task.py` has it."""
