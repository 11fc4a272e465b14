"""The daemon: builds and connects devices, estimators, control loop and sockets, and runs their tasks."""

import asyncio
import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import structlog
import zmq
import zmq.asyncio

from shearloop.bank.eit.channels import ZERO_SLOTS
from shearloop.daemon.clock import Clock
from shearloop.daemon.commands import Commands, required_rig
from shearloop.daemon.config import DaemonConfig, FingertipConfig
from shearloop.daemon.control.configured_experiment import ConfiguredExperiment
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.health import HealthReporter, TaskFacts
from shearloop.daemon.logs import log_link
from shearloop.daemon.messaging.addresses import local_stop_address
from shearloop.daemon.messaging.command_server import CommandServer
from shearloop.daemon.messaging.keys import CurveAuthenticator, load_server_keys
from shearloop.daemon.messaging.publisher import Listener, Publisher
from shearloop.daemon.recording.identity import AttachedFile, daemon_identity, experiment_notes
from shearloop.daemon.recording.recorder import Recorder
from shearloop.daemon.rig import Rig, check_experiment, make_load_cell
from shearloop.daemon.sensing.estimators import COMBINED, LiveEstimator, open_combined, open_estimator, torque_sources
from shearloop.daemon.sensing.fingertip_task import CombinedFingertipTask, EstimatorTask, FingertipTask
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_SOURCE, SkinTask
from shearloop.daemon.sensing.tool_diameter import FingertipDiameters
from shearloop.daemon.service import notify
from shearloop.daemon.signals import ending_signals
from shearloop.daemon.supervisor import Supervisor
from shearloop.drivers.connection import LinkEvent
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.serial_sensor import OnRaw, ignore_raw


