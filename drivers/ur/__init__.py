"""The UR arm: `client.UrRobot` in the daemon's event loop, and ur-rtde in a worker behind a pipe.

In the daemon: `client` runs the worker, `settings` has limits and deadlines, `messages` passes between both. In
the `worker`: `command_handler` accepts or refuses commands, `motion` keeps one within the limits, `arm` calls
ur-rtde. With the controller: `control_box` probes and receives states, `script` makes the program of
`control.script`, which runs on the robot, and `script_port` sends it, `primary_port` reads error codes.
"""
