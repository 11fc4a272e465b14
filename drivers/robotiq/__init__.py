"""The Robotiq grippers 2F-85, 2F-140 and Hand-E: the URCap's socket on the controller, or Modbus RTU on USB.

`gripper` activates, moves and reads one over `socket_client` or `modbus_client`; `widths` has its width. `models` has
the makers' data, `messages` the registers' meaning, and `requests` finds requests of other programs.
"""
