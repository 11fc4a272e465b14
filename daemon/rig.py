"""The rig: builds robot, gripper and control loop from the configuration."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, GripperConfig
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.daemon.control.state_publisher import loop_state
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.experiment_files import ExperimentFiles, ReadExperiment, check_experiment
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.logs import LinkReporter
from shearloop.daemon.messaging.deadlines import NO_DEADLINE, Deadline
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.motion_cap import Commissioning
from shearloop.daemon.patience import EMULATED_PATIENCE, EMULATED_STALE_S, is_patient, patience_of
from shearloop.daemon.questions import Question, QuestionChangedError
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.rig_memory import NoMemory, RigMemory
from shearloop.daemon.robot_files import RobotFiles
from shearloop.daemon.sensing.sessions import COMBINED, torque_sources
from shearloop.daemon.sensors import Sensors, Sessions, build_sensors
from shearloop.daemon.supervisor import Supervisor, Task
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED, Supplied, measured_widths
from shearloop.daemon.torques import WRENCH, TorqueSource
from shearloop.daemon.wrench_zero import WrenchZero
from shearloop.drivers.calibration_files import load_device_calibration
from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.errors import DriverError
from shearloop.drivers.hosts import is_loopback_host, one_spelling
from shearloop.drivers.robotiq.gripper import RobotiqClient, RobotiqGripper
from shearloop.drivers.robotiq.socket_client import REPLY_DEADLINE_S, SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.library import missing_library
from shearloop.drivers.ur.settings import UrSettings, read_settings
from shearloop.errors import Hint, UserError
from shearloop.yaml_files import Document

if TYPE_CHECKING:
    # Only a rig that records loads it.
    from shearloop.daemon.recorder.recorder import Recorder

# What `status` shows of `loop.state`.
LOOP_KEYS = (
    *("phase", "run", "experiment", "step", "steps", "step_name", "activity", "progress"),
    *("stop", "cause", "faults", "reasons", "torque_note"),
)
# The cure of a start that expires while its file is read.
_SLOW_FILE = "copy the file to a local drive, or end what keeps this computer busy; then "


def make_gripper_client(config: GripperConfig, patience: float = 1.0) -> RobotiqClient:
    """Return the gripper's client, not connected yet; `patience` is the factor on the deadline of its replies."""
    if config.socket is not None:
        deadline_s = patience * REPLY_DEADLINE_S
        return SocketClient(config.socket.host, config.socket.port, reply_deadline_s=deadline_s)
    if config.modbus is not None:
        # Imported here: pymodbus is slow to import and rarely used.
        from shearloop.drivers.robotiq import modbus_client

        path = str(config.modbus.path) if config.modbus.path is not None else None
        return modbus_client.ModbusClient(
            serial_number=config.modbus.serial_number,
            path=path,
            reply_deadline_s=patience * modbus_client.REPLY_DEADLINE_S,
        )
    raise ValueError("a gripper needs a socket or modbus")


def gripper_calibration(config: GripperConfig) -> WidthCalibration:
    """Return the gripper's calibration, or the maker's data; raises DriverError if it cannot be used."""
    if config.calibration is None:
        return WidthCalibration.nominal(config.model)
    calibration = load_device_calibration(config.calibration, WidthCalibration)
    if calibration.model != config.model:
        raise DriverError(
            f"{config.calibration}: it was measured with a {calibration.model}, and `gripper.model` is {config.model}; "
            "correct the model, or measure again with `shearloop calibrate gripper --model`"
        )
    return calibration


def robot_settings(path: Path) -> UrSettings:
    """Return the robot's settings; raises DriverError if they, or the library that drives it, cannot be used."""
    settings = read_settings(path)
    if reason := missing_library():
        raise DriverError(f"{path}: {reason}")
    return settings


def open_settings(config: DaemonConfig) -> UrSettings | None:
    """Return the settings to drive the configured robot with, None without one; raises as `configured_settings` does.

    Raises UserError with a line for each reason why a real robot is not driven.
    """
    settings = configured_settings(config)
    if lines := why_not_driven(config, settings):
        raise UserError("\n".join(lines))
    return settings


