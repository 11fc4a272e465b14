"""A zero begins with what was measured after it was asked for: what is under way is of whatever was gripped before."""

from typing import Any, cast

import numpy as np
import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.sensing.estimators import Reading
from shearloop.daemon.sensing.fingertip_task import EstimatorTask
from shearloop.drivers.eit_line import Frame
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap, no_tap

MS = 1_000_000
PERIOD_NS = 540 * MS
NOTHING = np.zeros(896, dtype=np.bool_)


class Held(Clock):
    """A clock that shows what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = 10_000 * MS

    def now_ns(self) -> int:
        return self.t_ns


class Tared:
    """An estimator that keeps before which frame it was tared."""

    baseline_complete = True

    def __init__(self) -> None:
        self.before: list[int] = []
        self._tared = False

    def tare(self) -> None:
        self._tared = True

    def quickly(self, *frames: Frame) -> Reading:
        if self._tared:
            self.before.append(frames[0].seq)
        self._tared = False
        return Reading(why=("nothing",))


def frame(seq: int, arrives_ns: int) -> Frame:
    """Return a frame that was acquired in one period, sent, and arrived."""
    transfer_ns = 80 * MS
    mid_ns = arrives_ns - transfer_ns - PERIOD_NS // 2
    return Frame(np.full(896, 0.1), np.zeros(1024), b"", mid_ns, arrives_ns, seq, NOTHING, NOTHING, 0, False)


class Unheard:
    """A publisher that nobody listens to."""

    def publish(self, _message: Message) -> None:
        pass


def estimating(estimator: Tared, clock: Clock, tap: Tap = no_tap) -> EstimatorTask:
    publisher = cast(Publisher, Unheard())
    return EstimatorTask(
        "right", cast(Any, estimator), publisher, clock, lambda: PERIOD_NS / 1e9, lambda _: None, tap=tap
    )


@pytest.mark.parametrize("since_ms", [1, 100, 540, 621])
def test_the_frame_that_is_under_way_when_a_zero_is_asked_for_is_not_of_it(since_ms: int) -> None:
    clock, estimator, told = Held(), Tared(), list[RawEvent]()
    estimation = estimating(estimator, clock, told.append)
    asked_ns = clock.t_ns
    estimation.tare()
    for seq in range(5):
        clock.t_ns = asked_ns + since_ms * MS + seq * PERIOD_NS
        estimation.at_once(frame(seq, clock.t_ns))
    ((first,),) = [estimator.before]
    began_ns = asked_ns + since_ms * MS + first * PERIOD_NS - PERIOD_NS - 80 * MS
    assert asked_ns <= began_ns < asked_ns + PERIOD_NS, "and no frame more than that is lost for it"
    assert [(one.kind, one.data) for one in told] == [(InputKind.TARE, str(first).encode())], "as a replay will find it"


def test_a_pair_of_which_one_frame_was_under_way_is_not_of_the_zero() -> None:
    clock, estimator = Held(), Tared()
    estimation = estimating(estimator, clock)
    estimation.tare()
    for seq in range(3):
        arrives_ns = clock.t_ns + 630 * MS + seq * PERIOD_NS
        estimation.at_once(frame(seq, arrives_ns), frame(seq, arrives_ns - 200 * MS))
    assert estimator.before == [1]


def test_who_asks_again_meanwhile_gets_a_zero_of_what_comes_after_that() -> None:
    clock, estimator = Held(), Tared()
    estimation = estimating(estimator, clock)
    for seq in range(5):
        if seq < 2:
            estimation.tare()
        clock.t_ns += PERIOD_NS
        estimation.at_once(frame(seq, clock.t_ns))
    assert estimator.before == [2], "number 1 would have been the first one's"
