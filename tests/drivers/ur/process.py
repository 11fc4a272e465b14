"""The worker inside the test's process: the daemon's ends of its pipes, fake arms, a fake clock."""

import os
from typing import NoReturn

import pytest

from shearloop.drivers.ur import worker
from shearloop.drivers.ur.messages import Message, MessageDecoder, RobotState, RtdeSample, encode
from tests.drivers.ur.flight import SETTINGS, FakeArm


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
    """An arm that runs a cycle at each read."""

    def read(self) -> RtdeSample:
        self.cycle()
        return super().read()

    def end_program(self) -> None:
        self.calls.append("end_program")
        super().end_program()


def fly(daemon: Daemon, arm: CyclingArm) -> None:
    with pytest.raises(ExitedError):
        worker._control(daemon.pipe, SETTINGS, arm)  # an arm in all that counts


class Time:
    """A clock that only waiting advances."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


class TimedArm(CyclingArm):
    """An arm in the worker's time; `read_s` holds the times of its reads."""

    def __init__(self) -> None:
        super().__init__()
        self.read_s: list[float] = []

    def read(self) -> RtdeSample:
        super().read()
        self.read_s.append(worker.time.monotonic() - 1000.0)
        self.be(t_mono_ns=worker.time.monotonic_ns())
        return self.reading


class Timed:
    """A worker in its own time; the daemon sends the script's messages at their times."""

    def __init__(
        self,
        daemon: Daemon,
        monkeypatch: pytest.MonkeyPatch,
        *script: tuple[float, Message],
        arm: "TimedArm | None" = None,
    ) -> None:
        self.time = Time()
        self.arm = arm or TimedArm()
        self._daemon = daemon
        self._script = [(1000.0 + at_s, message) for at_s, message in script]
        monkeypatch.setattr(worker, "time", self.time)
        monkeypatch.setattr(daemon.pipe, "wait", self._wait)
        fly(daemon, self.arm)
        self.states = [message for _, message in daemon.receive() if isinstance(message, RobotState)]

    def _wait(self, timeout_s: float) -> bool:
        if self._script and self._script[0][0] <= self.time.now_s + timeout_s:
            at_s, message = self._script.pop(0)
            self.time.now_s = max(self.time.now_s, at_s)
            self._daemon.send(message)
            return True
        self.time.now_s += timeout_s
        return False