def why_not_driven(config: DaemonConfig, settings: UrSettings | None) -> list[str]:
    """Return a sentence on each part that a configured robot's settings leave open, and on a gripper elsewhere.

    None for an emulated robot.
    """
    if config.robot is None or settings is None or config.emulated:
        return []
    found = [f"{part} is not filled in: {cure}" for part, cure in settings.left_open().items()]
    if (elsewhere := gripper_elsewhere(config, settings)) is not None:
        found.append(elsewhere.clause)
    stakes = "a real robot does not run before, a rehearsal (`--emulate`) does"
    return [f"{config.robot}: {reason}; {stakes}" for reason in found]


def gripper_elsewhere(config: DaemonConfig, settings: UrSettings) -> Hint | None:
    """Return that the gripper's socket is not at the address of a real robot, with the cure, or None.

    The URCap's socket is on its robot's controller. At another address the fingers of another robot would move.
    """
    address = config.gripper_address
    if address is None or config.emulated or one_spelling(address[0]) == one_spelling(settings.host):
        return None
    return Hint(
        f"`host: {settings.host}` differs from the configuration's `gripper.socket.host: {address[0]}`; the URCap's "
        "socket is on its robot's controller, and the fingers of another robot may move",
        "correct the wrong one of the two",
    )


def configured_settings(config: DaemonConfig) -> UrSettings | None:
    """Return the settings of the configured robot, None without one; raises DriverError as `robot_settings` does.

    Raises UserError for a robot elsewhere in a rig that is said to be emulated.
    """
    if config.robot is None:
        return None
    settings = robot_settings(config.robot)
    if config.emulated and not is_loopback_host(settings.host):
        reason = (
            f"{settings.host} is not this computer, and the configuration says `emulated: true`: take that out for a "
            "real robot, or give 127.0.0.1 for an emulated one"
        )
        raise UserError(*Document.read(config.robot, UserError).located([(("host",), reason)]))
    return with_emulated_deadlines(settings) if is_patient(config) else settings


def keeps_memory(config: DaemonConfig) -> bool:
    """Return whether stops and grips outlive the process, as the devices do.

    Devices that a process emulates end with it, and with them every grip and stop.
    """
    return not (config.autostart or (config.emulated and bool(config.emulators)))


def with_emulated_deadlines(settings: UrSettings) -> UrSettings:
    """Return the settings of an emulated robot, with deadlines that fit a busy computer."""
    return replace(
        settings,
        command_timeout_s=EMULATED_PATIENCE * settings.command_timeout_s,
        silence_timeout_s=EMULATED_PATIENCE * settings.silence_timeout_s,
        state_timeout_s=EMULATED_STALE_S,
        hang_timeout_s=10.0,
    )


def make_loop(
    config: DaemonConfig,
    robot: UrSettings,
    sources: Mapping[str, TorqueSource],
    dead_tasks: Mapping[str, str],
    supplied: Supplied = NOTHING_SUPPLIED,
) -> ControlLoop:
    """Return the control loop of a robot with these settings.

    `sources` are all torques but the robot's; `dead_tasks` has the error of each task that is dead at present;
    `supplied` is of the rig's report.
    """
    sources = {**sources, WRENCH: wrench_source(robot.rate_hz, robot.facts.mean_noise_nm)}
    # Controller, identification and commands plan with what the worker lets through.
    loop = config.loop.within(robot.limits)
    if is_patient(config):
        loop = loop.model_copy(update={"stale_after_s": max(loop.stale_after_s, EMULATED_STALE_S)})
    if supplied.actuation_s is not None and "actuation_s" not in config.loop.model_fields_set:
        loop = loop.model_copy(update={"actuation_s": supplied.actuation_s})
    required = ("robot", "gripper") if config.gripper is not None else ("robot",)
    # Its thread begins with the first check of a gain.
    compute = ThreadPoolExecutor(max_workers=1, thread_name_prefix="gain").submit
    return ControlLoop(loop, sources, required, gels_of(config), dead_tasks, patience_of(config), compute)


