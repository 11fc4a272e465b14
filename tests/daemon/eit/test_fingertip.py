"""A fingertip's two tasks: the estimate is out before the frame is, in order, and its death is not the board's."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from typing import Any, cast

import numpy as np
import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import FingertipConfig
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimators import Reading
from shearloop.daemon.sensing.fingertip_task import EstimatorTask, FingertipTask
from shearloop.drivers.eit_format import FRAME_PERIOD_S
from shearloop.drivers.eit_kit import EitKit, Frame


class Told:
    """A publisher that keeps what it is told."""

    def __init__(self, enough: int) -> None:
        self._enough = enough
        self.messages: list[tuple[str, int]] = []
        self.enough = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append((message.topic, message.frame))  # type: ignore[attr-defined]
        if len(self.messages) == self._enough:
            self.enough.set()

    def wanted(self, _topic: str) -> bool:
        return False


def frame(number: int) -> Frame:
    values = np.full(896, 0.1)
    none = np.zeros(896, dtype=np.bool_)
    return Frame(values, np.zeros(1024), b"", number, number, number, none, none, 0, False)


class Board:
    """Four frames, then silence."""

    period_s = 0.54

    async def frames(self) -> AsyncGenerator[Frame]:
        for number in range(4):
            yield frame(number)
            # The estimating task has its turn, as it has while a port is waited for.
            await asyncio.sleep(0)
        await asyncio.Event().wait()


class Reader:
    """Reads frames at once but for number 1, which takes long; number `deadly` is beyond it."""

    baseline_complete = True

    def __init__(self, deadly: int = -1) -> None:
        self.deadly = deadly
        self.by_thread: list[int] = []

    def quickly(self, one: Frame) -> Reading | None:
        if one.seq == self.deadly:
            raise ZeroDivisionError("nothing to divide")
        return None if one.seq == 1 else Reading(why=("nothing",))

    def update(self, one: Frame) -> Reading:
        self.by_thread.append(one.seq)
        return Reading(why=("nothing",))


def task_of(told: Told, reader: Reader) -> FingertipTask:
    publisher = cast(Publisher, told)
    estimation = EstimatorTask("right", cast(Any, reader), publisher, Clock(), lambda: Board.period_s, lambda _: None)
    return FingertipTask(cast(EitKit, Board()), estimation, publisher)


@contextlib.asynccontextmanager
async def running(task: FingertipTask) -> AsyncGenerator[tuple[asyncio.Task[None], asyncio.Task[None]]]:
    estimating = asyncio.create_task(task.estimate())
    # It waits for frames before there are any, as in the daemon, where a board takes longer to open.
    await asyncio.sleep(0)
    reading = asyncio.create_task(task.read())
    try:
        yield reading, estimating
    finally:
        for each in (reading, estimating):
            each.cancel()
        await asyncio.gather(reading, estimating, return_exceptions=True)


async def test_estimates_are_in_order_and_the_quick_ones_out_before_their_frames() -> None:
    told, reader = Told(8), Reader()
    async with running(task_of(told, reader)), asyncio.timeout(20):
        await told.enough.wait()
    estimates = [number for topic, number in told.messages if topic == "eit.estimate"]
    assert estimates == [0, 1, 2, 3]
    assert reader.by_thread == [1]
    assert told.messages.index(("eit.estimate", 0)) < told.messages.index(("eit.frame", 0))
    # This one took long, and its frame does not wait for it.
    assert told.messages.index(("eit.frame", 1)) < told.messages.index(("eit.estimate", 1))


async def test_what_an_estimator_dies_of_ends_its_own_task_and_not_the_one_that_reads() -> None:
    told = Told(4)
    async with running(task_of(told, Reader(deadly=0))) as (reading, estimating), asyncio.timeout(20):
        with pytest.raises(ZeroDivisionError):
            await estimating
        await told.enough.wait()
        assert not reading.done()
    assert [number for topic, number in told.messages if topic == "eit.frame"] == [0, 1, 2, 3]


def test_a_board_is_expected_at_its_own_pace_before_that_is_measured() -> None:
    assert FingertipConfig.model_fields["frame_period_s"].default == FRAME_PERIOD_S
