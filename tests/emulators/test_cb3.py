"""The emulated CB3 differs from an e-Series as a real one does."""

import asyncio
import dataclasses

import numpy as np
import pytest

from shearloop.drivers.ur import settings as ur
from shearloop.drivers.ur.dashboard import ask_dashboard
from shearloop.emulators.ur_arm import CURRENTS_ERROR
from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import ControllerSpec, Robot
from tests.drivers.ur.robots import DELIVERED, control_script, send
from tests.emulator_process import own_address

CB3 = ControllerSpec(version=(3, 15, 8, 0))
LIMITS = dataclasses.replace(DELIVERED.limits, force_n=ur.ForceBound(40.0, 60.0), torque_nm=ur.TorqueBound(8.0, 12.0))
SETTINGS = dataclasses.replace(DELIVERED, limits=LIMITS, generation="cb3")
STEP_S, SPEED_J = 0.008, 9
HOST = own_address(7)


def steps(robot: Robot, number: int) -> Robot:
    for _ in range(number):
        robot.step(STEP_S)
    return robot


def test_our_script_runs_on_it_and_turns_the_wrist():
    robot = Robot(CB3)
    robot.upload(control_script(SETTINGS))
    steps(robot, 5)
    for _ in range(20):
        until = robot.registers["output_int_register_47"] + 12
        robot.registers.write("input_int_register_47", until, robot.time_s)
        send(robot, SPEED_J, 0, 0, 0, 0, 0, 0.2, 4.0, 0)
        steps(robot, 1)
    assert robot.program_running
    assert robot.arm.qd_rad_per_s[5] == pytest.approx(0.2)


@pytest.mark.parametrize("function", ["zero_ftsensor()", "write_output_float_register(0, get_steptime())"])
def test_functions_of_the_e_series_end_a_program(function):
    text = f"def a():\n  {function}\n  while (True):\n    sync()\n  end\nend\n"
    for robot, goes_on in ((Robot(), True), (Robot(CB3), False)):
        robot.upload(text)
        assert steps(robot, 3).program_running == goes_on


def test_a_program_that_starts_changes_no_zero_and_the_wrench_has_the_errors_of_currents():
    robot = Robot(CB3)
    robot.arm.load[:] = 3.0
    robot.upload("def a():\n  while (True):\n    sync()\n  end\nend\n")
    found = []
    for _ in range(500):
        steps(robot, 1)
        found.append(robot.arm.wrench - 3.0)
    assert (np.abs(found) <= CURRENTS_ERROR).all()
    assert (np.abs(found).max(axis=0) > 0.9 * CURRENTS_ERROR).all()
    assert np.linalg.norm(np.array(found)[:, :3], axis=1).max() <= 10.0
    assert np.linalg.norm(np.array(found)[:, 3:], axis=1).max() <= 5.0


async def test_its_dashboard_knows_no_remote_control():
    request = "is in remote control"
    for spec, answer in ((ControllerSpec(), "true"), (CB3, f"could not understand: '{request}'")):
        async with Controller(Robot(spec), host=HOST).open():
            assert await asyncio.to_thread(ask_dashboard, HOST, 5.0, (request,)) == [answer]