def gels_of(config: DaemonConfig) -> dict[str, Creep]:
    """Return the creep of each fingertip, or of all together, whose gel's creep is configured: a new one, at rest."""
    return {
        name: Creep(fingertip.creep.share, fingertip.creep.time_s)
        for name, fingertip in (*config.fingertips.items(), (COMBINED, config.combined))
        if fingertip is not None and fingertip.creep is not None
    }


def make_gripper(
    config: GripperConfig,
    loop: ControlLoop,
    publisher: Publisher,
    clock: Clock,
    patience: float,
    supplied: Supplied = NOTHING_SUPPLIED,
) -> GripperTask:
    """Return the gripper's task; it is not connected yet.

    `patience` is the factor on the deadlines of its replies and states; `supplied` is of the rig's report.
    """
    client, calibration = make_gripper_client(config, patience), gripper_calibration(config)
    measured = measured_widths(supplied, config.model) if config.calibration is None else None
    calibration = measured or calibration
    gripper = RobotiqGripper(client, calibration, monitor=LinkMonitor(LinkReporter("gripper", loop)))
    measures = config.calibration is not None or measured is not None
    diameters = FingertipDiameters(COMBINED, loop.sources)
    return GripperTask(gripper, publisher, loop, diameters, clock, measures, patience)


@dataclass
class Rig:
    """Robot, gripper and the control loop between them, for the operator's experiments.

    `tasks` are by their names in `health`.
    """

    control_loop: ControlLoop
    runner: ControlLoopRunner
    tasks: Mapping[str, Task]
    experiments: ExperimentFiles
    recorder: "Recorder | None"
    # The daemon's own, so that a question of an earlier one asks for another moment.
    instance: str
    memory: RigMemory | NoMemory
    commissioning: Commissioning
    # The file of the experiment that is about to begin.
    starting: str = field(default="", init=False)

    def start_refusal(self) -> str | None:
        """Return why no experiment can begin, or None."""
        return self._start_under_way() or self.runner.start_refusal() or self.memory.error or None

    def tare_refusal(self, *, confirmed: bool = False) -> str | None:
        """Return why no zero may be taken at present, or None; `confirmed`: by the operator, nothing is loaded.

        If an experiment is starting, its first step may grip a tool, and the tool's torque would become the zero.
        """
        return self._start_under_way() or self.control_loop.operator.tare_refusal(confirmed=confirmed)

    def reading_refusal(self) -> str | None:
        """Return why no file of the folders is read for the list now, or None.

        It would hold up the loop, which stops a motion that it cannot watch in time.
        """
        return self._start_under_way() or self.runner.motion()

    def _start_under_way(self) -> str | None:
        return f"{self.starting} is being started; wait until it has begun, or stop it" if self.starting else None

    async def start(
        self, path: Path, digest: str | None = None, deadline: Deadline = NO_DEADLINE, *, confirmed: bool = False
    ) -> str | None:
        """Begin and record the experiment of a file; return None, or why not. Raises UserError for an invalid file.

        `confirmed`: a person says that the tool may drop that the gripper holds, or may hold, where a step opens it.
        `digest` is of the question that a person has confirmed, if one was asked; raises QuestionChangedError where
        another one would be asked now. `deadline` is checked after each wait: a slow drive makes the request too old.
        """
        # While something moves, no file is read.
        if (reason := self.start_refusal()) is not None:
            return reason
        self.starting = path.name
        try:
            return await self._start(path, digest, deadline, confirmed=confirmed)
        finally:
            self.starting = ""

    async def _start(self, path: Path, digest: str | None, deadline: Deadline, *, confirmed: bool) -> str | None:
        stops_before = self.runner.stop_count
        experiment = await self.experiments.read(path)
        if digest is not None and digest != (question := self.question_of(experiment)).digest:
            changed = (
                "since its plan was shown, the file or the effect of its start on a held tool has changed, or "
                "something was stopped or run"
            )
            raise QuestionChangedError(f"{path}: {changed}; look at the plan again", question)
        if (reason := deadline.why_passed("reading its file", _SLOW_FILE, self.runner.stood_s())) is not None:
            return reason
        # A stop since the request is the runner's to answer.
        stopped = self.runner.stop_count != stops_before
        if not stopped and (reason := self.runner.refusal_of(experiment.file, confirmed=confirmed)) is not None:
            return reason
        try:
            reason = await self.memory.begins(experiment.file.name)
            reason = reason or deadline.why_passed("keeping the rig's state", stood_s=self.runner.stood_s())
            if reason is None:
                reason = await self.runner.start(experiment.file, stops_before, deadline, confirmed=confirmed)
        finally:
            self.memory.begun()
        if reason is None and self.recorder is not None:
            self.recorder.record_experiment(experiment.file.name, path, experiment.data, experiment.file.tool_mm)
        return reason

    def question_of(self, experiment: ReadExperiment) -> Question:
        """Return the question before an experiment, while nothing runs: only then its modules are loaded."""
        from shearloop.daemon.operator_questions import question_of

        return question_of(experiment, self.experiments, self.control_loop, *self.occasion())

    def occasion(self) -> tuple[str, ...]:
        """Return what changes with each process, stop and run: a question from before it asks for another moment."""
        loop = self.control_loop
        stops = f"{self.runner.stop_count} stops, {loop.safety.acknowledgements} acknowledged"
        return self.instance, stops, f"{loop.runs} runs"

    def state(self) -> Mapping[str, Any]:
        """Return what `status` shows of the control loop."""
        state, stop = loop_state(self.control_loop, 0.0, 0), self.control_loop.safety.waiting
        causes = stop.causes if stop is not None else ""
        return {**{key: getattr(state, key) for key in LOOP_KEYS}, "stop_causes": causes}


