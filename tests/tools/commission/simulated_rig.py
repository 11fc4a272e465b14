"""A rig in simulated time: the emulated devices, the robot's real script and worker, and no process, port or clock."""

import contextlib
import math
import threading
from collections.abc import Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from shearloop.daemon.config import DaemonConfig, SkinConfig
from shearloop.daemon.sensing.skin_task import gauge_ohm
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.drivers.eit_kit import Frame, FrameParser
from shearloop.drivers.errors import DriverError
from shearloop.drivers.load_cell import LoadCalibration, LoadParser, LoadSample
from shearloop.drivers.robotiq.messages import ActivationStatus, GripperCommand, GripperState, ObjectStatus, fault_of
from shearloop.drivers.robotiq.models import MODELS
from shearloop.drivers.robotiq.socket_client import ALWAYS, IN_TURN, IN_TURN_S
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.shear_skin.instruments import SOURCE_PERIOD_S, PairParser, Reply, read_elements
from shearloop.drivers.shear_skin.skin import SampleValidator, SkinSample
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.messages import (
    Command,
    CommandReply,
    Heartbeat,
    RobotLostError,
    RobotState,
    RtdeOutputs,
    RtdeSample,
)
from shearloop.drivers.ur.script import UPPER, ScriptRegisters
from shearloop.drivers.ur.settings import UrSettings
from shearloop.emulators.boards import PAPER_SKETCH
from shearloop.emulators.emulated_rig import NOISE_NM, EmulatedRig, SkinOnTool
from shearloop.emulators.gripper import COUNTS_MAX, GripperRegisters
from shearloop.emulators.scene import Scene
from shearloop.emulators.skin import SkinInstruments
from shearloop.emulators.synthetic_frames import RigFrames
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.emulators.ur_robot import MODE_IDLE, MODE_POWER_OFF, ControllerSpec
from shearloop.emulators.ur_rtde import variable
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.arm_models import Arm
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.failing_worker import NO_DEADLINES
from shearloop.tools.commission.mover import WATCHDOG_WORKER, Mover
from shearloop.tools.commission.mover_process import CAUSES, WORKERS, Driver
from shearloop.tools.commission.observer import Observer, Seen
from shearloop.tools.commission.watchdog_worker import for_watchdog_alone
from shearloop.tools.fingertip_table import fingertip_table
from tests.drivers.ur import robots
from tests.drivers.ur.scripted_arm import ScriptedArm

CYCLE_S = 0.008
BEGIN_NS = 10**12
# Gel, fingers and boards are as many times as fast.
SPEED = 5
_REST = (0.0,) * 6


class SimulatedArm(ScriptedArm):
    """The worker's end of the controller."""

    def __init__(self, rig: "SimulatedRig", settings: UrSettings) -> None:
        super().__init__(robots.control_script(settings), settings, rig.robot, CYCLE_S)
        self._rig = rig
        # As the worker of `failing_worker` can be told.
        self.forgets_deadlines = False
        self.look()

    def _write(self, command: int, *values: float) -> bool:
        """Write a command, which a pulled cable loses."""
        return self._rig.is_silent or super()._write(command, *values)

    def _write_deadline(self, left_s: float) -> None:
        if not (self.forgets_deadlines or self._rig.is_silent):
            super()._write_deadline(left_s)

    def step(self) -> None:
        self._rig.pass_cycle()

    def look(self) -> None:
        """Take the controller's latest outputs, unless nothing comes."""
        now_ns = self._rig.now_ns()
        if self._rig.is_silent:
            self.reading = replace(self.reading, age_ns=now_ns - self.reading.read_ns)
            return
        self.reading = RtdeSample(
            **vars(self._rig.outputs(UPPER)),
            read_ns=now_ns,
            age_ns=0,
            connected=True,
            moving_linearly=robots.moving_asynchronously(self.robot),
            rest_rad_per_s=self._settings.rest_rad_per_s,
        )

    def upload(self, *, held: bool = False) -> None:
        if "block-scripts" not in self._rig.emulated.controller.faults:
            super().upload(held=held)

    def ask_dashboard(self, *requests: str) -> str:
        match requests[0]:
            case "stop":
                self.robot.end_program("stopped from the dashboard")
            case "unlock protective stop" if not self.robot.unlock():
                raise DriverError("it cannot be unlocked yet")
            case "power on":
                self.robot.begin_power_step(MODE_POWER_OFF)
            case "brake release":
                self.robot.begin_power_step(MODE_IDLE)
        return ""


