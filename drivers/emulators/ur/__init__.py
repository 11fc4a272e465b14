"""A UR controller for the real ur-rtde client: RTDE on 30004, control scripts on 30003, dashboard on 29999.

It has to be a process of its own (`shearloop emulate ur`): the client's constructors hold the interpreter lock while
they wait for answers, so that a controller in the same process would never get to give them.
"""
