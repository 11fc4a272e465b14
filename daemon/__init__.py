"""The daemon on the robot's PC: configuration, tasks, control loop, safety, messages, recorder, live page."""
