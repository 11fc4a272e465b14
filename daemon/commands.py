"""The daemon's commands: one handler each, which executes the command or refuses it with a reason."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.command_server import STATUS, STOP, CommandRefusedError, Handler, Reply, Request
from shearloop.daemon.rig import Rig
from shearloop.daemon.sensing.fingertip_task import FingertipTask

# The reply to the `stop` that ends the daemon is sent within this time.
STOP_DELAY_S = 0.05


class Commands:
    """Executes the commands of the command socket."""

    def __init__(
        self,
        *,
        rig: Rig | None,
        tares: Mapping[str, Callable[[], None]],
        fingertips: Mapping[str, FingertipTask],
        experiment: Path | None,
        start: Callable[[Path], Awaitable[str | None]],
        call_off_experiment: Callable[[], Path | None],
        tasks: Callable[[], Any],
        stop: Callable[[], None],
    ) -> None:
        """`tares` sets the zero of each sensor, `experiment` is the configured one, `tasks` returns their health.

        `start` starts an experiment or returns the reason of its refusal. `call_off_experiment` cancels an
        experiment that waits to start and returns it. `stop` stops the daemon.
        """
        self._rig = rig
        self._tares = tares
        self._fingertips = fingertips
        self._experiment = experiment
        self._start_experiment = start
        self._call_off_experiment = call_off_experiment
        self._tasks = tasks
        self._stop_daemon = stop

    def handlers(self) -> Mapping[str, Handler]:
        """Return the handler of every command."""
        return {
            "tare": self._tare,
            STATUS: self._status,
            STOP: self._stop,
            "start": self._start,
            "pause": self._pause,
            "resume": self._resume,
            "unlock": self._unlock,
            "set": self._set,
        }

    def open_handlers(self) -> Mapping[str, Handler]:
        """Return the handlers for users of this machine without a key: only `stop` and `status` work."""

        async def refuse(_request: Request) -> Reply:
            raise CommandRefusedError(
                "this command needs a key: give --key and --server-key; without one only `stop` works"
            )

        return {name: own if name in (STOP, STATUS) else refuse for name, own in self.handlers().items()}

    async def _start(self, request: Request) -> Reply:
        path = request.get("experiment") or self._experiment
        if not isinstance(path, str | Path):
            raise CommandRefusedError("no experiment is given: name its file, or one in the configuration")
        try:
            reason = await self._start_experiment(Path(path))
        except UserError as error:
            raise CommandRefusedError(str(error)) from error
        _refuse_if(reason)
        return {"experiment": str(path)}

    async def _pause(self, _request: Request) -> Reply:
        _refuse_if(required_rig(self._rig).control_loop.pause())
        return {}

    async def _resume(self, _request: Request) -> Reply:
        _refuse_if(required_rig(self._rig).control_loop.resume())
        return {}

    async def _unlock(self, _request: Request) -> Reply:
        _refuse_if(await required_rig(self._rig).runner.unlock())
        return {}

    async def _tare(self, request: Request) -> Reply:
        source = request.get("source")
        if source is not None and not (isinstance(source, str) and source in self._tares):
            raise CommandRefusedError(f"there is no sensor {source!r} to tare; there are {', '.join(self._tares)}")
        experiment = self._rig.control_loop.experiment if self._rig is not None else None
        if experiment is not None and experiment.running:
            raise CommandRefusedError(
                f"the experiment {experiment.file.name!r} is running, and a new zero would change its "
                "torques; stop it first, or give it a step `tare`"
            )
        tared = [source] if source is not None else list(self._tares)
        for name in tared:
            self._tares[name]()
        return {"tared": tared}

    async def _set(self, request: Request) -> Reply:
        """Change a setting of the running daemon; none of them moves the robot."""
        source, heatmap = request.get("source"), request.get("heatmap")
        if heatmap not in ("always", "on_request"):
            raise CommandRefusedError("only `heatmap` can be set while the daemon runs, to always or on_request")
        if source is not None and not (isinstance(source, str) and source in self._fingertips):
            raise CommandRefusedError(f"there is no fingertip {source!r}; there are {', '.join(self._fingertips)}")
        names = [source] if source is not None else list(self._fingertips)
        for name in names:
            self._fingertips[name].always_heatmap = heatmap == "always"
        return {"set": names, "heatmap": heatmap}

    async def _status(self, _request: Request) -> Reply:
        return {"tasks": self._tasks()}

    async def _stop(self, request: Request) -> Reply:
        stopped = self._rig.stop() if self._rig is not None else ""
        waiting = self._call_off_experiment()
        if stopped:
            return {"stopped": stopped}
        if request.get("spare_daemon"):
            # The live page's stop button stops motion, but not the daemon.
            return {"stopped": f"the start of {waiting.name}" if waiting is not None else ""}
        # Nothing moves, so the daemon itself stops after the reply.
        asyncio.get_running_loop().call_later(STOP_DELAY_S, self._stop_daemon)
        return {}


def required_rig(rig: Rig | None) -> Rig:
    """Return the rig; raises CommandRefusedError without a rig."""
    if rig is None:
        raise CommandRefusedError("the configuration has no robot; add `robot: ur.yaml` to it")
    return rig


def _refuse_if(reason: str | None) -> None:
    if reason:
        raise CommandRefusedError(reason)
