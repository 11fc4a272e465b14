"""The Robotiq 2F-140 gripper, by the URCap's socket on the robot's controller or by Modbus RTU over USB.

`gripper.RobotiqGripper` is the gripper; `socket_client.SocketClient` and `modbus_client.ModbusClient` are the two ways
to it. Protocol facts are from Robotiq's instruction manual of the 2F-85 and 2F-140, chapter 4 (control), and from
what clients of the URCap's socket rely on.
"""
