"""The driver beside the played gripper, by both ways in: real socket and real pseudo-terminal, real pymodbus.

Model time runs as fast as the loop turns, but stands still while a busy machine keeps the driver waiting for an answer;
the driver is given the same clock.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import pytest

from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.modbus_client import ModbusClient
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.emulators.gripper import Gripper, ModbusSlave, UrcapSession
from shearloop.emulators.ports import PtyServer, Server, SocketServer
from tests.running import LinkEvents

STEP_S = 0.01
# Between two looks of the driver at its clock.
MAX_STEPS = 20
CALIBRATION = WidthCalibration(open_counts=3.0, open_mm=140.0, closed_counts=230.0, std_mm=0.4)
WAYS = pytest.mark.parametrize("way", ["socket", "modbus"])


@dataclass
class Rig:
    model: Gripper
    server: Server
    t_s: float = 0.0
    steps_left: int = MAX_STEPS
    stopped: bool = False
    driver: RobotiqGripper = field(init=False)
    link: LinkEvents = field(default_factory=LinkEvents)

    def monotonic_ns(self) -> int:
        self.steps_left = MAX_STEPS
        return round(self.t_s * 1e9)

    def silence(self, silent: bool) -> None:
        self.server.command("silence" if silent else "normal")


@contextlib.asynccontextmanager
async def a_rig(
    way: str, tmp_path: Path, *, connected: bool = False, active: bool = False, reply_deadline_s: float = 20.0
) -> AsyncIterator[Rig]:
    """A gripper and its driver; `reply_deadline_s` is long, because a busy computer delays replies."""
    model = Gripper()
    if way == "socket":
        server = SocketServer(UrcapSession(model))
        await server.restore()
        client = SocketClient("127.0.0.1", server.port, reply_deadline_s=reply_deadline_s)
    else:
        link = tmp_path / "gripper"
        server = PtyServer(ModbusSlave(model), link)
        await server.restore()
        client = ModbusClient(path=str(link), reply_deadline_s=reply_deadline_s)
    rig = Rig(model, server)
    monitor = LinkMonitor(rig.link, 0.001, 0.002)
    driver = rig.driver = RobotiqGripper(client, CALIBRATION, poll_s=0.0, monitor=monitor)

    async def pass_time() -> None:
        while True:
            if not rig.stopped and rig.steps_left > 0:
                rig.steps_left -= 1
                model.step(STEP_S)
                rig.t_s += STEP_S
            await asyncio.sleep(0)

    tasks = [asyncio.create_task(pass_time()), asyncio.create_task(server.run())]
    try:
        with patch("shearloop.drivers.robotiq.gripper.time", rig):
            if connected or active:
                await driver.connect()
            if active:
                await driver.activate(may_drop=True)
            yield rig
    finally:
        await driver.close()
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
