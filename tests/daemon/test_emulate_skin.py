"""The skin's emulators as processes of their own, met by the real drivers; and the skin on the emulated rig."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from shearloop.bank.skin.membrane import THICK_SECTION, UNSTRETCHED, Membrane
from shearloop.daemon.cli.emulate.rig import PushedSkin
from shearloop.daemon.synthetic_skin import NORMAL_N, SLACK_RATIO, SyntheticSkin
from shearloop.drivers.connection import Link, SerialLink, TcpLink
from shearloop.drivers.emulators.gripper import GripperRegisters
from shearloop.drivers.emulators.rig import EmulatedRig, RigSettings
from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, ScpiScanner
from shearloop.drivers.shear_skin.skin import ShearSkin, SkinFault, SkinSample
from tests.daemon.conftest import DEADLINE_S, shearloop
from tests.daemon.emulate_rig.test_mistakes import Blank
from tests.running import pass_on, running

SPEED = 20


async def line(process: asyncio.subprocess.Process) -> str:
    return (await process.stdout.readline()).decode().strip()


async def told(process: asyncio.subprocess.Process, command: str) -> None:
    process.stdin.write(f"{command}\n".encode())
    await process.stdin.drain()


def tcp(address: str) -> Link:
    host, port = address.split(":")
    return TcpLink(host, int(port))


@asynccontextmanager
async def read(source: Link, daq: Daq) -> AsyncIterator["asyncio.Queue[SkinSample]"]:
    skin, queue = ShearSkin(Keithley6430(source, period_s=0.05), daq), asyncio.Queue[SkinSample]()

    async with running(skin.watch_source(), pass_on(skin.samples(), queue.put_nowait)):
        yield queue


async def until(queue: "asyncio.Queue[SkinSample]", *faults: SkinFault, r1_ohm: float | None = None) -> SkinSample:
    async with asyncio.timeout(DEADLINE_S):
        while True:
            sample = await queue.get()
            near = r1_ohm is None or (sample.r1_ohm is not None and abs(sample.r1_ohm - r1_ohm) < 0.05)
            if set(sample.faults) == set(faults) and near:
                return sample


async def test_both_instruments_tied_by_one_skin_are_read_and_obey(tmp_path):
    places = ("--source-link", str(tmp_path / "source"), "--daq-link", str(tmp_path / "daq"))
    async with shearloop("emulate", "skin", *places, "--speed", str(SPEED), stdin=asyncio.subprocess.PIPE) as process:
        assert {await line(process), await line(process)} == {f"source {places[1]}", f"daq {places[3]}"}
        board = AdcBoard(SerialLink(path=places[3]), 10 * SPEED)
        async with read(SerialLink(path=places[1], baud=9600), board) as samples:
            assert (await until(samples)).r1_ohm == pytest.approx(24.6, rel=2e-3)
            await told(process, "shear 0.54")
            membrane = Membrane(THICK_SECTION)
            response = membrane.response(membrane.step(UNSTRETCHED, 0.54, NORMAL_N))
            await until(samples, r1_ohm=24.6 * (1 + response / (1 - SLACK_RATIO)))
            await told(process, "open 1")
            await until(samples, SkinFault.COMPLIANCE, SkinFault.OPEN_1)
            await told(process, "nonsense")
            await told(process, "normal")
            await until(samples)
        process.stdin.close()
        assert await process.wait() == 0
        assert b"'nonsense' is no fault of the circuit; there are open 1|2" in await process.stderr.read()


async def test_source_and_scanner_are_played_on_sockets_too():
    arguments = ("--speed", str(SPEED), "--source-port", "0", "--daq-port", "0")
    async with shearloop("emulate", "skin", *arguments, stdin=asyncio.subprocess.PIPE) as process:
        places = dict([(await line(process)).split(), (await line(process)).split()])
        scanner = ScpiScanner(tcp(places["daq"]), rate_hz=10 * SPEED)
        async with read(tcp(places["source"]), scanner) as samples:
            await until(samples, r1_ohm=24.6)
            await told(process, "short 2")
            await until(samples, SkinFault.SHORT_2)
            await told(process, "mend")
            await told(process, "leads 1000")
            await until(samples, SkinFault.COMPLIANCE)


def test_on_the_rig_the_robot_s_motion_shears_the_skin(tmp_path):
    pushed = PushedSkin(SyntheticSkin(), lever_m=0.02)
    rig = EmulatedRig(RigSettings(run_dir=tmp_path), Blank(), pushed)
    robot, gripper = rig.controller.robot, rig.scene.gripper

    def pass_s(seconds: float) -> None:
        for _ in range(round(seconds / 0.008)):
            robot.step(0.008)

    pass_s(0.1)
    r1, r2 = pushed.resistances_ohm()
    gripper.write(GripperRegisters(act=True))
    pass_s(8.0)
    gripper.write(GripperRegisters(act=True, gto=True, pos=255, spe=255, force=67))
    pass_s(1.0)
    assert rig.scene.twin.state.gripped
    robot.arm.q_rad[5] += 0.03
    pass_s(0.1)
    torque_nm = rig.scene.twin.state.torque_nm
    assert pushed.skin.shear_n == pytest.approx(torque_nm / 0.02)
    assert pushed.skin.shear_n > 0.5
    stretched_1, stretched_2 = pushed.resistances_ohm()
    assert stretched_1 / r1 - 1 > 0.04
    assert stretched_2 / r2 - 1 == pytest.approx(SLACK_RATIO * (stretched_1 / r1 - 1), abs=1e-3)
    rig.command("skin open 2")
    assert rig.skin.circuit.faults == {("open", "2")}
    rig.command("replug skin")
    assert not rig.skin.circuit.faults
