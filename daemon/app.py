"""The daemon: builds and connects devices, estimators, control loop and sockets, and runs their tasks."""

import asyncio
import contextlib
import signal
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import structlog
import zmq
import zmq.asyncio

from shearloop.bank.eit.channels import ZERO_SLOTS
from shearloop.daemon.clock import Clock
from shearloop.daemon.commands import Commands, required_rig
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.configured_experiment import ConfiguredExperiment
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.health import HealthReporter, TaskFacts
from shearloop.daemon.logs import LinkLog
from shearloop.daemon.messaging.addresses import local_stop_address
from shearloop.daemon.messaging.command_server import CommandServer
from shearloop.daemon.messaging.keys import CurveAuthenticator, load_server_keys
from shearloop.daemon.messaging.publisher import Listener, Publisher
from shearloop.daemon.recording.recorder import AttachedFile, Recorder, daemon_identity, experiment_notes
from shearloop.daemon.rig import Rig, check_experiment, load_cell_calibration
from shearloop.daemon.sensing.estimators import COMBINED, LiveEstimator, open_combined, open_estimator, torque_sources
from shearloop.daemon.sensing.fingertip_task import CombinedFingertips, FingertipEstimates, FingertipTask
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL, LoadCellTask
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_SOURCE, RecordedSkin, SkinTask
from shearloop.daemon.sensing.tool_diameter import FingertipDiameters
from shearloop.daemon.service import notify
from shearloop.daemon.signals import ending_signals
from shearloop.daemon.supervisor import Supervisor
from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.serial_sensor import InputRecorder


