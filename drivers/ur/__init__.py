"""The UR arm: `UrRobot` in the daemon's loop, ur-rtde in a process of its own behind a small typed pipe.

client.py    the daemon's end: starts the process, sends commands, keeps the latest state, starts it again
messages.py  what crosses the pipe
child.py     the process: 125 cycles a second, an alarm before everything that may hang
pilot.py     what is sent and what is refused, without I/O; limits.py and recovery.py are its two hard parts
arm.py       ur-rtde itself
"""
