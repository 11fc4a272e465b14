"""Emulated devices as processes of their own: what they play, what faults they have, what the real drivers read."""

import argparse
import asyncio
import os
import signal
from collections.abc import AsyncIterator
from contextlib import aclosing, asynccontextmanager

import numpy as np
import pytest
from scipy.io import loadmat

from shearloop.bank.bank_file import BankDefinition, write_bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli.emulate import console
from shearloop.drivers.connection import Link, SerialLink
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, ScpiScanner
from shearloop.drivers.shear_skin.skin import ShearSkin, SkinFault, SkinSample
from shearloop.drivers.shear_skin.tcp_link import TcpLink
from shearloop.emulators.synthetic_skin import NORMAL_N, SLACK_RATIO
from shearloop.estimation.skin.membrane import THICK_SECTION, UNSTRETCHED, Membrane
from tests.cli.emulate_rig.rig import write_rig_bank
from tests.fixtures.daemons import DEADLINE_S, recording, shearloop
from tests.running import pass_on, running, take

PERIOD_S = 0.5408


@asynccontextmanager
async def emulator(*arguments: str) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """Run `shearloop emulate eit-kit` as a process of its own and hand over the path that it prints."""
    async with shearloop("emulate", "eit-kit", *arguments, stdin=asyncio.subprocess.PIPE) as process:
        path = (await process.stdout.readline()).decode().strip()
        assert path, (await process.stderr.read()).decode()
        yield process, path


@pytest.mark.long
async def test_a_recording_at_three_hundred_times_its_pace_arrives_whole_and_in_order(shared):
    folder = shared / "recordings" / "streams" / "2024-12-03_16-09"
    expected = loadmat(folder / "device1.mat")["Right_Data"][:, 1:]
    async with emulator("--recording", str(folder / "device1.mat"), "--speed", "300", "--once") as (_, path):
        kit = EitKit(SerialLink(path=path), PAPER_TABLE.zero_slots, PERIOD_S / 300)
        frames = await take(kit.readings(), 832)
    assert [frame.seq for frame in frames] == list(range(832))
    np.testing.assert_array_equal([frame.raw for frame in frames], expected)
    facts = kit.diagnostics()
    assert (facts["frames"], facts["errors"], facts["connections"]) == (832, {}, 1)
    # The pace is checked loosely: the machine may be busy, but the board does not hurry.
    spread_s = (frames[-1].t_arrival_ns - frames[0].t_arrival_ns) / 1e9
    assert spread_s > 0.9 * 831 * PERIOD_S / 300


@pytest.mark.usefixtures("default_signals")
async def test_a_recording_is_played_again_and_again_under_the_name_given(tmp_path):
    path, lines = recording(tmp_path, 3)
    link = tmp_path / "eit"
    async with emulator("--recording", str(path), "--speed", "500", "--link", str(link)) as (process, port):
        assert port == str(link)
        frames = await take(EitKit(SerialLink(path=port), PAPER_TABLE.zero_slots, PERIOD_S / 500).readings(), 7)
        process.send_signal(signal.SIGINT)
        assert await process.wait() == 0
    np.testing.assert_array_equal([frame.raw for frame in frames], [lines[n % 3] for n in range(7)])
    assert not link.is_symlink(), "a stopped emulator leaves no port behind"


async def test_faults_are_switched_on_by_standard_input(tmp_path):
    path, lines = recording(tmp_path, 40)
    arguments = ("--recording", str(path), "--speed", "20", "--link", str(tmp_path / "eit"), "--once")
    async with emulator(*arguments) as (process, port):
        process.stdin.write(b"nan\nwhat\ncut-line\n")
        kit = EitKit(SerialLink(path=port), PAPER_TABLE.zero_slots, PERIOD_S / 20)
        frames: list[Frame] = []
        async with aclosing(kit.readings()) as arriving:
            async for frame in arriving:
                frames.append(frame)
                if len(frames) == 5:
                    process.stdin.write(b"unplug 0.1\n")
                if len(frames) == 37:
                    break
        process.stdin.close()
        assert await process.wait() == 0, "it ends when its standard input does"
        assert b"there is no fault 'what'" in await process.stderr.read()
    facts = kit.diagnostics()
    assert facts["errors"] == {"wrong_count": 1, "nan": 1}
    assert facts["connections"] == 2
    sent = [line.tolist() for line in lines]
    places = [sent.index(frame.raw.tolist()) for frame in frames]
    assert places[:4] == [2, 3, 4, 5]
    assert places == sorted({*places})


def test_two_rigs_have_different_noise_unless_their_seed_is_given():
    def seed(*arguments: str) -> int:
        parser = argparse.ArgumentParser()
        console.add_seed_and_speed(parser, "pace")
        return parser.parse_args(arguments).seed

    assert seed() != seed()
    assert seed("--seed", "3") == 3