class Daemon:
    """All parts of one running daemon."""

    def __init__(self, config: DaemonConfig, context: zmq.asyncio.Context) -> None:
        """Open every file of the configuration and bind the sockets; devices may connect later."""
        self._config = config
        self._clock = Clock()
        self.supervisor = Supervisor()
        self._stop = asyncio.Event()
        self._rig: Rig | None = None
        self._experiment: ConfiguredExperiment | None = None
        estimators = {name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()}
        combined = open_combined(config.combined, config.fingertips) if config.combined is not None else None
        sources = torque_sources(config, estimators, combined)
        check_experiment(config, sources)
        with contextlib.ExitStack() as opened:
            keys = load_server_keys(config.curve.server_key) if config.curve is not None else None
            self._gate: CurveAuthenticator | None = None
            if config.curve is not None and config.network_addresses:
                self._gate = CurveAuthenticator(context, config.curve.clients)
                opened.callback(self._gate.close)
            self.publisher = Publisher(context, config.publish, self._clock, keys)
            opened.callback(self.publisher.close)
            self._recorder = _recorder(config, self.publisher, self._clock, self._busy, self._on_recording_error)
            if self._recorder is not None:
                opened.callback(self._recorder.close)
            self._wire(estimators, combined, sources)
            self.health = self._make_health()
            commands = self._make_commands()
            self._commands = CommandServer(context, config.commands, commands.handlers(), keys)
            opened.callback(self._commands.close)
            self._open_stop: CommandServer | None = None
            if "commands" in config.network_addresses:
                address = local_stop_address(config.commands)
                self._open_stop = CommandServer(context, address, commands.open_handlers())
                opened.callback(self._open_stop.close)
            self._close = opened.pop_all().close

    def _wire(
        self,
        estimators: Mapping[str, LiveEstimator],
        combined: LiveEstimator | None,
        sources: Mapping[str, TorqueSource],
    ) -> None:
        """Create the tasks of devices and estimators; no device is opened yet."""
        config = self._config
        diameters = FingertipDiameters(COMBINED)
        if config.robot is not None:
            self._rig = Rig(
                config,
                self.publisher,
                self._clock,
                sources,
                self._tare_to_the_end,
                self.supervisor.deaths,
                self._tap,
                diameters.latest,
            )
            if config.experiment is not None:
                self._experiment = ConfiguredExperiment(
                    config.experiment, self.start_experiment, self._rig.runner.experiment_ended
                )
        on_torque = self._rig.control_loop.on_torque if self._rig is not None else lambda _: None
        self._load_cell = self._rig.load_cell if self._rig is not None else None
        if self._rig is None and config.load_cell is not None:
            # Measured and recorded while another machine twists.
            self._load_cell = make_load_cell(
                config.load_cell, self.publisher, self._clock, on_torque, self._on_link(LOAD_CELL), self._tap(LOAD_CELL)
            )
        self._skin: SkinTask | None = None
        if config.skin is not None:
            self._skin = SkinTask(config.skin, self.publisher, self._clock, on_torque, self._tap)

        gripper = self._rig.gripper if self._rig is not None else None

        def estimator_task(name: str, estimator: LiveEstimator, period_s: Callable[[], float]) -> EstimatorTask:
            return EstimatorTask(
                name,
                estimator,
                self.publisher,
                self._clock,
                period_s=period_s,
                on_torque=on_torque,
                on_diameter=diameters.update,
                held_tool=gripper.held_tool if gripper is not None else lambda _: None,
                on_raw=self._tap(name),
            )

        self._combined: CombinedFingertipTask | None = None
        if combined is not None:
            period_s = config.fingertips[combined.calibration.sides[0]].frame_period_s
            self._combined = CombinedFingertipTask(estimator_task(COMBINED, combined, lambda: period_s), period_s)

        def fingertip(name: str, estimator: LiveEstimator) -> FingertipTask:
            board = _board(config.fingertips[name], name, self._on_link(name), self._tap(name), self._combined)
            return FingertipTask(
                board,
                estimator_task(name, estimator, lambda: board.period_s),
                self.publisher,
                self._combined,
                always_heatmap=config.fingertips[name].heatmap == "always",
            )

        self._fingertips = {name: fingertip(name, estimator) for name, estimator in estimators.items()}
        self._estimators = {name: task.estimator_task for name, task in self._fingertips.items()}
        if self._combined is not None:
            self._estimators[COMBINED] = self._combined.estimator_task

    def _make_commands(self) -> Commands:
        tares: dict[str, Callable[[], None]] = {name: one.tare for name, one in self._estimators.items()}
        if self._skin is not None:
            tares[SKIN] = self._skin.tare
        if self._load_cell is not None:
            tares[LOAD_CELL] = self._load_cell.tare
        return Commands(
            rig=self._rig,
            tares=tares,
            fingertips=self._fingertips,
            experiment=self._config.experiment,
            start=self.start_experiment,
            call_off_experiment=self._call_off_experiment,
            tasks=self.health.tasks,
            stop=self.stop,
        )

    def _make_health(self) -> HealthReporter:
        health = HealthReporter(self.publisher, self.supervisor, self._clock)
        for name, task in self._fingertips.items():
            health.add(name, task.diagnostics)
        if self._combined is not None:
            health.add(COMBINED, self._combined.diagnostics)
        if self._skin is not None:
            health.add(SKIN, self._skin.diagnostics)
            health.add(SKIN_SOURCE, self._skin.source_diagnostics)
        if self._load_cell is not None:
            health.add(LOAD_CELL, self._load_cell.diagnostics)
        if self._rig is not None:
            health.add("robot", self._rig.runner.diagnostics)
            if self._rig.gripper is not None:
                health.add("gripper", self._rig.gripper.diagnostics)
        if self._recorder is not None:
            health.add("recording", self._recorder.diagnostics)
        health.add("commands", self._command_facts)
        return health

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
            running = [group.create_task(task, name=name) for name, task in self._tasks()]
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
        """Whether the experiment that ends the daemon is done, or there is none."""
        return self._experiment is None or self._experiment.done or not self._config.stop_when_done

    async def stopped(self) -> None:
        """Wait for a call of `stop`."""
        await self._stop.wait()

    def _tasks(self) -> Iterator[tuple[str, Any]]:
        def supervised(name: str, run: Callable[[], Any]) -> tuple[str, Any]:
            return name, self.supervisor.keep_running(name, run)

        for name, task in self._fingertips.items():
            yield supervised(name, task.read)
            yield supervised(f"{name}.estimator", task.estimate)
        if self._combined is not None:
            yield supervised(COMBINED, self._combined.estimator_task.run)
        if self._skin is not None:
            yield supervised(SKIN, self._skin.read)
            yield supervised(SKIN_SOURCE, self._skin.watch_source)
        if self._load_cell is not None:
            yield supervised(LOAD_CELL, self._load_cell.read)
        if self._rig is not None:
            for name, run in self._rig.tasks():
                yield supervised(name, run)
            if self._experiment is not None:
                yield supervised("experiment", partial(self._run_experiment, self._experiment))
        if self._recorder is not None:
            yield supervised("recording", self._recorder.run)
        yield supervised("commands", self._commands.run)
        if self._gate is not None:
            yield supervised("keys", self._gate.run)
        if self._open_stop is not None:
            yield supervised("open_stop", self._open_stop.run)
        yield supervised("health", self.health.run)

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

    def _tap(self, source: str) -> OnRaw:
        return ignore_raw if self._recorder is None else self._recorder.input_recorder(source)

    def _busy(self) -> bool:
        """Return whether an experiment is running."""
        experiment = self._rig.control_loop.experiment if self._rig is not None else None
        return experiment is not None and experiment.running

    def _on_recording_error(self, error: str) -> None:
        if self._rig is not None:
            self._rig.control_loop.inputs.recording_error = error

    def _log_recordings(self) -> None:
        if self._recorder is None:
            return
        for path in self._recorder.finished:
            structlog.get_logger().info("recorded", file=str(path))
        if self._recorder.failure:
            structlog.get_logger().error("the recording could not be finished", why=self._recorder.failure)

    def _on_link(self, device: str) -> Callable[[LinkEvent], None]:
        return self._rig.on_link(device) if self._rig is not None else partial(log_link, device)

    def _command_facts(self) -> TaskFacts:
        """Return the numbers of refused commands and clients, by kind."""
        refused = self._commands.refused.copy()
        for other in (self._gate, self._open_stop):
            if other is not None:
                refused.update(other.refused)
        return {"errors": dict(refused)}

    async def _tare_to_the_end(self) -> str:
        tares = [one.tare_and_wait() for one in self._estimators.values()]
        if self._skin is not None:
            tares.append(self._skin.zero())
        return " ".join(filter(None, await asyncio.gather(*tares)))


def _recorder(
    config: DaemonConfig,
    publisher: Publisher,
    clock: Clock,
    busy: Callable[[], bool],
    on_failure: Callable[[str], None],
) -> Recorder | None:
    """Return the recorder, if one is configured; raises UserError if it cannot write."""
    if config.recording is None:
        return None
    recorder = Recorder(config.recording.folder, daemon_identity(config), clock, is_busy=busy, on_failure=on_failure)
    publisher.add_listener(recorder.record_message)
    return recorder


def _board(
    config: FingertipConfig,
    name: str,
    on_event: Callable[[LinkEvent], None],
    tap: OnRaw,
    combined: CombinedFingertipTask | None,
) -> EitKit:
    return EitKit(
        path=config.device.path,
        serial_number=config.device.serial_number,
        zero_slots=ZERO_SLOTS,
        frame_period_s=config.frame_period_s,
        on_event=on_event,
        on_raw=tap,
        **({"on_frame": partial(combined.on_frame, name)} if combined is not None else {}),
    )


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
        for name, told in facts.items():
            daemon.health.add(name, told)
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
