"""When nothing is heard for too long: on a loop whose time the test lets pass."""

import asyncio
import heapq
from typing import Any

import pytest

from shearloop.daemon.control.watchdog_timer import WatchdogTimer


class Loop:
    """As much of an event loop as a timer needs."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.timers: list[asyncio.TimerHandle] = []
        self.looked = 0

    def time(self) -> float:
        return self.now_s

    def call_at(self, when_s: float, callback: Any) -> asyncio.TimerHandle:
        handle = asyncio.TimerHandle(when_s, callback, (), self)  # type: ignore[arg-type]  # it never runs itself
        heapq.heappush(self.timers, handle)
        return handle

    def get_debug(self) -> bool:
        return False

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        self.timers.remove(handle)
        heapq.heapify(self.timers)

    def until(self, to_s: float) -> None:
        while self.timers and self.timers[0].when() <= to_s:
            handle = heapq.heappop(self.timers)
            self.now_s = handle.when()
            self.looked += 1
            handle._run()
        self.now_s = to_s


@pytest.fixture
def loop(monkeypatch: pytest.MonkeyPatch) -> Loop:
    loop = Loop()
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: loop)
    return loop


def test_silence_is_told_when_it_has_lasted_for_what_was_said_last(loop: Loop) -> None:
    broken_s: list[float] = []
    silence = WatchdogTimer(lambda: broken_s.append(loop.now_s))
    for number in range(20):
        silence.heard(0.02)
        loop.until(100.0 + 0.008 * (number + 1))
    assert broken_s == []
    assert loop.looked == 0, "nobody is woken as long as something is heard"
    loop.until(101.0)
    assert broken_s == [pytest.approx(100.0 + 0.008 * 19 + 0.02)]


def test_a_shorter_time_counts_from_when_it_is_said(loop: Loop) -> None:
    broken_s: list[float] = []
    silence = WatchdogTimer(lambda: broken_s.append(loop.now_s))
    silence.heard(0.1)
    loop.until(100.008)
    silence.heard(0.02)
    loop.until(100.5)
    assert broken_s == [pytest.approx(100.028)]


def test_silence_goes_on_to_be_told_while_it_is_said_to_be_watched(loop: Loop) -> None:
    broken_s: list[float] = []

    def broken() -> None:
        broken_s.append(loop.now_s)
        silence.heard(0.02)

    silence = WatchdogTimer(broken)
    silence.heard(0.02)
    loop.until(100.05)
    assert broken_s == pytest.approx([100.02, 100.04])
    silence.end()
    loop.until(101.0)
    assert len(broken_s) == 2
    assert loop.timers == []
