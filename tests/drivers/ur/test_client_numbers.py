"""What ur-rtde's client writes for each call of our driver, while the emulated controller plays our script."""

import asyncio
import sys

import pytest

from shearloop.drivers.ur.script import UPPER
from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import DELIVERED, control_script
from tests.emulator_process import own_address

pytestmark = pytest.mark.real_time

HOST = own_address(3)
# Each call once, with the flags of `UrArm`; a client that reads another state than it waits for would wait for minutes.
# The program runs before the client connects, which waits for the robot's first state.
CALLS = """
import os, sys
import rtde_control
kind = rtde_control.RTDEControlInterface
client = kind(sys.argv[1], 125.0, int(kind.FLAG_NO_WAIT) | int(kind.FLAG_UPPER_RANGE_REGISTERS))
assert client.isProgramRunning()
pose = [float(value) for value in sys.argv[2].split(",")]
answers = [
    client.setWatchdog(5.0),
    client.zeroFtSensor(),
    client.speedJ([0.0, 0.0, 0.0, 0.0, 0.0, 0.1], 4.0, 0.0),
    client.speedStop(4.0),
    client.moveL(pose, 0.05, 0.5, asynchronous=True),
]
client.stopJ(4.0, asynchronous=True)
answers.append(client.kickWatchdog())
client.stopScript()
print(all(answers), flush=True)
os._exit(0)
"""
# The values of the last package are written too; arguments come before the command's number.
EXPECTED = [
    (robots.SET_WATCHDOG, (5.0,)),
    (robots.ZERO_FT, ()),
    (robots.SPEED_J, (0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 4.0, 0.0)),
    (robots.SPEED_STOP, (4.0,)),
    (robots.MOVE_L, None),
    (robots.STOP_J, (4.0,)),
    (255, ()),
]


class WatchedRobot(Robot):
    """A robot that notes each command that a client writes, with its numbers; its watchdog waits for the first."""

    def __init__(self) -> None:
        super().__init__()
        self.commands: list[tuple[int, list[float]]] = []
        write = self.registers.write

        def note(name: str, value: float, now_s: float) -> None:
            write(name, value, now_s)
            if name == UPPER.command and value != 0:
                numbers = [self.registers[f"input_double_register_{UPPER.first + index}"] for index in range(8)]
                self.commands.append((int(value), numbers))

        self.registers.write = note

    def step(self, dt_s: float) -> None:
        if not self.commands:
            self.registers.written_s[UPPER.command] = self.time_s
        super().step(dt_s)


async def let_time_pass(controller: Controller) -> None:
    async for _ in controller.run():
        pass


async def test_the_client_writes_the_numbers_that_the_script_knows():
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    robot = WatchedRobot()
    x, y, z, *turned = map(float, robot.arm.pose)
    pose = (x, y, z - 0.1, *turned)
    controller = Controller(robot, host=HOST)
    async with controller.open(), asyncio.timeout(20), asyncio.TaskGroup() as tasks:
        robot.upload(control_script(DELIVERED))
        time = tasks.create_task(let_time_pass(controller))
        client = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CALLS, HOST, ",".join(map(str, pose)), stdout=asyncio.subprocess.PIPE
        )
        said, _ = await client.communicate()
        time.cancel()
    assert said.endswith(b"True\n")
    assert [command for command, _ in robot.commands] == [command for command, _ in EXPECTED]
    for (_, numbers), (command, expected) in zip(robot.commands, EXPECTED, strict=True):
        wanted = (*pose, 0.05, 0.5) if command == robots.MOVE_L else expected
        assert numbers[: len(wanted)] == pytest.approx(list(wanted))
    assert not robot.program_running
