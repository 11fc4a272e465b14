"""A controller that is no emulated one, at an address of this computer: a rig with `emulated: true` leaves it alone."""

import asyncio
import sys
from io import StringIO
from pathlib import Path

import pytest

from shearloop.cli import main
from shearloop.daemon.config import load_daemon_config
from shearloop.tools.doctor.devices import check_devices
from tests.emulator_process import EmulatorProcess
from tests.fixtures.daemons import ask, collector, robot_at, running_daemon

SERIAL_NUMBER = "20195500123"
REFUSED = f"its serial number is {SERIAL_NUMBER}, not EMULATED; take `emulated` out for a real robot"

pytestmark = [pytest.mark.usefixtures("ur_rtde"), pytest.mark.real_time]


@pytest.fixture
def tunnel():
    """Play what a tunnel to a real controller shows: a serial number of its own at a loopback address."""
    controller = EmulatorProcess("ur", "--serial-number", SERIAL_NUMBER, module=7, ready="listening")
    yield controller
    assert controller.close() == 0


@pytest.fixture
def emulated(config, tunnel, tmp_path) -> Path:
    """A configuration that calls the rig behind the tunnel emulated."""
    robot_at(tunnel.host, tmp_path)
    return config(robot="ur.yaml", emulated=True)


async def test_an_emulated_daemon_neither_drives_a_real_controller_nor_sends_it_a_program(emulated, tunnel):
    async with running_daemon(emulated) as daemon:
        health = collector(daemon, "health")
        while not (robot := (await health.get())["tasks"]["robot"]).get("error"):
            continue
        assert REFUSED in robot["error"]
        assert not robot["connected"]
        reply = await ask(daemon, "unlock")
        assert (reply["ok"], REFUSED in reply["reason"]) == (False, True)
        # A later attempt would be told too; there is none.
        assert robot["errors"] == {"not-emulated": 1}
    await tunnel.ask("normal", "obeyed")
    assert [event for event in tunnel.events if event["event"].startswith(("program", "motion"))] == []


def test_an_emulated_commissioning_does_not_begin_on_a_real_controller(emulated, monkeypatch, mistake):
    monkeypatch.setattr(sys, "stdin", StringIO(""))
    assert REFUSED in mistake("commission", emulated, "--out", emulated.with_name("report.yaml"))


def test_the_doctor_reports_a_real_controller_in_an_emulated_rig(emulated, tunnel):
    async def found(path: Path) -> list[str]:
        findings = await check_devices(load_daemon_config(path), 0.1)
        return [
            f"{one.found}; {one.next_step}" for one in findings if one.subject == "robot" and one.state == "trouble"
        ]

    (said,) = asyncio.run(found(emulated))
    assert REFUSED in said
    real = emulated.with_name("real.yaml")
    real.write_text(emulated.read_text().replace("emulated: true", "emulated: false"))
    assert asyncio.run(found(real)) == [], "it is refused as an emulated one alone"
    assert main(["check", str(real)]) == 0
    assert tunnel.process.poll() is None
