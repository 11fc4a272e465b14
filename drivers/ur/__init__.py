"""The UR arm: `client.UrRobot` in the daemon's event loop, and ur-rtde in a worker process behind a pipe."""
