"""A UR controller for the real ur-rtde client: RTDE on 30004, control scripts on 30003, dashboard on 29999.

Run it in a process of its own (`shearloop emulate ur`): the client's constructors hold the interpreter lock while they
wait for answers.
"""
