"""The UR arm: `client.UrRobot` in the daemon's event loop, and ur-rtde in a worker process behind a pipe.

In the daemon: `client` runs the worker, `settings` has limits and deadlines, `messages` passes between both. In
the `worker`: `command_handler` accepts or refuses commands, `motion` keeps one within the limits, `arm` calls
ur-rtde. With the controller: `control_box` probes and receives states, `script` and `script_port` upload the
control program, `primary_port` reads error codes.
"""
