import asyncio
import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.connection import SerialLink, SerialPort
from shearloop.drivers.eit_kit import EitKit
from shearloop.emulators.boards import EitKitBoard, EmulatedBoard, format_line, parse_fault
from tests.running import DEADLINE_S, read_exactly, running, take


def test_a_line_is_what_the_board_sends_byte_for_byte():
    values = np.zeros(1024)
    values[[1, 2, 1023]] = [0.0021484375, 0.55, 1.0162109375]
    line = format_line(values)
    assert line.startswith(b"0.0000, 0.0021, 0.5500, 0.0000, ")
    assert line.endswith(b", 0.0000, 1.0162, \n")
    assert len(line) == 1024 * 8 + 1


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("explode", "no fault 'explode'; there are cut-line, "),
        ("spike", "no fault 'spike'"),
        ("cut-line 3", "cut-line has no duration"),
        ("silence soon", "'soon' is no duration in seconds"),
        ("unplug -1", "'-1' is no duration"),
        ("unplug nan", "'nan' is no duration"),
    ],
)
def test_invalid_faults_are_refused(text, sentence):
    with pytest.raises(ValueError, match=sentence):
        parse_fault(text, EitKitBoard.faults)


async def test_it_says_nothing_before_it_is_started_and_is_silent_after_its_last_frame():
    line = np.where(PAPER_TABLE.zero_slots, 0, 0.25)
    sent = 2 * format_line(line)
    board = EitKitBoard([format_line(line)] * 2, period_s=0.001)
    async with running(board.run()):
        with SerialPort(board.port.path) as port:
            assert await port.read(0.05) is None
            await port.write(b"n")
            assert await port.read(0.05) is None
            await port.write(b"y")
            assert await read_exactly(port, len(sent)) == sent
            assert await port.read(0.05) is None
    assert board.port.appearances.qsize() == 1


@pytest.mark.real_time
async def test_a_busy_computer_that_keeps_the_emulator_waiting_leaves_no_gap_between_its_frames(tmp_path):
    period_s, line = 0.1, format_line(np.where(PAPER_TABLE.zero_slots, 0, 0.25))

    def lines() -> Iterator[bytes]:
        for number in itertools.count():
            if number == 8:
                # Nothing else of this process runs meanwhile.
                time.sleep(5 * period_s)
            yield line

    board = EitKitBoard(lines(), period_s=period_s, link=tmp_path / "eit")
    async with running(board.run()):
        kit = EitKit(SerialLink(path=tmp_path / "eit"), PAPER_TABLE.zero_slots, period_s, patience=10.0)
        frames = await take(kit.readings(), 20)
    t_s = [frame.t_mid_ns / 1e9 for frame in frames]
    # Two frames of such a distance have a gap between them, after which an estimator begins anew.
    assert np.diff(t_s).max() < 3 * period_s
    assert t_s[-1] - t_s[0] < 22 * period_s, "what was late is made up for"


@pytest.mark.parametrize("where", ["the emulator stands still", "nobody reads"])
async def test_lines_that_were_not_sent_for_long_are_left_out(where, monkeypatch):
    """A board sends no old lines in a row: nine of them came within 0.3 s, each as if it was new."""
    period_s, away_s, loop = 0.02, 5.0, asyncio.get_running_loop()
    real_time, ahead_s, written_s, enough = loop.time, [0.0], [], asyncio.Event()
    monkeypatch.setattr(loop, "time", lambda: real_time() + ahead_s[0])

    def lines() -> Iterator[bytes]:
        for number in itertools.count():
            if number == 3 and where == "the emulator stands still":
                ahead_s[0] = away_s
            yield b"line\n"

    async def write(_data: bytes) -> None:
        if len(written_s) == 3 and where == "nobody reads":
            ahead_s[0] = away_s
        written_s.append(loop.time())
        if len(written_s) == 9:
            enough.set()

    board = EmulatedBoard(lines(), period_s=period_s)
    monkeypatch.setattr(board.port, "write", write)
    async with running(board.run()):
        async with asyncio.timeout(away_s + DEADLINE_S):
            await enough.wait()
    steps_s = np.diff(written_s)
    assert steps_s[2] > away_s
    assert np.delete(steps_s, 2).min() > 0.5 * period_s