class _NextCycle:
    def __await__(self) -> Iterator[None]:
        yield


class SimulatedRobot:
    """The worker, a cycle at a time, as the daemon's client of the robot has it."""

    def __init__(self, rig: "SimulatedRig", settings: UrSettings) -> None:
        self._rig, self.arm = rig, SimulatedArm(rig, settings)
        self._handler = CommandHandler(settings, self.arm, rig.now_ns())
        self._number = self._cycle = 0
        self._replies: dict[int, CommandReply] = {}

    def cycle(self) -> None:
        """Run a cycle; raises RobotLostError as a worker does."""
        self.arm.look()
        self._cycle += 1
        self._handler.take(self.arm.reading)
        ended = self._handler.tick(self._rig.now_ns())
        if ended is not None:
            self._replies[ended[0]] = ended[1]

    @property
    def state(self) -> RobotState:
        self._handler.take(self.arm.reading)
        return self._handler.state(self._cycle)

    async def next_state(self) -> RobotState:
        await _NextCycle()
        return self.state

    async def send(self, command: Command) -> CommandReply:
        self._number += 1
        number = self._number
        self._handler.take(self.arm.reading)
        reply = self._handler.request(number, command, self._rig.now_ns())
        while reply is None:
            await _NextCycle()
            reply = self._replies.pop(number, None)
        return reply

    def keep_moving(self) -> None:
        self._handler.request(0, Heartbeat(), self._rig.now_ns())


class SimulatedMover(Mover):
    """The requests' coroutines and their robot; each can be killed or stopped."""

    def __init__(self, rig: "SimulatedRig", settings: UrSettings) -> None:
        super().__init__(settings, rig.clock, rig.now_ns)
        self._rig = rig
        self._robot: SimulatedRobot | None = None
        self._driver: Driver | None = None
        self._running: Coroutine[Any, Any, None] | None = None
        self._daemon_runs = False

    def start(self) -> None:
        settings = for_watchdog_alone(self.settings) if self.worker == WATCHDOG_WORKER else self.settings
        self._robot = SimulatedRobot(self._rig, settings)
        self._driver, self._daemon_runs = Driver(settings, self._robot, self, self._rig.now_ns), True

    def kill(self) -> None:
        if self._running is not None:
            self._running.close()
        self._running = self._robot = None

    def stop_worker(self) -> int:
        self._robot = None
        return self.now_ns()

    def send(self, request: dict[str, Any]) -> None:
        if self._running is not None:
            self._running.close()
        self._running = self._driver.handle(request)

    def cycle(self) -> None:
        """Run a cycle of the worker and of the request."""
        if self._robot is None:
            return
        try:
            self._robot.cycle()
        except RobotLostError as loss:
            self.report("lost", sentence=str(loss))
            self._robot = None
            return
        if self._running is not None and self._daemon_runs:
            try:
                self._running.send(None)
            except StopIteration:
                self._running = None

    # The surroundings of the requests.
    def now_ns(self) -> int:
        return self._rig.now_ns()

    def report(self, event: str, **facts: object) -> None:
        self.events.add({"event": event, "t_ns": self.now_ns(), **facts})

    def bring_about(self, cause: str) -> None:
        to_worker, to_daemon = CAUSES[cause]
        assert cause not in WORKERS or self.worker == WORKERS[cause]
        self.report("cause", cause=cause)
        if to_worker == NO_DEADLINES:
            self._robot.arm.forgets_deadlines = True
        elif to_worker is not None:
            self._robot = None
        if to_daemon is not None:
            self._daemon_runs = False


