"""The commissioning's side of the process that drives the robot: requests, events, and a clean start after a kill."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Final

from shearloop.daemon.messaging.deadlines import boot_ns
from shearloop.drivers.ur.client import WORKER
from shearloop.drivers.ur.messages import encode
from shearloop.drivers.ur.settings import UrSettings
from shearloop.errors import UserError
from shearloop.tools.commission.arrivals import REAL_CLOCK, Arrivals, Clock
from shearloop.tools.commission.opened import Opened
from shearloop.tools.interrupts import interrupts_held

Event = dict[str, Any]
# Requests that move the arm.
MOTIONS: Final = ("turn", "swing", "line")
# A controller unlocks a protective stop after 5 s; a worker starts and connects within some seconds more.
READY_WITHIN_S: Final = 30.0
_AGAIN_S: Final = 1.0
# With a long deadline: the robot's watchdog alone ends its straight moves in time.
WATCHDOG_WORKER: Final = "shearloop.tools.commission.watchdog_worker"
# It fails on a signal while its process lives.
FAILING_WORKER: Final = "shearloop.tools.commission.failing_worker"
_ENDS_WITHIN_S: Final = 6.0


class MoveRefusedError(UserError):
    """The robot did not carry out a motion; the message says why."""


class Mover(ABC):
    """Drives the robot by requests, which `shearloop.tools.commission.mover_process` carries out."""

    def __init__(
        self, settings: UrSettings, clock: Clock = REAL_CLOCK, now_boot_ns: Callable[[], int] = boot_ns
    ) -> None:
        """`settings` have the limits of every motion; no process is started yet.

        `now_boot_ns` goes on while the computer is suspended: with it, a motion names the time of its request.
        """
        self.settings = settings
        # Called before each request that moves the arm.
        self.before_motion: Callable[[], None] = lambda: None
        self._now_boot_ns = now_boot_ns
        # The module of the worker.
        self.worker = WORKER
        self.events: Arrivals[Event] = Arrivals(lambda event: int(event["t_ns"]), clock)

    @abstractmethod
    def start(self) -> None:
        """Start what drives the robot; it sends the program to the robot where the robot is ready."""

    @abstractmethod
    def kill(self) -> None:
        """End what drives the robot at once, also where it is stopped."""

    @abstractmethod
    def stop_worker(self) -> int:
        """Stop the worker by SIGSTOP, so that the robot's watchdog gets no commands; return the time."""

    @abstractmethod
    def send(self, request: Event) -> None:
        """Send a request."""

    def restart(self, *, worker: str | None = None, settings: UrSettings | None = None) -> None:
        """End what drives the robot, and start it again, from here on with this worker and with these settings."""
        self.kill()
        self.worker, self.settings = worker or self.worker, settings or self.settings
        self.start()

    def event(self, kind: str, since_ns: int, within_s: float) -> Event | None:
        """Return the first event of a kind since a moment, or None after `within_s`."""
        return self.events.wait_for(lambda event: event["event"] == kind, since_ns, within_s)

    def request(self, do: str, **arguments: object) -> int:
        """Send a request without waiting for its end; return its time."""
        if do in MOTIONS:
            self.before_motion()
        asked_ns = self.events.clock.now_ns()
        self.send({"do": do, "asked_boot_ns": self._now_boot_ns(), **arguments})
        return asked_ns

    def ended(self, asked_ns: int, within_s: float = READY_WITHIN_S) -> str:
        """Return why a request was refused or ended early, or an empty string."""
        event = self.event("ended", asked_ns, within_s)
        if event is not None:
            return str(event["refusal"])
        lost = self.event("lost", asked_ns, 0.0)
        return str(lost["sentence"]) if lost is not None else f"the robot did not answer within {within_s:g} s"

    def unlock(self, within_s: float = READY_WITHIN_S) -> str:
        """Make the robot ready, again while it refuses; return why it is not ready, or an empty string."""
        clock = self.events.clock
        until_ns = clock.now_ns() + round(1e9 * within_s)
        while True:
            left_s = (until_ns - clock.now_ns()) / 1e9
            refusal = self.ended(self.request("unlock"), max(1.0, left_s))
            if not refusal or clock.now_ns() + _AGAIN_S * 1e9 >= until_ns:
                return refusal
            clock.sleep(_AGAIN_S)

    def move(self, do: str, **arguments: object) -> int:
        """Carry out a motion to its end; return when it was asked for. Raises MoveRefusedError."""
        asked_ns = self.request(do, **arguments)
        if refusal := self.ended(asked_ns):
            raise MoveRefusedError(f"the motion was not carried out: {refusal}")
        return asked_ns


class MoverProcess(Mover, Opened):
    """Drives the robot through a process of its own, which can die; a context, which ends the process at its end."""

    def __init__(self, settings: UrSettings, now_boot_ns: Callable[[], int] = boot_ns) -> None:
        """Take the settings; nothing is started yet."""
        super().__init__(settings, now_boot_ns=now_boot_ns)
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None
        self._worker_pid = 0

    def open(self) -> None:
        """Start the process."""
        self.start()

    def close(self) -> None:
        """Stop the arm and end the process."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.close()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_ENDS_WITHIN_S)
        self.kill()

    def start(self) -> None:
        """Start a process and its worker."""
        command = [sys.executable, "-m", "shearloop.tools.commission.mover_process", self.worker]
        with interrupts_held():
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._write(encode(self.settings).decode())
        self._reader = threading.Thread(target=self._read, args=(self._process,), name="mover", daemon=True)
        self._reader.start()

    def send(self, request: Event) -> None:
        """Send a request."""
        self._write(f"{json.dumps(request)}\n")

    def _write(self, line: str) -> None:
        if self._process is None or self._process.stdin is None:
            raise UserError("the process that drives the robot does not run")
        try:
            self._process.stdin.write(line)
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise UserError("the process that drives the robot has ended: read its last lines") from error

    def _read(self, process: "subprocess.Popen[str]") -> None:
        if process.stdout is None:
            return
        for line in process.stdout:
            event: Event = json.loads(line)
            if event["event"] == "connected":
                self._worker_pid = event["worker"]
            self.events.add(event)

    def kill(self) -> None:
        """End the process and its worker at once."""
        if self._process is not None:
            self._process.kill()
        self._kill_worker()
        if self._process is not None:
            self._process.wait()
        if self._reader is not None:
            # Its last lines may name another worker.
            self._reader.join()
        self._kill_worker()
        if self._process is not None:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with contextlib.suppress(BrokenPipeError):
                        pipe.close()
        self._process = self._reader = None

    def _kill_worker(self) -> None:
        """End the worker, if one is known, and forget it: its number may be another process's later."""
        if self._worker_pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._worker_pid, signal.SIGKILL)
        self._worker_pid = 0

    def stop_worker(self) -> int:
        """Stop the worker; return the time."""
        if not self._worker_pid:
            # Signals to process 0 go to the whole group of this one.
            raise UserError("no worker is known that could be stopped: the robot has not been connected yet")
        stopped_ns = self.events.clock.now_ns()
        os.kill(self._worker_pid, signal.SIGSTOP)
        return stopped_ns