async def test_twists_are_synthesised_from_a_bank(tmp_path):
    definition = BankDefinition("0" * 64, "gaussian_derivative", np.array([3.0, 3.5]), np.array([1.0, 2.0]))
    homogeneous = 0.5 * np.sin(PAPER_TABLE.electrodes @ [0.1, 0.2, 0.3, 0.4]) + 0.7
    signals = np.broadcast_to(
        np.cos(PAPER_TABLE.electrodes @ [0.3, 0.1, 0.2, 0.5]), (2, 2, len(PAPER_TABLE.electrodes))
    ).astype(np.float32)
    path = tmp_path / "bank.shb"
    write_bank(path, definition, homogeneous, np.full((2, 2), 0.5), np.ones((2, 2), bool), signals)
    async with emulator("--bank", str(path), "--speed", "200") as (_, port):
        frames = await take(EitKit(SerialLink(path=port), PAPER_TABLE.zero_slots, PERIOD_S / 200).readings(), 50)
    channels = np.array([frame.channels for frame in frames])
    # The programme begins with 15 s of nothing, then grips within 3 s: 28 and 34 frames.
    idle, gripped = channels[:25].mean(axis=0), channels[36:].mean(axis=0)
    assert channels.mean() == pytest.approx(0.13, abs=0.01)
    change = np.abs(idle + 0.17 * signals[0, 0] * 0.13 / np.abs(homogeneous).mean())
    assert np.corrcoef(gripped - idle, change - idle)[0, 1] > 0.99


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("eit-kit --recording a.mat --bank b.shb", "give either --recording FILE to play a recording or --bank FILE"),
        ("eit-kit", "give either --recording FILE to play a recording or --bank FILE"),
        ("eit-kit --recording absent.mat", "absent.mat: the recording cannot be read"),
        ("eit-kit --bank absent.shb", "absent.shb"),
        ("eit-kit --bank absent.shb --once", "--once is for a recording"),
        ("eit-kit --recording absent.mat --speed nan", "--speed nan is not a number above 0"),
        ("hx711 --torque-nm nan", "--torque-nm nan is not a number from -1000 to 1000"),
        ("gripper-socket --port 70000", "--port 70000 is not a whole number from 0 to 65535"),
        ("gripper-socket --speed 0", "--speed 0 is not a number above 0"),
        # An address for documentation (RFC 5737), which no machine has.
        ("gripper-socket --bind 192.0.2.1", "cannot be played: error while attempting to bind on address"),
        ("gripper-modbus --link /nowhere/at/all", "cannot be played: /nowhere/at: No such file or directory; choose"),
        ("ur --rate-hz 5", "--rate-hz 5 is not a number from 50 to 1000"),
        ("ur --host 192.0.2.1", "cannot be played: error while attempting to bind on address"),
        ("skin --source-port 70000", "--source-port 70000 is not a whole number from 0"),
        ("skin --daq-link /dev/null/daq", "cannot be played: /dev/null: File exists; choose another"),
        ("skin --rate-hz 5", "--rate-hz 5 is not a number from 50 to 1000"),
        ("rig {run} --bank absent.bank", "absent.bank"),
        ("rig {run} --bank {bank} --gel-stiffness -1", "--gel-stiffness -1 is not a number above 0"),
        ("rig {run} --bank {bank} --diameter-mm 150", "--diameter-mm 150 is not a number from 1 to 140 mm"),
        ("rig {run} --bank {bank} --run-dir /dev/null/run", "cannot be played: /dev/null/run: Not a directory"),
        ("rig {run} --bank {bank} --truth /nowhere/truth", "cannot be played: /nowhere/truth: No such file or dir"),
        ("rig {run} --bank {bank} --sigma 1.2 1.8", "give the larger one first"),
        ("rig {run} --bank {bank} --sigma 3.0 1.8", "the bank has no signal at sigma = 3"),
    ],
)
def test_a_mistake_is_one_sentence_and_status_two(arguments, sentence, tmp_path, mistake):
    words = arguments.format(run=f"--run-dir {tmp_path}", bank=write_rig_bank(tmp_path / "rig.bank")).split()
    complaint = mistake("emulate", *words)
    assert sentence in complaint
    assert complaint.count("\n") == 1


async def test_the_command_runs_without_a_terminal(tmp_path):
    path, _ = recording(tmp_path, 1)
    async with shearloop("emulate", "eit-kit", "--recording", str(path), stdin=asyncio.subprocess.DEVNULL) as process:
        assert os.stat((await process.stdout.readline()).strip()), "the port is there"
        process.terminate()
        assert await process.wait() == 0


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

    async with running(skin.watch_source(), pass_on(skin.batches(), lambda samples: [*map(queue.put_nowait, samples)])):
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
        scanner = ScpiScanner(tcp(places["daq"]), period_s=0.1 / SPEED)
        async with read(tcp(places["source"]), scanner) as samples:
            await until(samples, r1_ohm=24.6)
            await send(process, "short 2")
            await until(samples, SkinFault.SHORT_2)
            await send(process, "mend")
            await send(process, "leads 1000")
            await until(samples, SkinFault.COMPLIANCE)