class SimulatedGripper:
    """The gripper's registers, written and read."""

    def __init__(self, rig: "SimulatedRig") -> None:
        self.model = MODELS[rig.config.gripper.model]
        self._calibration = WidthCalibration.nominal(rig.config.gripper.model)
        self._rig, self._gripper = rig, rig.emulated.scene.gripper

    def activate(self, *, operator_confirmed: bool = False) -> None:
        if self._gripper.sta != ActivationStatus.ACTIVE or operator_confirmed:
            self._write(GripperRegisters())
            self._write(GripperRegisters(act=True))
            self._rig.run_until(lambda: self._gripper.sta == ActivationStatus.ACTIVE)

    def _write(self, registers: GripperRegisters) -> None:
        self._gripper.write(registers)
        self._rig.run_until(lambda: self._gripper.taken == registers)

    def poll(self) -> GripperState:
        answer_s = self._rig.emulated.commanded["gripper"].server.answer_s
        # As `SocketClient.read` asks for them, one after the other.
        in_turn = min(len(IN_TURN), 1 + int(IN_TURN_S / answer_s)) if answer_s else len(IN_TURN)
        self._rig.clock.sleep((in_turn + len(ALWAYS)) * answer_s)
        counts = self._gripper.pos
        return GripperState(
            t_ns=self._rig.now_ns(),
            position_counts=counts,
            width_mm=self._calibration.width_mm(counts),
            width_std_mm=self._calibration.width_std_mm,
            object=ObjectStatus(self._gripper.obj),
            activation=ActivationStatus(self._gripper.sta),
            current_ma=None,
            fault=fault_of(self._gripper.flt),
        )

    def move(self, command: GripperCommand) -> GripperState:
        (slow, fast), (low_n, high_n) = self.model.speed_mm_per_s, self.model.force_n
        self._write(
            GripperRegisters(
                act=True,
                gto=True,
                pos=self._calibration.counts(command.width_mm),
                spe=round(COUNTS_MAX * (command.speed_mm_per_s - slow) / (fast - slow)),
                force=round(COUNTS_MAX * (command.force_n - low_n) / (high_n - low_n)),
            )
        )
        self._rig.run_until(lambda: self._gripper.obj != ObjectStatus.MOVING)
        return self.poll()


class SkinReader:
    """The skin's driver without its ports: queries and replies of the source, lines of the converter board."""

    def __init__(self, rig: "SimulatedRig", instruments: SkinInstruments, config: SkinConfig) -> None:
        calibration = load_calibration(config.calibration)
        self._rig, self._source, self._parser = rig, instruments.source, PairParser(config.daq.rate_hz)
        current_a, rate_hz = config.source.current_ma * 1e-3, config.daq.rate_hz
        self._validator = SampleValidator(current_a, SOURCE_PERIOD_S, 1 / rate_hz, gauge_ohm(calibration))
        switch_on = ":SENS:FUNC 'VOLT','CURR'", ":FORM:ELEM VOLT,CURR,STAT", f":SOUR:CURR {current_a}", ":OUTP ON"
        self._source.feed("\n".join([*switch_on, ""]).encode())
        self._asked_ns = -BEGIN_NS

    def feed(self, line: bytes, now_ns: int) -> list[SkinSample]:
        if now_ns - self._asked_ns >= SOURCE_PERIOD_S * 1e9:
            self._asked_ns = now_ns
            self._reading = read_elements(Reply(self._source.feed(b":READ?\n").decode().strip(), now_ns, now_ns))
        return [self._validator.sample(voltages, self._reading) for voltages in self._parser.feed(line, now_ns)]


Parser = FrameParser | LoadParser | SkinReader


class SimulatedBoard:
    """A board that is due at times, and a parser for those who listen."""

    def __init__(self, board: Any, period_s: float) -> None:
        self.board, self.period_s, self.due_s = board, period_s, 0.0
        self.parser: Parser | None = None
        self.listeners: Arrivals[Any] | None = None