class Daemon:
    """All parts of one running daemon."""

    def __init__(self, config: DaemonConfig, context: zmq.asyncio.Context) -> None:
        """Open every file of the configuration and bind the sockets; devices may connect later."""
        self._config = config
        self._clock = Clock()
        self.supervisor = Supervisor()
        self._stop = asyncio.Event()
        self._tasks: dict[str, Callable[[], Awaitable[None]]] = {}
        self._tares: dict[str, Callable[[], None]] = {}
        self._rig: Rig | None = None
        self._experiment: ConfiguredExperiment | None = None
        estimators = {name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()}
        combined = open_combined(config.combined, config.fingertips) if config.combined is not None else None
        sources = torque_sources(config, estimators, combined)
        check_experiment(config, sources)
        with contextlib.ExitStack() as opened:
            keys = load_server_keys(config.curve.server_key) if config.curve is not None else None
            self._authenticator: CurveAuthenticator | None = None
            if config.curve is not None and config.network_addresses:
                self._authenticator = CurveAuthenticator(context, config.curve.clients)
                opened.callback(self._authenticator.close)
            self.publisher = Publisher(context, config.publish, self._clock, keys)
            opened.callback(self.publisher.close)
            self.health = HealthReporter(self.publisher, self.supervisor, self._clock)
            self._recorder = self._open_recorder()
            if self._recorder is not None:
                opened.callback(self._recorder.close)
            self._connect(estimators, combined, sources)
            self.commands = Commands(
                rig=self._rig,
                tares=self._tares,
                fingertips=self._fingertips,
                experiment=config.experiment,
                start=self.start_experiment,
                call_off_experiment=self._call_off_experiment,
                tasks=self.health.tasks,
                stop=self.stop,
            )
            self._commands = CommandServer(context, config.commands, self.commands.handlers(), keys)
            opened.callback(self._commands.close)
            self._open_stop: CommandServer | None = None
            if "commands" in config.network_addresses:
                address = local_stop_address(config.commands)
                self._open_stop = CommandServer(context, address, self.commands.open_handlers())
                opened.callback(self._open_stop.close)
            self._close = opened.pop_all().close
        self._add_service_tasks()

    def _add(
        self,
        name: str,
        run: Callable[[], Awaitable[None]],
        diagnostics: Callable[[], TaskFacts] | None = None,
        tare: Callable[[], None] | None = None,
    ) -> None:
        """Add a task with its diagnostics for `health` and its tare for the command."""
        self._tasks[name] = run
        if diagnostics is not None:
            self.health.add(name, diagnostics)
        if tare is not None:
            self._tares[name] = tare

    def _connect(
        self,
        estimators: Mapping[str, LiveEstimator],
        combined: LiveEstimator | None,
        sources: Mapping[str, TorqueSource],
    ) -> None:
        """Create and connect the tasks of devices and estimators; no device is opened yet."""
        config, publisher, clock = self._config, self.publisher, self._clock
        diameters = FingertipDiameters(COMBINED)
        if config.robot is not None:
            dead_tasks = self.supervisor.dead
            self._rig = Rig(config, publisher, clock, sources, self._tare, dead_tasks, diameters.latest)
        on_torque = self._rig.control_loop.on_torque if self._rig is not None else lambda _: None

        gripper = self._rig.gripper if self._rig is not None else None

        def estimates(name: str, estimator: LiveEstimator) -> FingertipEstimates:
            return FingertipEstimates(
                name,
                estimator,
                publisher,
                clock,
                loop=self._rig.control_loop if self._rig is not None else None,
                gripper=gripper,
                diameters=diameters,
                inputs=self._inputs(name),
            )

        pairs: CombinedFingertips | None = None
        if combined is not None:
            period_s = config.fingertips[combined.calibration.sides[0]].frame_period_s
            pairs = CombinedFingertips(estimates(COMBINED, combined), period_s)

        def fingertip_task(name: str, estimator: LiveEstimator) -> FingertipTask:
            own = config.fingertips[name]
            board = EitKit(
                path=own.device.path,
                serial_number=own.device.serial_number,
                zero_slots=ZERO_SLOTS,
                frame_period_s=own.frame_period_s,
                monitor=self._link_monitor(name),
                inputs=self._inputs(name),
            )
            return FingertipTask(
                board, estimates(name, estimator), publisher, pairs, always_heatmap=own.heatmap == "always"
            )

        self._fingertips = {name: fingertip_task(name, estimator) for name, estimator in estimators.items()}
        self._estimates = {name: task.estimates for name, task in self._fingertips.items()}
        for name, task in self._fingertips.items():
            self._add(name, task.run, task.diagnostics, task.estimates.tare)
        if pairs is not None:
            self._estimates[COMBINED] = pairs.estimates
            self.health.add(COMBINED, pairs.diagnostics)
            self._tares[COMBINED] = pairs.estimates.tare
        self._skin: SkinTask | None = None
        if config.skin is not None:
            inputs = {name: self._inputs(name) for name in RecordedSkin.sources}
            self._skin = SkinTask(config.skin, publisher, clock, on_torque, inputs)
            self._add(SKIN, self._skin.read, self._skin.diagnostics, self._skin.tare)
            self._add(SKIN_SOURCE, self._skin.watch_source, self._skin.source_diagnostics)
        self._load_cell: LoadCellTask | None = None
        if config.load_cell is not None:
            port, rate_hz = config.load_cell.device, config.load_cell.rate_hz
            board = LoadCell(
                load_cell_calibration(config.load_cell),
                serial_number=port.serial_number,
                path=port.path,
                rate_hz=rate_hz,
                monitor=self._link_monitor(LOAD_CELL),
                inputs=self._inputs(LOAD_CELL),
            )
            self._load_cell = LoadCellTask(board, publisher, clock, on_torque, rate_hz)
            self._add(LOAD_CELL, self._load_cell.read, self._load_cell.diagnostics, self._load_cell.tare)
        if self._rig is not None:
            if self._rig.gripper is not None:
                self._add("gripper", self._rig.gripper.read, self._rig.gripper.diagnostics)
            self._add("robot", self._rig.robot.run, self._rig.runner.diagnostics)
            self._add("loop", self._rig.runner.run)

    def _add_service_tasks(self) -> None:
        if self._rig is not None and self._config.experiment is not None:
            ended = self._rig.runner.experiment_ended
            self._experiment = ConfiguredExperiment(self._config.experiment, self.start_experiment, ended)
            self._add("experiment", partial(self._run_experiment, self._experiment))
        if self._recorder is not None:
            self._add("recording", partial(self._record, self._recorder), self._recorder.diagnostics)
        self._add("commands", self._commands.run, self._command_diagnostics)
        if self._authenticator is not None:
            self._add("keys", self._authenticator.run)
        if self._open_stop is not None:
            self._add("open_stop", self._open_stop.run)
        self._add("health", self.health.run)

    async def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`, then end every task and close the sockets; `on_ready` is called once the tasks run."""
        try:
            await self._run_tasks(on_ready)
            if self._experiment is not None:
                self._experiment.close()
        finally:
            try:
                if self._recorder is not None:
                    # It may wait for the disk.
                    await asyncio.to_thread(self._recorder.close)
            finally:
                # Each part, even if another one fails to close.
                self._close()
                self._log_recordings()
        structlog.get_logger().info("stopped")

    async def _run_tasks(self, on_ready: Callable[[], None]) -> None:
        async with asyncio.TaskGroup() as group:
            running = [
                group.create_task(self.supervisor.keep_running(name, run), name=name)
                for name, run in self._tasks.items()
            ]
            structlog.get_logger().info("running", fingertips=list(self._fingertips))
            on_ready()
            notify("READY=1")
            await self._stop.wait()
            notify("STOPPING=1")
            if self._rig is not None:
                self._rig.close()
                if self._experiment is not None:
                    await self._experiment.wait_for_report()
                await self._rig.runner.released()
            for task in running:
                task.cancel()

    def stop(self) -> None:
        """End `run` as soon as the tasks have ended."""
        self._stop.set()

    @property
    def finished(self) -> bool:
        """Whether the experiment that ends the daemon is done; True without one."""
        return self._experiment is None or self._experiment.done or not self._config.stop_when_done

    async def stopped(self) -> None:
        """Wait for a call of `stop`."""
        await self._stop.wait()

    async def _run_experiment(self, experiment: ConfiguredExperiment) -> None:
        await experiment.run()
        if self._config.stop_when_done:
            if experiment.left_to_operator:
                await experiment.wait_for_end()
            self.stop()

    async def start_experiment(self, path: Path) -> str | None:
        """Start and record an experiment; return None, or why not. Raises UserError for an invalid file."""
        rig, recorder = required_rig(self._rig), self._recorder
        attached = AttachedFile.read(path) if recorder is not None else ()
        reason = await rig.start(path)
        if reason is None and self._experiment is not None:
            self._experiment.on_begun(path)
        if reason is None and recorder is not None and rig.control_loop.experiment is not None:
            file = rig.control_loop.experiment.file
            recorder.record_experiment(file.name, attached, experiment_notes(file))
        return reason

    def _call_off_experiment(self) -> Path | None:
        """Cancel the automatic start of the configured experiment; return it, or None if it was not awaited."""
        return self._experiment.call_off() if self._experiment is not None else None

    def _open_recorder(self) -> Recorder | None:
        """Return the recorder, if one is configured; raises UserError if it cannot write."""
        if self._config.recording is None:
            return None
        recorder = Recorder(self._config.recording.folder, daemon_identity(self._config), self._clock)
        self.publisher.add_listener(recorder.record_message)
        return recorder

    def _inputs(self, source: str) -> InputRecorder | None:
        return self._recorder.input_recorder(source) if self._recorder is not None else None

    def _link_monitor(self, device: str) -> LinkMonitor:
        return self._rig.monitor(device) if self._rig is not None else LinkMonitor(LinkLog(device))

    async def _record(self, recorder: Recorder) -> None:
        async for failure in recorder.flushes():
            if self._rig is not None:
                self._rig.control_loop.inputs.recording_error = failure

    def _log_recordings(self) -> None:
        if self._recorder is None:
            return
        for path in self._recorder.finished:
            structlog.get_logger().info("recorded", file=str(path))
        if self._recorder.failure:
            structlog.get_logger().error("the recording could not be finished", reason=self._recorder.failure)

    def _command_diagnostics(self) -> TaskFacts:
        """Return the numbers of refused commands and clients, by kind."""
        refused = self._commands.refused.copy()
        for other in (self._authenticator, self._open_stop):
            if other is not None:
                refused.update(other.refused)
        return {"errors": dict(refused)}

    async def _tare(self) -> str:
        """Zero every torque sensor; return the errors, or an empty string."""
        tares = [each.tare_and_wait() for each in self._estimates.values()]
        if self._skin is not None:
            tares.append(self._skin.zero())
        if self._load_cell is not None:
            tares.append(self._load_cell.zero())
        return " ".join(filter(None, await asyncio.gather(*tares)))


async def run_daemon(
    config: DaemonConfig,
    listeners: tuple[Listener, ...] = (),
    facts: Mapping[str, Callable[[], TaskFacts]] = MappingProxyType({}),
    on_ready: Callable[[], None] = lambda: None,
) -> bool:
    """Run a daemon until SIGINT, SIGTERM, SIGHUP or the command `stop`; return whether it ended as planned.

    It ended as planned if its experiment is done, or by SIGTERM or SIGHUP. `listeners` receive every message; `facts`
    are their parts of `health`, by name; `on_ready` is called once all tasks run. SIGTERM and SIGHUP are ignored
    afterwards.
    """
    loop, terminated = asyncio.get_running_loop(), False

    def terminate() -> None:
        nonlocal terminated
        terminated = True
        daemon.stop()

    with zmq.asyncio.Context() as context:
        daemon = Daemon(config, context)
        for listener in listeners:
            daemon.publisher.add_listener(listener)
        for name, diagnostics in facts.items():
            daemon.health.add(name, diagnostics)
        ending = ending_signals()
        for number in ending:
            loop.add_signal_handler(number, daemon.stop if number == signal.SIGINT else terminate)
        try:
            await daemon.run(on_ready)
        finally:
            for number in ending:
                loop.remove_signal_handler(number)
                if number != signal.SIGINT:
                    # A second one must not kill us before emulators have ended and the output is written.
                    signal.signal(number, signal.SIG_IGN)
    return daemon.finished or terminated
