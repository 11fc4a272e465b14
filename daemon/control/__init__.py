"""The closed loop: experiment, controllers, safety and the tasks that run them.

`experiment_schema` and `experiment` turn a YAML file into commands. `control_loop` decides at every robot state, from
`loop_inputs`, `fault_detection` with `safety`, and `wrist_controller` with `torque_controller`. `identification`
measures the tool; `margins` refuses unstable controllers. `loop_runner` connects the loop to the robot, and to the
gripper by `gripper_task`; only these two do I/O.
"""
