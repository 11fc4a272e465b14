"""The UR arm: `client.UrRobot` in the daemon's event loop, and ur-rtde in a worker behind a pipe.

The daemon: `client` runs the worker, `settings` has limits and deadlines, and `messages` are what passes between both.

The worker: `worker` is its loop. `command_handler` accepts or refuses commands by the robot's `fitness`, `recovery`
makes the robot ready, `motion` keeps one motion within the `limits`, and `arm` calls ur-rtde.

The controller: `ports` connects. `rtde` has the packages, `receiver` the samples, and `sample_age` their age.
`dashboard` asks for modes and power, `control_box` for version and mode, and `primary_port` receives error codes.

The program on the robot: `script` makes it of `control.script`, `script_port` sends it, and `script_readiness` waits
for it between two commands.
"""