class SimulatedClock:
    """The rig's own time; a wait makes it pass."""

    def __init__(self, rig: "SimulatedRig") -> None:
        self._rig = rig

    def now_ns(self) -> int:
        return self._rig.now_ns()

    def sleep(self, seconds: float) -> None:
        until_ns = self.now_ns() + seconds * 1e9
        self._rig.run_until(lambda: self.now_ns() >= until_ns)

    def wait(self, _changed: threading.Condition, _seconds: float) -> None:
        self._rig.cycle()


class SimulatedRig:
    """The devices of a configuration, whose skin is read by a converter board."""

    def __init__(self, config: DaemonConfig, folder: Path) -> None:
        self.config = config
        cell, skin = config.load_cell, config.skin
        self.emulated = EmulatedRig(
            {name: RigFrames(fingertip.bank, 0) for name, fingertip in config.fingertips.items()},
            folder,
            load_cell=cell is not None,
            skin=None if skin is None else self._skin_on,
            speed=SPEED,
            make=ControllerSpec(unlock_wait_s=0.5, power_on_s=0.2),
            sketch=replace(PAPER_SKETCH, noise_counts=NOISE_NM),
        )
        self.robot = self.emulated.controller.robot
        self.serial_number = EMULATED_SERIAL_NUMBER if config.emulated else "1"
        self.clock = SimulatedClock(self)
        # Until then nothing comes from the robot. The observer gets what is held back later.
        # Whether another client writes the registers beside ours.
        self.other_client = False
        self._silent_until_s, self._holds_back = -math.inf, False
        self._held: list[tuple[int, RtdeOutputs]] = []
        self._mover: SimulatedMover | None = None
        self._observer: Observer | None = None
        played = self.emulated.commanded
        self._boards = {
            name: SimulatedBoard(played[name], fingertip.frame_period_s)
            for name, fingertip in config.fingertips.items()
        }
        if cell is not None:
            self._boards["load"] = SimulatedBoard(played["load"], 1.0 / cell.rate_hz)
        if skin is not None:
            self._boards["skin"] = SimulatedBoard(played["skin"].daq, 1.0 / skin.daq.rate_hz)

    def _skin_on(self, scene: Scene) -> SkinInstruments:
        skin = self.config.skin
        model = SyntheticSkin(radius_mm=skin.tool_radius_mm, normal_n=skin.normal_n)
        return SkinInstruments(SkinOnTool(model, scene), None, None, daq_rate_hz=skin.daq.rate_hz)

    # Time.
    def now_ns(self) -> int:
        return BEGIN_NS + round(1e9 * self.robot.clock_s)

    @property
    def is_silent(self) -> bool:
        return self.robot.clock_s < self._silent_until_s

    def run_until(self, condition: Any) -> None:
        while not condition():
            self.cycle()

    def cycle(self) -> None:
        """Let a cycle of the controller pass, and what drives it."""
        if self._mover is not None:
            self._mover.cycle()
        self.pass_cycle()

    def pass_cycle(self) -> None:
        """Let a cycle of the controller pass, in which the devices measure."""
        self.robot.step(CYCLE_S)
        now_ns = self.now_ns()
        if self._observer is not None and (self._holds_back or not self.is_silent):
            self._held.append((now_ns, self.outputs(UPPER)))
        if self._observer is not None and not self.is_silent:
            for made_ns, outputs in self._held:
                self._observer.add(Seen(made_ns, now_ns, outputs))
            self._held.clear()
        for one in self._boards.values():
            if self.robot.clock_s >= one.due_s:
                one.due_s += one.period_s
                line = one.board.next_line(self.robot.clock_s)
                if one.parser is not None:
                    for value in one.parser.feed(line, now_ns):
                        one.listeners.add(value)

    def order(self, command: str) -> None:
        """Carry out a command of `emulate rig`."""
        match command.split():
            case ["silence", "robot", seconds] | ["robot", "silence", seconds]:
                self._silent_until_s, self._holds_back = self.robot.clock_s + float(seconds), False
            case ["robot", "hold-back", seconds]:
                self._silent_until_s, self._holds_back = self.robot.clock_s + float(seconds), True
            case _:
                self.emulated.command(command)
        # As an operator does, until everything rests.
        self.clock.sleep(0.5)

    def bounds_rad(self) -> tuple[float, float]:
        """Return the lowest and the highest angle of the wrist for whoever drives the robot."""
        joints = self._mover.settings.limits.joints
        return joints.lower_rad[5] + joints.margin_rad, joints.upper_rad[5] - joints.margin_rad

    # The devices.
    def controller(self) -> ControllerInfo:
        in_use = "registers-in-use" in self.emulated.controller.faults
        version = ".".join(map(str, self.robot.spec.version))
        registers = None if in_use else UPPER
        return ControllerInfo(version, self.serial_number, "RUNNING", "NORMAL", remote=True, registers=registers)

    def outputs(self, registers: ScriptRegisters) -> RtdeOutputs:
        robot, arm = self.robot, self.robot.arm
        return RtdeOutputs(
            timestamp_s=robot.clock_s,
            q_rad=tuple(arm.q_rad.tolist()),
            qd_rad_per_s=tuple(arm.measured_rad_per_s.tolist()),
            tcp_pose=tuple(arm.pose.tolist()),
            tcp_speed=tuple(arm.speed.tolist()) if arm.moving else _REST,
            wrench=tuple(arm.wrench.tolist()),
            robot_mode=robot.robot_mode,
            safety_mode=robot.safety_mode,
            runtime_state=robot.runtime_state,
            speed_slider=arm.speed_slider,
            limiter_scaling=1.0,
            script_state=variable(robot, registers.state),
            script_ticks=variable(robot, registers.clock),
            script_step_s=float(variable(robot, registers.step)),
            payload_kg=robot.spec.payload_kg,
            payload_cog_m=robot.spec.payload_cog_m,
            tcp_offset=robot.spec.tcp_offset,
        )

    def arm(self) -> Arm:
        return Arm("UR5", (5.0,))

    def write_register(self, _registers: ScriptRegisters, value: int) -> int:
        return value

    def has_other_client(self, _own: ScriptRegisters) -> bool:
        return self.other_client

    def stop_program(self) -> None:
        self.robot.end_program("stopped from the dashboard")

    @contextlib.contextmanager
    def observer(self, _registers: ScriptRegisters) -> Iterator[Observer]:
        self._observer = Observer(self.clock)
        self.cycle()
        yield self._observer

    @contextlib.contextmanager
    def mover(self, settings: UrSettings) -> Iterator[SimulatedMover]:
        self._mover = SimulatedMover(self, settings)
        self._mover.start()
        try:
            yield self._mover
        finally:
            self._mover.kill()

    @contextlib.contextmanager
    def gripper(self) -> Iterator[SimulatedGripper]:
        yield SimulatedGripper(self)

    @contextlib.contextmanager
    def load_cell(self) -> Iterator[Arrivals[LoadSample]]:
        parser = LoadParser(LoadCalibration.of_torque_lines(), self.config.load_cell.rate_hz)
        with self._listening(self._boards["load"], parser) as arrivals:
            yield arrivals

    @contextlib.contextmanager
    def fingertip(self, name: str) -> Iterator[Arrivals[Frame]]:
        own = self.config.fingertips[name]
        period_ns = round(1e9 * own.frame_period_s)
        parser = FrameParser(fingertip_table(own).zero_slots, nominal_period_ns=period_ns)
        with self._listening(self._boards[name], parser) as arrivals:
            yield arrivals

    @contextlib.contextmanager
    def skin(self) -> Iterator[Arrivals[SkinSample]]:
        with self._listening(
            self._boards["skin"], SkinReader(self, self.emulated.commanded["skin"], self.config.skin)
        ) as arrivals:
            yield arrivals

    @contextlib.contextmanager
    def _listening(self, board: SimulatedBoard, parser: Parser) -> Iterator[Arrivals[Any]]:
        board.parser, board.listeners = parser, Arrivals(lambda one: one.t_mid_ns, self.clock, "it is silent")
        try:
            yield board.listeners
        finally:
            board.parser = None
