import itertools
import time
from collections.abc import Iterator

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.connection import SerialLink, SerialPort
from shearloop.drivers.eit_kit import EitKit
from shearloop.emulators.boards import EitKitBoard, format_line, parse_fault
from tests.running import read_exactly, running, take


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
