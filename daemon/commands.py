"""What the commands of the daemon do: a handler for each, which carries it out or refuses with a reason."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.command_server import STATUS, STOP, CommandRefusedError, Handler, Reply, Request
from shearloop.daemon.rig import Rig
from shearloop.daemon.sensing.fingertip_task import FingertipTask

# Until the reply to the `stop` that ends the daemon is out.
FAREWELL_S = 0.05


class Commands:
    """Carries out what operators and programs ask for over the command socket."""

    def __init__(
        self,
        *,
        rig: Rig | None,
        tares: Mapping[str, Callable[[], None]],
        fingertips: Mapping[str, FingertipTask],
        experiment: Path | None,
        begin: Callable[[Path], Awaitable[str | None]],
        give_up_waiting: Callable[[], Path | None],
        tasks: Callable[[], Any],
        stop: Callable[[], None],
    ) -> None:
        """Take the rig, where there is one, and what takes the zero of each sensor.

        `experiment` is the configured one; `begin` starts one or returns why not; `give_up_waiting` returns one that
        was still to be started; `tasks` are what health knows of them; `stop` ends the daemon.
        """
        self._rig = rig
        self._tares = tares
        self._fingertips = fingertips
        self._experiment = experiment
        self._begin = begin
        self._give_up_waiting = give_up_waiting
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
        """Return what everyone on the machine may do where commands need a key: look, and stop."""

        async def refuse(_request: Request) -> Reply:
            raise CommandRefusedError("this needs a key: give --key and --server-key; without one there is only `stop`")

        return {name: own if name in (STOP, STATUS) else refuse for name, own in self.handlers().items()}

    async def _start(self, request: Request) -> Reply:
        path = request.get("experiment") or self._experiment
        if not isinstance(path, str | Path):
            raise CommandRefusedError("which experiment? Give its file, or name one in the configuration")
        try:
            why = await self._begin(Path(path))
        except UserError as error:
            raise CommandRefusedError(str(error)) from error
        _refuse(why)
        return {"experiment": str(path)}

    async def _pause(self, _request: Request) -> Reply:
        _refuse(needed(self._rig).brain.pause())
        return {}

    async def _resume(self, _request: Request) -> Reply:
        _refuse(needed(self._rig).brain.resume())
        return {}

    async def _unlock(self, _request: Request) -> Reply:
        _refuse(await needed(self._rig).loop.unlock())
        return {}

    async def _tare(self, request: Request) -> Reply:
        source = request.get("source")
        if source is not None and not (isinstance(source, str) and source in self._tares):
            raise CommandRefusedError(f"there is no sensor {source!r} to tare; there are {', '.join(self._tares)}")
        experiment = self._rig.brain.experiment if self._rig is not None else None
        if experiment is not None and experiment.running:
            raise CommandRefusedError(
                f"the experiment {experiment.file.name!r} is running, and a new zero would change what its torques "
                "are; stop it first, or give it a step `tare`"
            )
        tared = [source] if source is not None else list(self._tares)
        for name in tared:
            self._tares[name]()
        return {"tared": tared}

    async def _set(self, request: Request) -> Reply:
        """Change what may be changed while it runs; nothing that moves anything is among it."""
        source, heatmap = request.get("source"), request.get("heatmap")
        if heatmap not in ("always", "on_request"):
            raise CommandRefusedError("only `heatmap` can be set while it runs, to always or on_request")
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
        awaited = self._give_up_waiting()
        if stopped:
            return {"stopped": stopped}
        if request.get("spare_daemon"):
            # From a page that everyone may press stop on: it ends what moves or is about to, and nothing else.
            return {"stopped": f"the start of {awaited.name}" if awaited is not None else ""}
        # Nothing moves: the daemon itself is what stops, once the reply is out.
        asyncio.get_running_loop().call_later(FAREWELL_S, self._stop_daemon)
        return {}


def needed(rig: Rig | None) -> Rig:
    """Return the rig; CommandRefusedError where there is none."""
    if rig is None:
        raise CommandRefusedError("the configuration has no robot; add `robot: ur.yaml` to it")
    return rig


def _refuse(why: str | None) -> None:
    if why:
        raise CommandRefusedError(why)
