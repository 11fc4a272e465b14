"""How long whoever sends a command waits for the daemon's answer."""

# A daemon that lives gives it in some milliseconds.
COMMAND_TIMEOUT_S = 2.0
# The robot may have to be powered, its brakes released and its program started, and the gripper activated.
UNLOCK_TIMEOUT_S = 60.0
