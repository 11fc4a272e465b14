"""An emulated Robotiq 2F-140 behind the URCap's socket or Modbus RTU."""
