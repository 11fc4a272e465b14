"""The Robotiq grippers 2F-85, 2F-140 and Hand-E: the URCap's socket on the controller, or Modbus RTU on USB."""
