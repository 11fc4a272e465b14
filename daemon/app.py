"""The daemon: wires devices, estimators and sockets together and runs until it is told to stop."""

import asyncio
import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import structlog
import zmq
import zmq.asyncio

from bank.channels import ZERO_SLOTS
from daemon import sd_notify
from daemon.addresses import open_stop_address
from daemon.both import BOTH, BothTask
from daemon.clock import Clock
from daemon.command_server import STATUS, STOP, CommandRefusedError, CommandServer, Handler, Reply
from daemon.config import DaemonConfig, Fingertip
from daemon.errors import UserError
from daemon.estimation import Estimation
from daemon.fingertip import FingertipTask
from daemon.health import HealthReporter, TaskFacts
from daemon.keys import Gatekeeper, load_server_keys
from daemon.links import log_link
from daemon.load_cell_task import LOAD_CELL
from daemon.loop.senses import Source
from daemon.opening import AnyEstimator, open_both, open_estimator
from daemon.publisher import Listener, Publisher
from daemon.recording.identity import Attached, identity_of
from daemon.recording.recorder import Recorder
from daemon.rig import Rig, make_load_cell
from daemon.skin_setup import make_skin, skin_source
from daemon.skin_task import SKIN, SKIN_SOURCE, SkinTask
from daemon.supervisor import Supervisor
from daemon.tool_diameter import FingertipDiameters
from drivers.eit_kit import EitKit
from drivers.raw_input import Tap, no_tap
from drivers.serial_port import LinkEvent

# How often a start that was refused is tried again, and an end looked for.
START_RETRY_S = 0.5


