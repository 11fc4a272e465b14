"""The Robotiq 2F-140 gripper, over the URCap's socket on the robot's controller or over Modbus RTU on USB."""
