"""The daemon: builds and connects devices, estimators, control loop and sockets, and runs their tasks."""

import asyncio
import contextlib
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import structlog
import zmq
import zmq.asyncio

from shearloop.daemon.clock import Clock
from shearloop.daemon.commands import Answered, Commands
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.messaging.callers import caller_of
from shearloop.daemon.messaging.client_authenticator import ClientAuthenticator
from shearloop.daemon.messaging.command_server import CommandServer
from shearloop.daemon.messaging.messages import DaemonCommand
from shearloop.daemon.messaging.publisher import Listener, Publisher
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_socket import StopSocket
from shearloop.daemon.process import ending_signals
from shearloop.daemon.run_summary import RunSummary
from shearloop.daemon.running_rig import RunningRig
from shearloop.daemon.sd_notify import notify
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.daemon.sensors import Sessions, build_sensors, open_sessions
from shearloop.daemon.supervisor import MAX_ERROR_LENGTH, HealthReporter, Reporter, Supervisor, Task
from shearloop.daemon.torques import LatestTorques
from shearloop.drivers.connection import Diagnostics
from shearloop.printable import printable

if TYPE_CHECKING:
    # Only a rig with a robot, or one that records, or one with a network address, loads them.
    from shearloop.daemon.configured_experiment import ConfiguredExperiment
    from shearloop.daemon.messaging.keys import KeyPair
    from shearloop.daemon.recorder.recorder import Recorder
    from shearloop.daemon.rig import Rig
    from shearloop.daemon.robot_files import RobotFiles
    from shearloop.drivers.ur.settings import UrSettings

# The end waits this long for the report of an experiment that it has stopped; a dead loop reports none.
REPORTED_WITHIN_S = 0.2


@dataclass(frozen=True, slots=True)
class RecordingTask:
    """Writes the recording, and hands its errors to the control loop."""

    recorder: "Recorder"
    rig: "Rig | None"

    async def run(self) -> None:
        """Write until cancelled."""
        async for failure in self.recorder.flushes():
            if self.rig is not None:
                self.rig.control_loop.on_recording_error(failure)

    def diagnostics(self) -> Diagnostics:
        """Return the recorder's state for `health`."""
        return self.recorder.diagnostics()


