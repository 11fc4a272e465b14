"""What runs on the robot's PC all day: configuration, tasks, control loop, safety, messages, recorder, live page."""
