import asyncio
from collections.abc import Iterable, Iterator
from contextlib import aclosing
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers import eit_kit
from shearloop.drivers.connection import LinkEvent, LinkMonitor, SerialLink
from shearloop.drivers.eit_kit import ADC_STEP_V, EitKit, Frame, FrameErrorKind
from shearloop.emulators.boards import EitKitBoard, format_line
from tests.running import DEADLINE_S, LinkEvents, running, take

PERIOD_S = 0.003


def some_lines(n: int) -> list[NDArray[np.float64]]:
    steps = np.random.default_rng(1).integers(1, 300, (n, len(PAPER_TABLE.line_slots)))
    return [np.round(PAPER_TABLE.line_of_channels(row * ADC_STEP_V), 4) for row in steps]


async def play(
    lines: Iterable[NDArray[np.float64]],
    n_frames: int,
    tmp_path: Path,
    fault: str = "",
    after: int = 3,
    period_s: float = PERIOD_S,
) -> tuple[EitKit, list[Frame], list[LinkEvent]]:
    """Return the first frames of a board that has a fault after some lines."""
    link, links = tmp_path / "eit", LinkEvents()

    def sent() -> Iterator[bytes]:
        for number, line in enumerate(lines, 1):
            if fault and number == after:
                board.command(fault)
            yield format_line(line)

    board = EitKitBoard(sent(), period_s=period_s, link=link)
    async with running(board.run()):
        kit = EitKit(SerialLink(path=link, monitor=LinkMonitor(links)), PAPER_TABLE.zero_slots, period_s)
        frames = await take(kit.readings(), n_frames)
    return kit, frames, links.events


def assert_same(frames: list[Frame], lines: Iterable[NDArray[np.float64]]) -> None:
    np.testing.assert_array_equal([frame.raw for frame in frames], list(lines))


async def test_every_frame_arrives_once_and_in_order(tmp_path):
    lines = some_lines(60)
    # Slow enough for a busy computer: the period cannot be learned from frames that come in bursts.
    kit, frames, events = await play(lines, 60, tmp_path, period_s=0.02)
    assert_same(frames, lines)
    assert [frame.seq for frame in frames] == list(range(60))
    assert [event.up for event in events] == [True]
    facts = kit.diagnostics()
    assert (facts["frames"], facts["errors"], facts["connected"]) == (60, {}, False)
    assert facts["measured_hz"] is None, "a board that is gone has no rate"


async def test_a_connected_board_has_the_rate_of_its_frames(tmp_path):
    link, found = tmp_path / "eit", []
    async with running(EitKitBoard(map(format_line, some_lines(60)), period_s=0.02, link=link).run()):
        kit = EitKit(SerialLink(path=link), PAPER_TABLE.zero_slots, 0.02)
        async with aclosing(kit.readings()) as readings:
            async for frame in readings:
                found.append((kit.diagnostics()["measured_hz"], 1 / kit.period_s))
                if frame.seq == 50:
                    break
    assert found[0][0] is None, "one frame has no rate"
    assert found[-1][0] == pytest.approx(found[-1][1])


async def test_a_reader_that_stops_for_a_while_loses_nothing(tmp_path):
    lines = some_lines(40)
    board = EitKitBoard(map(format_line, lines), period_s=PERIOD_S, link=tmp_path / "eit")
    async with running(board.run()):
        kit = EitKit(SerialLink(path=tmp_path / "eit"), PAPER_TABLE.zero_slots, PERIOD_S)
        frames = []
        async with asyncio.timeout(DEADLINE_S), aclosing(kit.readings()) as arriving:
            async for frame in arriving:
                frames.append(frame)
                if len(frames) == 5:
                    await board.port.held_up.wait()
                if len(frames) == 40:
                    break
    assert_same(frames, lines)


@pytest.mark.parametrize(
    ("fault", "kind", "lost"),
    [
        ("cut-line", FrameErrorKind.WRONG_COUNT, True),
        ("wrong-count", FrameErrorKind.WRONG_COUNT, True),
        ("nan", FrameErrorKind.NAN, True),
        ("garbage", FrameErrorKind.WRONG_COUNT, False),
    ],
)
async def test_a_fault_costs_its_own_frame_at_most_and_is_counted(fault, kind, lost, tmp_path):
    lines = some_lines(6)
    kit, frames, _ = await play(lines, 6 - lost, tmp_path, fault)
    assert_same(frames, lines[:3] + lines[3 + lost :])
    facts = kit.diagnostics()
    assert facts["errors"] == {kind.name.lower(): 1}
    assert kind.value in str(facts["last_refusal"])


async def test_a_board_that_fell_silent_is_opened_and_started_again(tmp_path, monkeypatch):
    monkeypatch.setattr(eit_kit, "MIN_SILENCE_S", 0.3)
    lines = some_lines(8)
    kit, frames, events = await play(lines, 8, tmp_path, "silence")
    assert_same(frames, lines)
    assert kit.diagnostics()["connections"] >= 2  # more when the machine is slow
    assert "is open but has sent nothing for 0.3 s; see that it has power" in events[1].sentence


async def test_a_board_that_is_unplugged_is_found_again_and_started(tmp_path):
    lines = some_lines(12)
    kit, frames, events = await play(lines, 12, tmp_path, "unplug 0.05", period_s=0.1)
    assert_same(frames, lines)
    facts = kit.diagnostics()
    assert facts["connections"] == 2
    assert facts["errors"] == {}
    assert [event.up for event in events if not event.repeated] == [True, False, True]
    assert all(a.t_mid_ns < b.t_mid_ns for a, b in pairwise(frames))


async def test_a_driver_that_begins_while_the_board_sends_takes_up_with_the_next_line(tmp_path):
    lines = some_lines(30)
    async with running(EitKitBoard(map(format_line, lines), period_s=PERIOD_S, link=tmp_path / "eit").run()):
        kit = EitKit(SerialLink(path=tmp_path / "eit"), PAPER_TABLE.zero_slots, PERIOD_S)
        first = await take(kit.readings(), 10)
        kit = EitKit(SerialLink(path=tmp_path / "eit"), PAPER_TABLE.zero_slots, PERIOD_S)
        second = await take(kit.readings(), 10)
    assert_same(first, lines[:10])
    sent = [line.tolist() for line in lines]
    places = [sent.index(frame.raw.tolist()) for frame in second]
    assert places == list(range(places[0], places[0] + 10))
    assert places[0] >= 10
    assert kit.diagnostics()["errors"] == {}


async def test_a_missing_board_is_awaited_and_reported_as_new_only_once(tmp_path):
    links = LinkEvents()
    kit = EitKit(SerialLink(path=tmp_path / "eit", monitor=LinkMonitor(links)), PAPER_TABLE.zero_slots, PERIOD_S)
    taking = asyncio.create_task(take(kit.readings(), 1))
    await links.down(2)
    async with running(EitKitBoard(map(format_line, some_lines(1)), period_s=PERIOD_S, link=tmp_path / "eit").run()):
        (frame,) = await taking
    assert frame.seq == 0
    assert kit.diagnostics()["measured_hz"] is None, "a frame has no rate"
    assert [event.repeated for event in links.losses][:2] == [False, True]
    assert "There is no serial port" in links.events[0].sentence
