"""A process that replaces the daemon: it drives the robot by the daemon's client, and can be killed or stopped.

Run it as `python -m shearloop.tools.commission.mover_process [WORKER]`. The first line of its input has the robot's
settings. Each further line is one request in JSON. Each line of its output is one event in JSON. At the end of the
input, and after Ctrl-C, it stops the arm and disconnects. WORKER is the module of the worker, by default the daemon's
worker.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol

from shearloop.daemon.messaging.deadlines import boot_ns
from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.ur.client import WORKER, UrRobot
from shearloop.drivers.ur.messages import (
    ARRIVED,
    Command,
    CommandReply,
    MessageDecoder,
    MoveLinear,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
)
from shearloop.drivers.ur.poses import tool_axis
from shearloop.drivers.ur.settings import UrSettings
from shearloop.tools.commission.bounds import LARGEST_M
from shearloop.tools.commission.failing_worker import CLOSE_RTDE, NO_DEADLINES
from shearloop.tools.commission.given_word import LONGEST_STANDSTILL_S
from shearloop.tools.commission.mover import FAILING_WORKER, MOTIONS
from shearloop.tools.interrupts import interrupts_let_through

# The causes of a stop that a request may name: signals to the worker, then to this process.
CAUSES: Final[Mapping[str, tuple[signal.Signals | None, signal.Signals | None]]] = {
    "worker killed": (signal.SIGKILL, None),
    "worker stopped": (signal.SIGSTOP, None),
    "daemon killed": (None, signal.SIGKILL),
    "daemon stopped": (None, signal.SIGSTOP),
    "daemon and worker killed": (signal.SIGKILL, signal.SIGKILL),
    "deadline not written": (NO_DEADLINES, None),
    "RTDE closed": (CLOSE_RTDE, None),
}
# The causes that need another worker than the daemon's.
WORKERS: Final[Mapping[str, str]] = dict.fromkeys(("deadline not written", "RTDE closed"), FAILING_WORKER)
# At this fraction of its speed a motion counts as full speed.
_FULL: Final = 0.95
# A motion that takes longer than this is stopped.
_LONGEST_S: Final = 30.0
LINE_M_PER_S2: Final = 0.3
_ROUNDING_M: Final = 1e-6


class DrivenRobot(Protocol):
    """The part of the daemon's client of a robot that requests need."""

    state: RobotState | None

    def next_state(self) -> Awaitable[RobotState]:
        """Return the next state."""

    def send(self, command: Command) -> Awaitable[CommandReply]:
        """Send a command at once and return its reply."""

    def keep_moving(self) -> None:
        """Let a running straight move continue."""


class Surroundings(Protocol):
    """The other needs of a driver: the time, a place for its events, and the causes that end a motion."""

    def now_ns(self) -> int:
        """Return the monotonic time in ns."""

    def report(self, event: str, **facts: object) -> None:
        """Report an event to the commissioning, with its time."""

    def bring_about(self, cause: str) -> None:
        """Cause a stop as `CAUSES` says."""


