"""The UR arm: `client.UrRobot` in the daemon's event loop, and ur-rtde in a worker behind a pipe.

In the daemon: `client` runs the worker, `settings` has limits and deadlines, `messages` passes between both. In
the `worker`: `command_handler` accepts or refuses commands, `motion` keeps one within the `limits`, `arm` calls
ur-rtde. With the controller: `ports` connects, `rtde` has the packages and `receiver` the samples, whose age is
`sample_age`'s; `dashboard` asks for modes and power, `control_box` for version and mode, and `primary_port` for error
codes. `script` makes the program of `control.script`, which runs on the robot, `script_port` sends it, and
`script_readiness` waits for it between two commands.
"""