class Daemon:
    """All parts of one running daemon."""

    def __init__(self, config: DaemonConfig, context: zmq.asyncio.Context) -> None:
        """Open every file that the configuration names and bind the sockets; devices may come later."""
        self._clock = Clock()
        self.supervisor = Supervisor()
        self._stop = asyncio.Event()
        # The configured experiment, until it has begun.
        self._awaited: Path | None = None
        estimators = {name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()}
        both = open_both(config.both, config.fingertips) if config.both is not None else None
        with contextlib.ExitStack() as opened:
            keys = load_server_keys(config.curve.server_key) if config.curve is not None else None
            self._gate: Gatekeeper | None = None
            if config.curve is not None and config.network_addresses:
                self._gate = Gatekeeper(context, config.curve.clients)
                opened.callback(self._gate.close)
            self.publisher = Publisher(context, config.publish, self._clock, keys)
            opened.callback(self.publisher.close)
            self._commands = CommandServer(context, config.commands, self._handlers(), keys)
            opened.callback(self._commands.close)
            self._open_stop: CommandServer | None = None
            if "commands" in config.network_addresses:
                self._open_stop = CommandServer(context, open_stop_address(config.commands), self._open_handlers())
                opened.callback(self._open_stop.close)
            self._recorder = _recorder(config, self.publisher, self._clock, self._busy, self._recording_failed)
            if self._recorder is not None:
                opened.callback(self._recorder.close)
            self._close = opened.pop_all().close
        self._rig: Rig | None = None
        try:
            if config.robot is not None:
                self._rig = Rig(
                    config,
                    self.publisher,
                    self._clock,
                    _sources(config),
                    self._tare_to_the_end,
                    self.supervisor.deaths,
                    self._tap,
                )
            hear = self._rig.brain.hear if self._rig is not None else lambda _: None
            self._load_cell = self._rig.load_cell if self._rig is not None else None
            if self._rig is None and config.load_cell is not None:
                # Measured and recorded beside the fingertips, while something else twists.
                self._load_cell = make_load_cell(
                    config.load_cell, self.publisher, self._clock, hear, self._link_of(LOAD_CELL), self._tap(LOAD_CELL)
                )
            self._skin: SkinTask | None = None
            if config.skin is not None:
                self._skin = make_skin(config.skin, self.publisher, self._clock, hear, self._tap)
        except BaseException:
            self._close()
            raise
        diameters = FingertipDiameters(BOTH)
        if self._rig is not None and self._rig.gripper is not None:
            self._rig.gripper.fingertips_say = diameters.at

        def estimation(name: str, estimator: AnyEstimator) -> Estimation:
            return Estimation(name, estimator, self.publisher, self._clock, hear, diameters.hear, self._tap(name))

        self._both: BothTask | None = None
        if both is not None:
            period_s = config.fingertips[both.sides[0]].frame_period_s
            self._both = BothTask(estimation(BOTH, both), both.sides, period_s)
        self._fingertips = {
            name: FingertipTask(
                _board(config.fingertips[name], self._link_of(name), self._tap(name)),
                estimation(name, estimator),
                self.publisher,
                **_passed_on(self._both, name),
                always_heatmap=config.fingertips[name].heatmap == "always",
            )
            for name, estimator in estimators.items()
        }
        self._estimations = {name: task.estimation for name, task in self._fingertips.items()}
        if self._both is not None:
            self._estimations[BOTH] = self._both.estimation
        self._config = config
        self._health = HealthReporter(self.publisher, self.supervisor, self._clock)
        for name, task in self._fingertips.items():
            self._health.add(name, task.facts)
        if self._both is not None:
            self._health.add(BOTH, self._both.facts)
        if self._skin is not None:
            self._health.add(SKIN, self._skin.facts)
            self._health.add(SKIN_SOURCE, self._skin.source_facts)
        if self._load_cell is not None:
            self._health.add(LOAD_CELL, self._load_cell.facts)
        if self._rig is not None:
            self._health.add("robot", self._rig.loop.facts)
            if self._rig.gripper is not None:
                self._health.add("gripper", self._rig.gripper.facts)
        if self._recorder is not None:
            self._health.add("recording", self._recorder.facts)
        self._health.add("commands", self._command_facts)

    async def run(self) -> None:
        """Run until `stop` is called, then end every task and close the sockets."""
        try:
            async with asyncio.TaskGroup() as group:
                running = [group.create_task(task, name=name) for name, task in self._tasks()]
                structlog.get_logger().info("running", fingertips=list(self._fingertips))
                sd_notify.notify("READY=1")
                await self._stop.wait()
                sd_notify.notify("STOPPING=1")
                for task in running:
                    task.cancel()
        finally:
            if self._recorder is not None:
                # It may have to wait for the disk.
                await asyncio.to_thread(self._recorder.close)
            self._close()
        self._tell_of_recordings()
        structlog.get_logger().info("stopped")

    def stop(self) -> None:
        """End `run` as soon as the tasks have ended."""
        self._stop.set()

    async def start_experiment(self, path: Path) -> str | None:
        """Begin an experiment, or return why it cannot be begun; raises UserError for a file that is none."""
        return await self._begin(path)

    async def stopped(self) -> None:
        """Wait until somebody has asked for the end."""
        await self._stop.wait()

    def _tasks(self) -> Iterator[tuple[str, Any]]:
        def supervised(name: str, run: Callable[[], Any]) -> tuple[str, Any]:
            return name, self.supervisor.keep_running(name, run)

        for name, task in self._fingertips.items():
            yield supervised(name, task.read)
            yield supervised(f"{name}.estimator", task.estimate)
        if self._both is not None:
            yield supervised(BOTH, self._both.estimate)
        if self._skin is not None:
            yield supervised(SKIN, self._skin.read)
            yield supervised(SKIN_SOURCE, self._skin.watch_source)
        if self._load_cell is not None:
            yield supervised(LOAD_CELL, self._load_cell.read)
        if self._rig is not None:
            for name, run in self._rig.tasks():
                yield supervised(name, run)
            if self._config.experiment is not None:
                yield supervised("experiment", self._run_experiment)
        if self._recorder is not None:
            yield supervised("recording", self._recorder.run)
        yield supervised("commands", self._commands.run)
        if self._gate is not None:
            yield supervised("keys", self._gate.run)
        if self._open_stop is not None:
            yield supervised("open_stop", self._open_stop.run)
        yield supervised("health", self._health.run)

    async def _run_experiment(self) -> None:
        """Start the configured experiment as soon as it can be started, and see it to its end."""
        rig, path = self._rig, self._config.experiment
        if rig is None or path is None:
            return
        log, told = structlog.get_logger().bind(experiment=str(path)), ""
        self._awaited = path
        while (why := await self._begin(path)) is not None:
            if self._awaited is None:
                log.info("the operator said stop: it is not started")
                return
            if why != told:
                log.info("waiting to start", why=why)
                told = why
            await asyncio.sleep(START_RETRY_S)
        self._awaited = None
        experiment = await rig.loop.ended()
        log.info("the experiment has ended", phase=experiment.phase.value, why=experiment.why)
        if self._config.stop_when_done:
            self.stop()

    async def _begin(self, path: Path) -> str | None:
        """Begin the experiment in a file, recorded, or return why not; raises UserError for a file that is none."""
        rig, recorder = self._needed_rig, self._recorder
        attached = Attached.if_there(path) if recorder is not None else ()
        why = await rig.start(path)
        if why is None and recorder is not None and rig.brain.experiment is not None:
            recorder.experiment(rig.brain.experiment.file.name, attached)
        return why

    def _tap(self, source: str) -> Tap:
        return no_tap if self._recorder is None else self._recorder.tap(source)

    def _busy(self) -> bool:
        """Return whether an experiment is running."""
        experiment = self._rig.brain.experiment if self._rig is not None else None
        return experiment is not None and experiment.running

    def _recording_failed(self, why: str) -> None:
        if self._rig is not None:
            self._rig.brain.senses.recording_failed = why

    def _tell_of_recordings(self) -> None:
        if self._recorder is None:
            return
        for path in self._recorder.finished:
            structlog.get_logger().info("recorded", file=str(path))
        if self._recorder.failure:
            structlog.get_logger().error("the recording could not be finished", why=self._recorder.failure)

    def _link_of(self, device: str) -> Callable[[LinkEvent], None]:
        return self._rig.link_of(device) if self._rig is not None else partial(log_link, device)

    def _handlers(self) -> Mapping[str, Handler]:
        return {
            "tare": self._tare,
            "status": self._status,
            "stop": self._stop_wanted,
            "start": self._start,
            "pause": self._pause,
            "resume": self._resume,
            "unlock": self._unlock,
            "set": self._set,
        }

    def _open_handlers(self) -> Mapping[str, Handler]:
        """Return what everyone on the machine may do where commands need a key: look, and stop."""

        async def refuse(_request: Mapping[str, Any]) -> Reply:
            raise CommandRefusedError("this needs a key: give --key and --server-key; without one there is only `stop`")

        return {name: own if name in (STOP, STATUS) else refuse for name, own in self._handlers().items()}

    def _command_facts(self) -> TaskFacts:
        """Return what was refused, by kind: commands, and clients that had no right to connect."""
        refused = self._commands.refused.copy()
        for other in (self._gate, self._open_stop):
            if other is not None:
                refused.update(other.refused)
        return {"errors": dict(refused)}

    async def _tare_to_the_end(self) -> str:
        tares = [one.tare_to_the_end() for one in self._estimations.values()]
        if self._skin is not None:
            tares.append(self._skin.zero())
        return " ".join(filter(None, await asyncio.gather(*tares)))

    @property
    def _needed_rig(self) -> Rig:
        if self._rig is None:
            raise CommandRefusedError("the configuration has no robot; add `robot: ur.yaml` to it")
        return self._rig

    async def _start(self, request: Mapping[str, Any]) -> Reply:
        path = request.get("experiment") or self._config.experiment
        if not isinstance(path, str | Path):
            raise CommandRefusedError("which experiment? Give its file, or name one in the configuration")
        try:
            why = await self._begin(Path(path))
        except UserError as error:
            raise CommandRefusedError(str(error)) from error
        _refuse(why)
        return {"experiment": str(path)}

    async def _pause(self, _request: Mapping[str, Any]) -> Reply:
        _refuse(self._needed_rig.brain.pause())
        return {}

    async def _resume(self, _request: Mapping[str, Any]) -> Reply:
        _refuse(self._needed_rig.brain.resume())
        return {}

    async def _unlock(self, _request: Mapping[str, Any]) -> Reply:
        _refuse(await self._needed_rig.loop.unlock())
        return {}

    async def _tare(self, request: Mapping[str, Any]) -> Reply:
        tares: dict[str, Callable[[], None]] = {name: one.tare for name, one in self._estimations.items()}
        if self._skin is not None:
            tares[SKIN] = self._skin.tare
        if self._load_cell is not None:
            tares[LOAD_CELL] = self._load_cell.tare
        source = request.get("source")
        if source is not None and not (isinstance(source, str) and source in tares):
            raise CommandRefusedError(f"there is no sensor {source!r} to tare; there are {', '.join(tares)}")
        tared = [source] if source is not None else list(tares)
        for name in tared:
            tares[name]()
        return {"tared": tared}

    async def _set(self, request: Mapping[str, Any]) -> Reply:
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

    async def _status(self, _request: Mapping[str, Any]) -> Reply:
        return {"tasks": self._health.tasks()}

    async def _stop_wanted(self, request: Mapping[str, Any]) -> Reply:
        stopped = self._rig.stop() if self._rig is not None else ""
        awaited, self._awaited = self._awaited, None
        if stopped:
            return {"stopped": stopped}
        if request.get("spare_daemon"):
            # From a page that everyone may press stop on: it ends what moves or is about to, and nothing else.
            return {"stopped": f"the start of {awaited.name}" if awaited is not None else ""}
        # Nothing moves: the daemon itself is what stops, once the reply is out.
        asyncio.get_running_loop().call_later(0.05, self.stop)
        return {}


