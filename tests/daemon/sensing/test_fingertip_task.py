"""The tasks of one fingertip and of a pair: order, tares, backlog, and errors of the estimator."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator
from typing import Any, cast

import numpy as np
import pytest

from shearloop.bank.estimation import Estimate
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import FingertipConfig
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimators import COMBINED
from shearloop.daemon.sensing.fingertip_task import (
    MAX_BACKLOG,
    CombinedFingertipTask,
    EstimatorTask,
    FingertipTask,
)
from shearloop.drivers.eit_kit import FRAME_PERIOD_S, EitKit, Frame
from shearloop.drivers.serial_sensor import InputKind, RawEvent

MS = 1_000_000
PERIOD_S = 0.54
PERIOD_NS = 540 * MS
NONE = np.zeros(896, dtype=np.bool_)


class RecordingPublisher:
    """Keeps topic, source and frame of every message."""

    def __init__(self, enough: int = 0) -> None:
        self._enough = enough
        self.messages: list[tuple[str, str, int]] = []
        self.enough = asyncio.Event()
        self._published = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append((message.topic, message.source, message.frame))  # type: ignore[attr-defined]
        self._published.set()
        if len(self.messages) == self._enough:
            self.enough.set()

    async def until(self, topic: str, source: str, numbers: list[int]) -> None:
        while self.numbers(topic, source) != numbers:
            self._published.clear()
            await self._published.wait()

    def has_subscriber(self, _topic: str) -> bool:
        return False

    def numbers(self, topic: str, source: str) -> list[int]:
        return [number for *found, number in self.messages if found == [topic, source]]


class FakeEstimator:
    """Estimates nothing; frame `fails` raises, frame `waits` waits for `go_on`. Keeps the frames after tares."""

    taring = False

    def __init__(self, fails: int = -1, waits: int = -1) -> None:
        self.fails, self.waits = fails, waits
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.tared_before: list[int] = []
        self._tared = False
        self.calibration = type("", (), {"sides": ("right", "left")})

    def tare(self) -> None:
        self._tared = True

    def estimate(self, one: Frame, *_others: Frame) -> Estimate:
        if one.seq == self.fails:
            raise ZeroDivisionError("nothing to divide")
        if one.seq == self.waits:
            self.begun.set()
            assert self.go_on.wait(20)
        if self._tared:
            self.tared_before.append(one.seq)
        self._tared = False
        return Estimate(valid=False, reasons=("nothing",))


class FixedClock(Clock):
    """A clock that the test sets."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = 10_000 * MS

    def now_ns(self) -> int:
        return self.t_ns


class Board:
    """Sends four frames; each completes a pair with one of the left side."""

    period_s = PERIOD_S

    def __init__(self, combined: CombinedFingertipTask | None = None) -> None:
        self._combined = combined

    async def readings(self) -> AsyncGenerator[Frame]:
        for number in range(4):
            if self._combined is not None:
                self._combined.on_frame("left", frame(number))
                self._combined.on_frame("right", frame(number))
            yield frame(number)
            await asyncio.sleep(0)
        await asyncio.Event().wait()


def frame(number: int, arrives_ns: int | None = None) -> Frame:
    """Return a frame that was acquired in one period, sent in 80 ms, and arrived."""
    arrival_ns = number * PERIOD_NS if arrives_ns is None else arrives_ns
    mid_ns = arrival_ns - 80 * MS - PERIOD_NS // 2
    return Frame(np.full(896, 0.1), np.zeros(1024), b"", mid_ns, arrival_ns, number, NONE, NONE, 0, False)


def estimator_task(
    name: str, publisher: RecordingPublisher, estimator: FakeEstimator, clock: Clock | None = None, **options: Any
) -> EstimatorTask:
    return EstimatorTask(
        name,
        cast(Any, estimator),
        cast(Publisher, publisher),
        clock or Clock(),
        period_s=lambda: PERIOD_S,
        on_torque=lambda _: None,
        **options,
    )


def fingertip(
    publisher: RecordingPublisher, estimator: FakeEstimator, combined: CombinedFingertipTask | None = None
) -> FingertipTask:
    task = estimator_task("right", publisher, estimator)
    return FingertipTask(cast(EitKit, Board(combined)), task, cast(Publisher, publisher), combined)


@contextlib.asynccontextmanager
async def running(*coroutines: Any) -> AsyncGenerator[list[asyncio.Task[None]]]:
    tasks = [asyncio.create_task(each) for each in coroutines]
    try:
        async with asyncio.timeout(20):
            yield tasks
    finally:
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_estimates_come_in_order_and_a_slow_one_delays_no_frame() -> None:
    publisher, estimator = RecordingPublisher(8), FakeEstimator(waits=1)
    task = fingertip(publisher, estimator)
    async with running(task.estimate(), task.read()):
        await asyncio.to_thread(estimator.begun.wait, 20)
        await publisher.until("eit.frame", "right", [0, 1, 2, 3])
        assert publisher.numbers("eit.estimate", "right") == [0]
        estimator.go_on.set()
        await publisher.enough.wait()
    assert publisher.numbers("eit.estimate", "right") == [0, 1, 2, 3]


