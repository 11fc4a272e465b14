"""A Robotiq 2F-140, played: one gripper behind two faces, the URCap's socket and Modbus RTU."""
