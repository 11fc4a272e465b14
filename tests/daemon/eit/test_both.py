"""Both fingertips together: a pair's estimate is out before that of the side that completed it, and in order."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator
from typing import Any, cast

import numpy as np
import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimators import COMBINED, Reading
from shearloop.daemon.sensing.fingertip_task import CombinedFingertipTask, EstimatorTask, FingertipTask
from shearloop.drivers.eit_kit import EitKit, Frame

PERIOD_S = 0.54
NONE = np.zeros(896, dtype=np.bool_)


class Told:
    """A publisher that keeps what it is told."""

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self.messages: list[tuple[str, str, int]] = []
        self.enough = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append((message.topic, message.source, message.frame))  # type: ignore[attr-defined]
        if len(self.messages) == self._enough:
            self.enough.set()

    def wanted(self, _topic: str) -> bool:
        return False


def frame(number: int) -> Frame:
    t_ns = round(number * PERIOD_S * 1e9)
    return Frame(np.full(896, 0.1), np.zeros(1024), b"", t_ns, t_ns, number, NONE, NONE, 0, False)


class Board:
    """The right one of two boards: each of its four frames completes a pair with one of the left."""

    period_s = PERIOD_S

    def __init__(self, both: CombinedFingertipTask) -> None:
        self._both = both

    async def frames(self) -> AsyncGenerator[Frame]:
        for number in range(4):
            self._both.take("left", frame(number))
            # As a board does, which tells of a frame while it is being read.
            self._both.take("right", frame(number))
            yield frame(number)
            await asyncio.sleep(0)
        await asyncio.Event().wait()


class Reader:
    """Reads at once but for number `long`, which takes a thread, and number `deadly`, which is beyond it."""

    baseline_complete = True

    def __init__(self, long: int = -1, deadly: int = -1) -> None:
        self.long, self.deadly = long, deadly
        self.by_thread: list[int] = []

    def quickly(self, one: Frame, *_others: Frame) -> Reading | None:
        if one.seq == self.deadly:
            raise ZeroDivisionError("nothing to divide")
        return None if one.seq == self.long else Reading(why=("nothing",))

    def update(self, one: Frame, *_others: Frame) -> Reading:
        self.by_thread.append(one.seq)
        return Reading(why=("nothing",))


def both_of(told: Told, reader: Reader) -> CombinedFingertipTask:
    return CombinedFingertipTask(estimation(COMBINED, told, reader), ("right", "left"), PERIOD_S)


def estimation(name: str, told: Told, reader: Reader) -> EstimatorTask:
    return EstimatorTask(name, cast(Any, reader), cast(Publisher, told), Clock(), lambda: PERIOD_S, lambda _: None)


@contextlib.asynccontextmanager
async def running(
    told: Told, both: CombinedFingertipTask
) -> AsyncGenerator[tuple[asyncio.Task[None], asyncio.Task[None]]]:
    """Run both's task and the right fingertip's two; gives the one that reads the board, and both's."""
    right = FingertipTask(
        cast(EitKit, Board(both)), estimation("right", told, Reader()), cast(Publisher, told), both.room
    )
    estimating = asyncio.create_task(both.estimate())
    of_its_own = asyncio.create_task(right.estimate())
    # They wait for frames before there are any, as in the daemon, where a board takes longer to open.
    await asyncio.sleep(0)
    reading = asyncio.create_task(right.read())
    tasks = (reading, estimating, of_its_own)
    try:
        yield reading, estimating
    finally:
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_what_drives_the_loop_is_out_before_the_sides_own_estimate() -> None:
    told = Told(12)
    async with running(told, both_of(told, Reader())), asyncio.timeout(20):
        await told.enough.wait()
    assert told.messages == [
        one
        for number in range(4)
        for one in (
            ("eit.estimate", COMBINED, number),
            ("eit.estimate", "right", number),
            ("eit.frame", "right", number),
        )
    ]


async def test_a_pair_that_takes_long_keeps_no_board_waiting_and_those_after_it_come_after_it() -> None:
    told, reader = Told(12), Reader(long=1)
    async with running(told, both_of(told, reader)), asyncio.timeout(20):
        await told.enough.wait()
    assert [number for _, source, number in told.messages if source == COMBINED] == [0, 1, 2, 3]
    assert reader.by_thread == [1]
    assert told.messages.index(("eit.estimate", "right", 1)) < told.messages.index(("eit.estimate", COMBINED, 1))


async def test_what_the_estimator_of_both_dies_of_ends_its_own_task_and_not_the_one_that_reads_a_board() -> None:
    told = Told(8)
    async with running(told, both_of(told, Reader(deadly=0))) as (reading, estimating), asyncio.timeout(20):
        with pytest.raises(ZeroDivisionError):
            await estimating
        await told.enough.wait()
        assert not reading.done()
    assert [number for topic, _, number in told.messages if topic == "eit.frame"] == [0, 1, 2, 3]


async def test_pairs_that_come_while_another_waits_for_a_thread_or_is_in_one_wait_for_it() -> None:
    told, reader = Told(3), Reader(long=0)
    loop, begun, go_on = asyncio.get_running_loop(), asyncio.Event(), threading.Event()

    def update(*_frames: Frame) -> Reading:
        loop.call_soon_threadsafe(begun.set)
        assert go_on.wait(20)
        return Reading(why=("nothing",))

    reader.update = update  # type: ignore[method-assign]
    both = both_of(told, reader)
    estimating = asyncio.create_task(both.estimate())
    await asyncio.sleep(0)
    async with asyncio.timeout(20):
        for number in range(3):
            both.take("right", frame(number))
            both.take("left", frame(number))
            if number == 1:
                await begun.wait()
        go_on.set()
        await told.enough.wait()
    assert [number for *_, number in told.messages] == [0, 1, 2]
    estimating.cancel()
    await asyncio.gather(estimating, return_exceptions=True)