async def test_an_error_of_the_estimator_ends_its_own_task_and_not_the_reading() -> None:
    publisher = RecordingPublisher(4)
    task = fingertip(publisher, FakeEstimator(fails=0))
    async with running(task.estimate(), task.read()) as (estimating, reading):
        with pytest.raises(ZeroDivisionError):
            await estimating
        await publisher.enough.wait()
        assert not reading.done()
    assert publisher.numbers("eit.frame", "right") == [0, 1, 2, 3]


async def test_pairs_are_estimated_in_order_whatever_the_single_estimators_do() -> None:
    publisher, slow = RecordingPublisher(12), FakeEstimator(waits=1)
    combined = CombinedFingertipTask(estimator_task(COMBINED, publisher, slow), PERIOD_S)
    task = fingertip(publisher, FakeEstimator(), combined)
    async with running(combined.estimator_task.run(), task.estimate(), task.read()):
        await publisher.until("eit.estimate", "right", [0, 1, 2, 3])
        assert publisher.numbers("eit.estimate", COMBINED) == [0], "a slow pair delays no board"
        slow.go_on.set()
        await publisher.enough.wait()
    assert publisher.numbers("eit.estimate", COMBINED) == [0, 1, 2, 3]


async def test_with_a_full_backlog_there_is_no_room_until_it_is_worked_off() -> None:
    task = estimator_task("right", RecordingPublisher(), FakeEstimator())
    for number in range(MAX_BACKLOG):
        await asyncio.wait_for(task.room(), 1)
        task.submit(frame(number))
    assert task.backlog == MAX_BACKLOG
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(task.room(), 0.01)
    await task.next()
    await asyncio.wait_for(task.room(), 1)


@pytest.mark.parametrize("since_ms", [1, 100, 540, 621])
async def test_a_tare_begins_with_the_first_frame_acquired_after_it(since_ms: int) -> None:
    clock, estimator, raw = FixedClock(), FakeEstimator(), list[RawEvent]()
    task = estimator_task("right", RecordingPublisher(), estimator, clock, on_raw=raw.append)
    asked_ns = clock.t_ns
    task.tare()
    for seq in range(5):
        clock.t_ns = asked_ns + since_ms * MS + seq * PERIOD_NS
        await task.estimate(frame(seq, clock.t_ns))
    (first,) = estimator.tared_before
    began_ns = asked_ns + since_ms * MS + first * PERIOD_NS - PERIOD_NS - 80 * MS
    assert asked_ns <= began_ns < asked_ns + PERIOD_NS, "no later frame is skipped"
    assert [(one.kind, one.data) for one in raw] == [(InputKind.TARE, str(first).encode())], "as a replay finds it"


async def test_a_pair_with_one_earlier_frame_is_not_part_of_the_tare() -> None:
    clock, estimator = FixedClock(), FakeEstimator()
    task = estimator_task(COMBINED, RecordingPublisher(), estimator, clock)
    task.tare()
    for seq in range(3):
        arrives_ns = clock.t_ns + 630 * MS + seq * PERIOD_NS
        await task.estimate(frame(seq, arrives_ns), frame(seq, arrives_ns - 200 * MS))
    assert estimator.tared_before == [1]


async def test_a_second_tare_replaces_the_first() -> None:
    clock, estimator = FixedClock(), FakeEstimator()
    task = estimator_task("right", RecordingPublisher(), estimator, clock)
    for seq in range(5):
        if seq < 2:
            task.tare()
        clock.t_ns += PERIOD_NS
        await task.estimate(frame(seq, clock.t_ns))
    assert estimator.tared_before == [2]


async def test_waiting_for_a_tare_ends_when_it_is_complete() -> None:
    clock, estimator = FixedClock(), FakeEstimator()
    task = estimator_task("right", RecordingPublisher(), estimator, clock)
    async with running(task.tare_and_wait()) as (waiting,):
        await asyncio.sleep(0)
        await task.estimate(frame(0, clock.t_ns))
        await asyncio.sleep(0)
        assert not waiting.done(), "this frame was acquired before the tare"
        await task.estimate(frame(1, clock.t_ns + 2 * PERIOD_NS))
        await waiting


def test_the_configured_frame_period_is_the_boards() -> None:
    assert FingertipConfig.model_fields["frame_period_s"].default == FRAME_PERIOD_S
