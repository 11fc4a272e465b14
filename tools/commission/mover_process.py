"""The process in the daemon's place: it drives the robot by the daemon's own client, and can be killed or stopped.

`python -m shearloop.tools.commission.mover_process`: the robot's settings in the first line of the input, then one
request a line in JSON; events a line in JSON. At the end of the input it stops the arm and disconnects.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import (
    ARRIVED,
    CommandReply,
    MessageDecoder,
    MoveLinear,
    Stop,
    Unlock,
    WristSpeed,
    tool_axis,
)
from shearloop.drivers.ur.settings import UrSettings

# What a request may bring about at full speed: signals to the worker process, then to this one.
CAUSES: Final[Mapping[str, tuple[signal.Signals | None, signal.Signals | None]]] = {
    "worker killed": (signal.SIGKILL, None),
    "worker stopped": (signal.SIGSTOP, None),
    "daemon killed": (None, signal.SIGKILL),
    "daemon stopped": (None, signal.SIGSTOP),
    "daemon and worker killed": (signal.SIGKILL, signal.SIGKILL),
}
# A wrist at this share of its speed turns at full speed.
_FULL: Final = 0.95
# A motion that has not ended by then is stopped.
_LONGEST_S: Final = 30.0
LINE_M_PER_S2: Final = 0.3


class Mover:
    """Carries out one request after the other."""

    def __init__(self, settings: UrSettings) -> None:
        self._settings = settings
        self.robot = UrRobot(settings, LinkMonitor(), warns=False)
        self._reported_worker = 0

    @property
    def _acceleration_rad_per_s2(self) -> float:
        return self._settings.limits.wrist_acceleration_rad_per_s2.inner

    async def watch(self) -> None:
        """Report each new worker process, and each loss of the robot."""
        losses = 0
        while True:
            await self.robot.next_state()
            worker = worker_pid()
            if worker and worker != self._reported_worker:
                self._reported_worker = worker
                report("connected", worker=worker)
            if self.robot.losses.total() != losses:
                losses = self.robot.losses.total()
                report("lost", sentence=self.robot.monitor.latest.sentence)

    async def handle(self, request: Mapping[str, Any]) -> None:
        """Carry out one request, and report its end."""
        while self.robot.state is None:
            await self.robot.next_state()
        match request["do"]:
            case "unlock":
                reply = await self.robot.send(Unlock())
            case "turn":
                reply = await self._turn(request["rad_per_s"], request["to_rad"], request.get("cause", ""))
            case "swing":
                reply = await self._swing(request["rad_per_s"], request["middle_rad"], request["by_rad"])
            case "line":
                reply = await self._line(request["metres"], request["m_per_s"])
            case _:
                reply = await self._stop()
        report("ended", do=request["do"], refusal=reply.refusal)

    async def _stop(self) -> CommandReply:
        """Stop, and return once the arm rests."""
        reply = await self.robot.send(Stop(self._acceleration_rad_per_s2))
        while reply.accepted and (await self.robot.next_state()).motion != "idle":
            continue
        return reply

    async def _send_speed(self, rad_per_s: float) -> CommandReply:
        """Send a wrist speed that was decided now; report the time of the first one of a motion."""
        decided_ns = time.monotonic_ns()
        return await self.robot.send(WristSpeed(rad_per_s, self._acceleration_rad_per_s2, decided_ns))

    async def _turn(self, rad_per_s: float, to_rad: float, cause: str) -> CommandReply:
        """Turn the wrist past an angle and stop, unless a cause comes at full speed."""
        until_s = time.monotonic() + _LONGEST_S
        report("sent", rad_per_s=rad_per_s)
        reply = await self._send_speed(rad_per_s)
        while reply.accepted and time.monotonic() < until_s:
            state = await self.robot.next_state()
            if state.motion != "wrist":
                return CommandReply(refusal=state.end_reason or state.blocked)
            if cause and abs(state.wrist_speed_rad_per_s) > _FULL * abs(rad_per_s):
                bring_about(cause)
                cause = ""
            if (state.wrist_rad - to_rad) * rad_per_s >= 0:
                return await self._stop()
            reply = await self._send_speed(rad_per_s)
        return reply if not reply.accepted else await self._stop()

    async def _swing(self, rad_per_s: float, middle_rad: float, by_rad: float) -> CommandReply:
        """Turn to and fro until something else stops the wrist."""
        until_s = time.monotonic() + _LONGEST_S
        reply = await self._send_speed(rad_per_s)
        while reply.accepted and time.monotonic() < until_s:
            state = await self.robot.next_state()
            if state.motion != "wrist":
                return CommandReply(refusal=state.end_reason or state.blocked)
            if abs(state.wrist_rad - middle_rad) > by_rad:
                rad_per_s = abs(rad_per_s) if state.wrist_rad < middle_rad else -abs(rad_per_s)
            reply = await self._send_speed(rad_per_s)
        return reply if not reply.accepted else await self._stop()

    async def _line(self, metres: float, m_per_s: float) -> CommandReply:
        """Move along the tool's axis; a positive distance leads away from the robot."""
        state = await self.robot.next_state()
        x, y, z, *turn = state.tcp_pose
        axis = tool_axis(state.tcp_pose)
        pose = (x + metres * axis[0], y + metres * axis[1], z + metres * axis[2], turn[0], turn[1], turn[2])
        reply = await self.robot.send(MoveLinear(pose, m_per_s, LINE_M_PER_S2))
        if not reply.accepted:
            return reply
        while (state := await self.robot.next_state()).motion == "linear":
            self.robot.keep_moving()
        return CommandReply(refusal="" if state.end_reason == ARRIVED else state.end_reason or state.blocked)


def bring_about(cause: str) -> None:
    """Send a cause's signals, after reporting its time."""
    to_worker, to_self = CAUSES[cause]
    worker = worker_pid()
    report("cause", cause=cause)
    if to_worker is not None and worker:
        os.kill(worker, to_worker)
    if to_self is not None:
        os.kill(os.getpid(), to_self)


def worker_pid() -> int:
    """Return the number of this process's worker process, or 0."""
    pid = os.getpid()
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with contextlib.suppress(OSError):
            if b"shearloop.drivers.ur.worker" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
    return 0


def report(event: str, **facts: object) -> None:
    """Print an event with its time."""
    sys.stdout.write(f"{json.dumps({'event': event, 't_ns': time.monotonic_ns(), **facts})}\n")
    sys.stdout.flush()


async def main() -> None:
    """Serve requests until the input ends."""
    loop = asyncio.get_running_loop()
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    ((_, settings),) = MessageDecoder().feed(await lines.readline())
    if not isinstance(settings, UrSettings):
        raise SystemExit(2)
    mover = Mover(settings)
    running = [asyncio.create_task(mover.robot.run()), asyncio.create_task(mover.watch())]
    handling: asyncio.Task[None] | None = None
    try:
        while line := await lines.readline():
            request = json.loads(line)
            if handling is not None and not handling.done():
                # Only a stop comes during a motion.
                handling.cancel()
            handling = asyncio.create_task(mover.handle(request))
    finally:
        for task in (*running, *([handling] if handling is not None else [])):
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


if __name__ == "__main__":
    asyncio.run(main())