class Driver:
    """Carries out one request after the other."""

    def __init__(
        self, settings: UrSettings, robot: DrivenRobot, around: Surroundings, now_boot_ns: Callable[[], int] = boot_ns
    ) -> None:
        """`settings` have the accelerations of all motions; `now_boot_ns` is the clock of a request's time."""
        self._settings, self._robot, self._around = settings, robot, around
        self._now_boot_ns = now_boot_ns

    @property
    def _acceleration_rad_per_s2(self) -> float:
        return self._settings.limits.wrist_acceleration_rad_per_s2.inner

    async def handle(self, request: Mapping[str, Any]) -> None:
        """Carry out one request, and report its end, even if it fails."""
        try:
            reply = await self._carry_out(request)
        except Exception as error:  # noqa: BLE001 - reported to the commissioning, which decides
            traceback.print_exc()
            reply = CommandReply(refusal=f"The request failed: {type(error).__name__}: {error}.")
        self._around.report("ended", do=request.get("do", ""), refusal=reply.refusal)

    async def _carry_out(self, request: Mapping[str, Any]) -> CommandReply:
        while self._robot.state is None:
            await self._robot.next_state()
        cause = request.get("cause", "")
        if request["do"] in MOTIONS and (reason := self._why_too_old(request)):
            return CommandReply(refusal=reason)
        match request["do"]:
            case "unlock":
                return await self._robot.send(Unlock())
            case "turn":
                return await self._turn(request["rad_per_s"], request["to_rad"], cause)
            case "swing":
                return await self._swing(request["rad_per_s"], request["middle_rad"], request["by_rad"])
            case "line":
                return await self._line(request["metres"], request["m_per_s"], cause)
            case _:
                return await self._stop()

    def _why_too_old(self, request: Mapping[str, Any]) -> str:
        """Return why a motion is not begun: this process, or the computer, stood still since its request."""
        age_s = (self._now_boot_ns() - request.get("asked_boot_ns", self._now_boot_ns())) / 1e9
        if age_s <= LONGEST_STANDSTILL_S:
            return ""
        return (
            f"It was asked for {age_s:.0f} s ago, and this computer stood still since then. Look at the rig, and run "
            "the commissioning again."
        )

    async def _stop(self) -> CommandReply:
        """Stop, and return once the arm rests."""
        reply = await self._robot.send(Stop(self._acceleration_rad_per_s2))
        while reply.accepted and (await self._robot.next_state()).motion != "idle":
            continue
        return reply

    async def _keep_turning(self, rad_per_s: float, decide: Callable[[RobotState], float]) -> CommandReply:
        """Turn the wrist at a speed that `decide` renews with each state; it stops the wrist by 0."""
        until_ns = self._around.now_ns() + _LONGEST_S * 1e9
        while rad_per_s and self._around.now_ns() < until_ns:
            speed = WristSpeed(rad_per_s, self._acceleration_rad_per_s2, self._around.now_ns())
            reply = await self._robot.send(speed)
            if not reply.accepted:
                return reply
            state = await self._robot.next_state()
            if state.motion != "wrist":
                return CommandReply(refusal=state.end_reason or state.blocked)
            rad_per_s = decide(state)
        return await self._stop()

    async def _turn(self, rad_per_s: float, to_rad: float, cause: str) -> CommandReply:
        """Turn the wrist past an angle and stop, unless a cause comes at full speed."""
        self._around.report("sent", rad_per_s=rad_per_s)

        def decide(state: RobotState) -> float:
            nonlocal cause
            if cause and abs(state.wrist_speed_rad_per_s) > _FULL * abs(rad_per_s):
                self._around.bring_about(cause)
                cause = ""
            return 0.0 if (state.wrist_rad - to_rad) * rad_per_s >= 0 else rad_per_s

        return await self._keep_turning(rad_per_s, decide)

    async def _swing(self, rad_per_s: float, middle_rad: float, by_rad: float) -> CommandReply:
        """Turn to and fro until something else stops the wrist."""

        def decide(state: RobotState) -> float:
            nonlocal rad_per_s
            if abs(state.wrist_rad - middle_rad) > by_rad:
                rad_per_s = abs(rad_per_s) if state.wrist_rad < middle_rad else -abs(rad_per_s)
            return rad_per_s

        return await self._keep_turning(rad_per_s, decide)

    async def _line(self, metres: float, m_per_s: float, cause: str) -> CommandReply:
        """Move along the tool's axis, unless a cause comes at full speed; a positive distance leads from the robot."""
        if abs(metres) > LARGEST_M + _ROUNDING_M:
            return CommandReply(
                refusal=f"A straight move of {1e3 * metres:g} mm is longer than {1e3 * LARGEST_M:g} mm."
            )
        state = await self._robot.next_state()
        x, y, z, *turn = state.tcp_pose
        axis = tool_axis(state.tcp_pose)
        pose = (x + metres * axis[0], y + metres * axis[1], z + metres * axis[2], turn[0], turn[1], turn[2])
        reply = await self._robot.send(MoveLinear(pose, m_per_s, LINE_M_PER_S2))
        if not reply.accepted:
            return reply
        while (state := await self._robot.next_state()).motion == "linear":
            if cause and state.tcp_speed_m_per_s > _FULL * m_per_s:
                self._around.bring_about(cause)
                cause = ""
            self._robot.keep_moving()
        return CommandReply(refusal="" if state.end_reason == ARRIVED else state.end_reason or state.blocked)


class ThisProcess:
    """The surroundings of this process: its events are lines of its output."""

    def __init__(self, worker_module: str) -> None:
        """Take the module of the worker."""
        self._worker_module = worker_module.encode()

    def now_ns(self) -> int:
        """Return the monotonic time in ns."""
        return time.monotonic_ns()

    def report(self, event: str, **facts: object) -> None:
        """Print an event with its time."""
        sys.stdout.write(f"{json.dumps({'event': event, 't_ns': self.now_ns(), **facts})}\n")
        sys.stdout.flush()

    def bring_about(self, cause: str) -> None:
        """Send a cause's signals, after reporting its time."""
        to_worker, to_self = CAUSES[cause]
        worker = self.worker_pid()
        self.report("cause", cause=cause)
        if to_worker is not None and worker:
            os.kill(worker, to_worker)
        if to_self is not None:
            os.kill(os.getpid(), to_self)

    def worker_pid(self) -> int:
        """Return the number of this process's worker, or 0."""
        pid = os.getpid()
        for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            with contextlib.suppress(OSError):
                if self._worker_module in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
        return 0

    async def watch(self, robot: UrRobot) -> None:
        """Report each new worker, and each loss of the robot."""
        losses = reported = 0
        while True:
            await robot.next_state()
            worker = self.worker_pid()
            if worker and worker != reported:
                reported = worker
                self.report("connected", worker=worker)
            if robot.losses.total() != losses:
                losses = robot.losses.total()
                self.report("lost", sentence=robot.monitor.latest.sentence)


async def main(worker_module: str) -> None:
    """Serve requests until the input ends or Ctrl-C comes."""
    loop = asyncio.get_running_loop()
    lines = asyncio.StreamReader()
    reading, _ = await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    loop.add_signal_handler(signal.SIGINT, reading.close)
    with interrupts_let_through():
        await _serve(lines, worker_module)


async def _serve(lines: asyncio.StreamReader, worker_module: str) -> None:
    if not (first := await lines.readline()):
        return
    ((_, settings),) = MessageDecoder().feed(first)
    if not isinstance(settings, UrSettings):
        raise SystemExit(2)
    robot, process = UrRobot(settings, LinkMonitor(), worker=worker_module), ThisProcess(worker_module)
    driver = Driver(settings, robot, process)
    running = [asyncio.create_task(robot.run()), asyncio.create_task(process.watch(robot))]
    handled: list[asyncio.Task[None]] = []
    try:
        while line := await lines.readline():
            request = json.loads(line)
            # Only a stop comes during a motion.
            for task in handled:
                task.cancel()
            handled = [asyncio.create_task(driver.handle(request))]
    finally:
        tasks = (*running, *handled)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1] if len(sys.argv) > 1 else WORKER))
