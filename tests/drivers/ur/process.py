"""The worker inside the test's process: the daemon's ends of its pipes, fake arms, a fake clock."""

import os
from collections.abc import Callable
from typing import NoReturn

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Message, MessageDecoder, RobotState, RtdeSample, WristSpeed, encode
from tests.drivers.ur.handler_bench import SETTINGS, FakeArm

BEGUN_S = 1000.0
Event = Message | Callable[[], object]


class ExitedError(Exception):
    """The worker would exit here."""


class Daemon:
    """The daemon's ends of the two pipes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        its_stdin, self._stdin = os.pipe()
        self._stdout, its_stdout = os.pipe()
        os.set_blocking(self._stdout, False)
        self._all = [its_stdin, self._stdin, self._stdout, its_stdout]
        self.pipe = worker.Pipe(its_stdin, its_stdout)
        monkeypatch.setattr(worker, "_set_alarm", lambda _seconds: None)
        monkeypatch.setattr(worker, "_exit", self._exited)

    @staticmethod
    def _exited(_status: int) -> NoReturn:
        raise ExitedError

    def send(self, *messages: Message) -> None:
        for number, message in enumerate(messages, 1):
            os.write(self._stdin, encode(message, number))

    def receive(self) -> list[tuple[int, Message]]:
        return MessageDecoder().feed(os.read(self._stdout, 1 << 20))

    def hang_up(self) -> None:
        """Close the worker's input, as the end of the daemon does."""
        if self._stdin in self._all:
            self._all.remove(self._stdin)
            os.close(self._stdin)

    def close(self) -> None:
        for descriptor in self._all:
            os.close(descriptor)


class CyclingArm(FakeArm):
    """An arm that runs a cycle at each read; `read_s` and `wrist_s` are the times of its reads and speeds."""

    def __init__(self) -> None:
        super().__init__()
        self.read_s: list[float] = []
        self.wrist_s: list[float] = []

    def read(self) -> RtdeSample:
        self.cycle()
        self.read_s.append(worker.time.monotonic() - BEGUN_S)
        self.be(read_ns=worker.time.monotonic_ns())
        return super().read()

    def wrist(self, command: WristSpeed, left_s: float) -> bool:
        self.wrist_s.append(worker.time.monotonic() - BEGUN_S)
        return super().wrist(command, left_s)

    def end_program(self) -> None:
        self.calls.append("end_program")
        super().end_program()


def drive(daemon: Daemon, arm: CyclingArm) -> None:
    with pytest.raises(ExitedError):
        worker.control(daemon.pipe, SETTINGS, arm)  # an arm in all that counts


class Time:
    """A clock that only waiting advances."""

    def __init__(self) -> None:
        self.now_s = BEGUN_S

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class Timed:
    """A worker in its own time. At its time in the script, a message is sent or a function called, between cycles."""

    def __init__(
        self, daemon: Daemon, monkeypatch: pytest.MonkeyPatch, arm: CyclingArm, *script: tuple[float, Event]
    ) -> None:
        self.time = Time()
        self._daemon = daemon
        self._script = sorted(script, key=lambda entry: entry[0])
        monkeypatch.setattr(worker, "time", self.time)
        monkeypatch.setattr(daemon.pipe, "wait", self._wait)
        drive(daemon, arm)
        self.states = [message for _, message in daemon.receive() if isinstance(message, RobotState)]

    def _wait(self, timeout_s: float) -> bool:
        if not self._script or self._script[0][0] + BEGUN_S > self.time.now_s + timeout_s:
            self.time.now_s += timeout_s
            return False
        at_s, event = self._script.pop(0)
        self.time.now_s = max(self.time.now_s, at_s + BEGUN_S)
        if callable(event):
            event()
            return False
        self._daemon.send(event)
        return True