class Daemon:
    """All parts of one running daemon."""

    def __init__(self, config: DaemonConfig, context: zmq.asyncio.Context, summary: RunSummary | None = None) -> None:
        """Open every file of the configuration and bind the sockets; devices may connect later."""
        clock = Clock()
        self.supervisor = Supervisor()
        self._summary = summary or RunSummary()
        self.ending = asyncio.Event()
        with contextlib.ExitStack() as opened:
            keys = _server_keys(config)
            refusals = Refusals()
            # It must exist before a socket is bound.
            clients = config.curve.clients if config.curve is not None and config.network_addresses else None
            authenticator = ClientAuthenticator(context, clients, refusals)
            opened.callback(authenticator.close)
            robot = _take_robot(config, opened)
            self.publisher = opened.enter_context(contextlib.closing(Publisher(context, config.publish, clock, keys)))
            self.publisher.add_listener(self._summary)
            sessions = open_sessions(config)
            self.recorder = _recorder_of(config, sessions, clock)
            if self.recorder is not None:
                self.publisher.add_listener(self.recorder.record_message)
                opened.callback(self.recorder.close)
            running_rig = RunningRig.of(config, robot[0].host if robot is not None else None)
            self.health = HealthReporter(self.publisher, self.supervisor, clock, running_rig)
            self.rig: Rig | None = None
            self._experiment: ConfiguredExperiment | None = None
            torques = LatestTorques()
            if robot is not None:
                self._build_rig(config, *robot, sessions, clock)
            else:
                self.sensors = build_sensors(config, self.publisher, clock, self.recorder, sessions, torques)
            tare_refusal = torques.tare_refusal if self.rig is None else self.rig.tare_refusal
            self.health.refusals["tare"] = tare_refusal
            report = partial(self._report, clock)
            self.commands = Commands(
                self.rig, self.sensors, self._experiment, self.health, self.ending, tare_refusal, report, running_rig
            )
            emulated, handlers = running_rig.emulated, self.commands.handlers()
            server = CommandServer(context, config.commands, handlers, refusals, keys, emulated=emulated)
            opened.callback(server.close)
            stop_socket = StopSocket(server.address, self.commands.keyless_handlers(), refusals, emulated=emulated)
            opened.callback(stop_socket.close)
            self._close = opened.pop_all().close
        tasks: dict[str, Task | None] = {
            **self.sensors.tasks,
            **(self.rig.tasks if self.rig is not None else {}),
            "experiment": self._experiment,
            "recording": RecordingTask(self.recorder, self.rig) if self.recorder is not None else None,
            "clients": authenticator,
            "commands": server,
            "stop": stop_socket,
            "publish": self.publisher,
            "health": self.health,
        }
        self.tasks = {name: task for name, task in tasks.items() if task is not None}
        for name, part in {**self.tasks, COMBINED: self.sensors.combined, "commands": refusals}.items():
            if isinstance(part, Reporter):
                self.health.reporters[name] = part

    def _build_rig(
        self, config: DaemonConfig, settings: "UrSettings", files: "RobotFiles", sessions: Sessions, clock: Clock
    ) -> None:
        """Build robot, gripper and control loop, and the sensors that drive it."""
        # Only a rig with a robot loads their modules.
        from shearloop.daemon.configured_experiment import ConfiguredExperiment
        from shearloop.daemon.rig import build_rig

        self.sensors, self.rig = build_rig(
            config, settings, files, sessions, self.publisher, clock, self.recorder, self.supervisor,
            self.health.running_rig.instance,
        )  # fmt: skip
        self.health.cap = partial(getattr, self.rig.commissioning, "sentence")
        self.health.refusals |= {"start": self.rig.start_refusal, "release": self.rig.runner.release_refusal}
        if config.experiment is not None:
            daemon_end = self.ending if config.stop_when_done else None
            self._experiment = ConfiguredExperiment(
                config.experiment, self.rig, autostart=config.autostart, daemon_end=daemon_end
            )

    async def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`, then end every task and close the sockets; `on_ready` is called once the tasks run."""
        try:
            await self._run_tasks(on_ready)
            if self.rig is not None:
                await self.rig.memory.save_present()
            self.health.publish_end(finished=self.finished, summary=self._summary.text)
        finally:
            try:
                if self.recorder is not None:
                    # It may wait for the disk.
                    await asyncio.to_thread(self.recorder.close)
            finally:
                # Each part, even if another one fails to close.
                self._close()
                self._log_recordings()
        structlog.get_logger().info("stopped")

    async def _run_tasks(self, on_ready: Callable[[], None]) -> None:
        async with asyncio.TaskGroup() as group:
            running = {
                name: group.create_task(self.supervisor.keep_running(name, task), name=name)
                for name, task in self.tasks.items()
            }
            structlog.get_logger().info("running", sensors=list(self.sensors.tareable))
            on_ready()
            notify("READY=1")
            await self.ending.wait()
            notify("STOPPING=1")
            if self.rig is not None:
                self.rig.runner.close()
                if self._experiment is not None and self._experiment.has_begun.is_set():
                    await asyncio.wait({running["experiment"]}, timeout=REPORTED_WITHIN_S)
                await self.rig.runner.halt_and_wait()
            for task in running.values():
                task.cancel()

    def stop(self) -> None:
        """End `run` as soon as the tasks have ended."""
        self.ending.set()

    def _report(self, clock: Clock, answered: Answered) -> None:
        """Publish a command and its answer."""
        name, request, refusal = answered
        subject, request_id = request.get("experiment") or request.get("source"), request.get("request_id")
        answer = DaemonCommand(
            source="daemon",
            t_mono_ns=clock.now_ns(),
            command=name,
            subject=printable(subject)[:MAX_ERROR_LENGTH] if isinstance(subject, str) else "",
            by=caller_of(request),
            request_id=printable(request_id)[:MAX_ERROR_LENGTH] if isinstance(request_id, str) else "",
            accepted=refusal is None,
            reason=refusal or "",
        )
        self.publisher.publish(answer)

    def _log_recordings(self) -> None:
        if self.recorder is None:
            return
        for path in self.recorder.closed_files:
            if path.exists():
                structlog.get_logger().info("recorded", file=str(path))
            else:
                structlog.get_logger().error("the recorded file was removed", file=str(path))
        if self.recorder.failure:
            structlog.get_logger().error("the recording could not be finished", reason=self.recorder.failure)

    @property
    def finished(self) -> bool:
        """Whether the experiment that ends the daemon is done; True without one."""
        return self._experiment is None or self._experiment.finished


def _recorder_of(config: DaemonConfig, sessions: Sessions, clock: Clock) -> "Recorder | None":
    """Return the recorder of a configuration that records."""
    if config.recording is None:
        return None
    from shearloop.daemon.recorder.recorder import Recorder, daemon_identity

    return Recorder(config.recording.folder, daemon_identity(config, sessions.fingertips), clock)


def _server_keys(config: DaemonConfig) -> "KeyPair | None":
    if config.curve is None:
        return None
    from shearloop.daemon.messaging.keys import load_server_keys

    return load_server_keys(config.curve.server_key)


def _take_robot(config: DaemonConfig, opened: contextlib.ExitStack) -> "tuple[UrSettings, RobotFiles] | None":
    """Return the settings and the files of the configured robot, None without one.

    No other daemon drives it while this one is open. Raises DriverError for settings that cannot be used, and UserError
    for a robot that another daemon drives.
    """
    if config.robot is None:
        return None
    from shearloop.daemon.rig import open_settings
    from shearloop.daemon.robot_files import RobotFiles, lock_robot

    settings = open_settings(config)
    if settings is None:
        return None
    files = RobotFiles(settings.host)
    opened.enter_context(lock_robot(files, config.commands, config.gripper_address))
    return settings, files


async def run_daemon(
    config: DaemonConfig,
    listeners: tuple[Listener, ...] = (),
    on_ready: Callable[[], None] = lambda: None,
    summary: RunSummary | None = None,
) -> bool:
    """Run a daemon until SIGINT, SIGTERM, SIGHUP or the command `stop`; return whether it ended as planned.

    It ended as planned if its experiment is done, or by SIGTERM or SIGHUP. `listeners` receive every message;
    `on_ready` is called once all tasks run; `summary` collects the daemon's messages. SIGTERM and SIGHUP are ignored
    afterwards.
    """
    loop, terminated = asyncio.get_running_loop(), False

    def terminate() -> None:
        nonlocal terminated
        terminated = True
        daemon.stop()

    with zmq.asyncio.Context() as context:
        daemon = Daemon(config, context, summary)
        for listener in listeners:
            daemon.publisher.add_listener(listener)
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