def build_rig(
    config: DaemonConfig,
    settings: UrSettings,
    files: RobotFiles,
    sessions: Sessions,
    publisher: Publisher,
    clock: Clock,
    recorder: "Recorder | None",
    supervisor: Supervisor,
    instance: str,
) -> tuple[Sensors, Rig]:
    """Return robot, gripper and control loop, and all sensors, which drive it.

    `settings` and `files` are the robot's, `instance` is the daemon's.
    """
    sources = torque_sources(config, sessions.fingertips, sessions.combined)
    commissioning = commissioning_of(config, settings)
    check_experiment(config, sources, commissioning)
    settings, supplied = commissioning.settings, commissioning.supplied
    loop = make_loop(config, settings, sources, supervisor.dead, supplied)
    gripper = None
    if config.gripper is not None:
        gripper = make_gripper(config.gripper, loop, publisher, clock, patience_of(config), supplied)
    sensors = build_sensors(config, publisher, clock, recorder, sessions, loop, gripper)
    link = LinkMonitor(LinkReporter("robot", loop))
    settings_for, holds = commissioning.on_controller, loop.tool.may_be_loaded
    robot = UrRobot(settings, link, settings_for=settings_for, holds=holds)
    memory: RigMemory | NoMemory = NoMemory()
    if keeps_memory(config):
        memory = RigMemory(files, loop, sensors.load_cell, WrenchZero(loop, robot), clock)
        memory.restore()
    runner = ControlLoopRunner(loop, robot, gripper, sensors.tareable, publisher, clock, memory.save_present)
    experiments = ExperimentFiles(config.experiment_folders, config, sources, commissioning, LoadedFiles.of(config))
    fingers: dict[str, Task] = {"gripper": gripper} if gripper is not None else {}
    tasks: dict[str, Task] = {**fingers, "robot": robot, "loop": runner}
    if isinstance(memory, RigMemory):
        tasks["memory"] = memory
    return sensors, Rig(loop, runner, tasks, experiments, recorder, instance, memory, commissioning)
