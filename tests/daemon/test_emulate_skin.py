"""The skin's emulators as processes of their own, met by the real drivers."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from shearloop.bank.skin.membrane import THICK_SECTION, UNSTRETCHED, Membrane
from shearloop.daemon.synthetic_skin import NORMAL_N, SLACK_RATIO
from shearloop.drivers.connection import Link, SerialLink, TcpLink
from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, ScpiScanner
from shearloop.drivers.shear_skin.skin import ShearSkin, SkinFault, SkinSample
from tests.daemon.conftest import DEADLINE_S, shearloop
from tests.running import pass_on, running

SPEED = 20


async def line(process: asyncio.subprocess.Process) -> str:
    return (await process.stdout.readline()).decode().strip()


async def send(process: asyncio.subprocess.Process, command: str) -> None:
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
            await send(process, "shear 0.54")
            membrane = Membrane(THICK_SECTION)
            response = membrane.response(membrane.step(UNSTRETCHED, 0.54, NORMAL_N))
            await until(samples, r1_ohm=24.6 * (1 + response / (1 - SLACK_RATIO)))
            await send(process, "open 1")
            await until(samples, SkinFault.COMPLIANCE, SkinFault.OPEN_1)
            await send(process, "nonsense")
            await send(process, "normal")
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
            await send(process, "short 2")
            await until(samples, SkinFault.SHORT_2)
            await send(process, "mend")
            await send(process, "leads 1000")
            await until(samples, SkinFault.COMPLIANCE)
