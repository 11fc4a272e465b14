"""The closed loop: experiment, controllers, safety and the tasks that run them.

`experiment_schema` and `experiment` turn a YAML file into commands; `step_motions` and `step_demands` say what each
step moves and needs, for the operator's questions and the plan; `known_tool` has what is known of the tool after each
step, and `turns` which way each one turns it. `control_loop` decides at every robot state on a
`ControlOutput`, from `inputs`, `creep`, `fault_detection` with `safety`, and `wrist_controller` with
`torque_controller`. `identification` measures the tool; `margins` refuses unstable controllers. The others do I/O:
`loop_runner` takes the robot's states and carries out each output, `command_sender` sends wrist speeds,
`action_executor` grips and tares, `straight_moves` moves the arm, `operator_action` unlocks and releases,
`gripper_task` has the gripper, `state_publisher` publishes.
"""