def _refuse(why: str | None) -> None:
    if why:
        raise CommandRefusedError(why)


def _sources(config: DaemonConfig) -> dict[str, Source]:
    """Return how often each sensor's torque comes; the mean of several frames speaks of a longer time."""
    sources = {
        name: Source(name=name, period_s=own.frame_period_s, window_s=own.frame_period_s * own.average_frames)
        for name, own in config.fingertips.items()
    }
    if config.both is not None:
        period_s = max(own.frame_period_s for own in config.fingertips.values())
        sources[BOTH] = Source(name=BOTH, period_s=period_s, window_s=period_s)
    skin = skin_source(config.skin) if config.skin is not None else None
    return sources if skin is None else {**sources, skin.name: skin}


def _recorder(
    config: DaemonConfig,
    publisher: Publisher,
    clock: Clock,
    busy: Callable[[], bool],
    on_failure: Callable[[str], None],
) -> Recorder | None:
    """Return what records all that is published, where that is configured; raises UserError where it cannot."""
    if config.recording is None:
        return None
    recorder = Recorder(config.recording.folder, identity_of(config), clock, busy=busy, on_failure=on_failure)
    publisher.listen(recorder.record)
    return recorder


def _passed_on(both: BothTask | None, name: str) -> Mapping[str, Any]:
    return {"pass_on": partial(both.take, name)} if both is not None and name in both.sides else {}


def _board(config: Fingertip, on_event: Callable[[LinkEvent], None], tap: Tap) -> EitKit:
    return EitKit(
        path=config.device.path,
        serial_number=config.device.serial_number,
        zero_slots=ZERO_SLOTS,
        frame_period_s=config.frame_period_s,
        on_event=on_event,
        tap=tap,
    )


async def run_daemon(config: DaemonConfig, listeners: tuple[Listener, ...] = ()) -> None:
    """Run a daemon until SIGINT, SIGTERM or the command `stop`."""
    loop = asyncio.get_running_loop()
    with zmq.asyncio.Context() as context:
        daemon = Daemon(config, context)
        for listener in listeners:
            daemon.publisher.listen(listener)
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, daemon.stop)
        try:
            await daemon.run()
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.remove_signal_handler(number)
