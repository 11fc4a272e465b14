"""Builds what acts: load cell, gripper, robot and the brain between them, from the configuration."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, GripperConfig, LoadCellConfig
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.control.loop_inputs import GripperStatus, TorqueSample, TorqueSource
from shearloop.daemon.control.runner import WRENCH, ControlLoopRunner, wrench_source
from shearloop.daemon.links import log_event, log_link
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.rig_check import read_experiment
from shearloop.daemon.sensing.estimators import COMBINED
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL, LoadCellTask
from shearloop.drivers.calibration_file import load_calibration
from shearloop.drivers.hx711 import LoadCalibration
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.raw_event import Tap, no_tap
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperClient
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.width import WidthCalibration
from shearloop.drivers.serial_port import LinkEvent
from shearloop.drivers.ur.client import UrLinkEvent, UrRobot
from shearloop.drivers.ur.settings import read_settings


def load_cell_calibration(config: LoadCellConfig) -> LoadCalibration:
    """Return the load cell's calibration; raises DriverError when it cannot be used."""
    if config.calibration is None:
        return LoadCalibration.of_torque_lines()
    return load_calibration(config.calibration, LoadCalibration)


def make_load_cell(
    config: LoadCellConfig,
    publisher: Publisher,
    clock: Clock,
    hear: Callable[[TorqueSample], None],
    on_event: Callable[[LinkEvent], None],
    tap: Tap = no_tap,
) -> LoadCellTask:
    """Return the load cell's task; raises DriverError when its calibration cannot be used."""
    calibration = load_cell_calibration(config)
    device = config.device
    board = LoadCell(
        calibration,
        serial_number=device.serial_number,
        path=device.path,
        rate_hz=config.rate_hz,
        on_event=on_event,
        tap=tap,
    )
    return LoadCellTask(board, publisher, clock, hear, config.rate_hz)


def make_gripper_client(config: GripperConfig) -> GripperClient:
    """Return the way to the gripper; nothing is opened yet."""
    if config.socket is not None:
        return SocketClient(config.socket.host, config.socket.port)
    if config.modbus is not None:
        # Here, for pymodbus takes long to import, and most grippers are reached by their socket.
        from shearloop.drivers.robotiq.modbus_client import ModbusClient

        path = str(config.modbus.path) if config.modbus.path is not None else None
        return ModbusClient(serial_number=config.modbus.serial_number, path=path)
    raise ValueError("a gripper has a way in")


def gripper_calibration(config: GripperConfig) -> WidthCalibration:
    """Return the gripper's calibration, or the maker's figures; raises DriverError when it cannot be used."""
    if config.calibration is None:
        return WidthCalibration.nominal()
    return load_calibration(config.calibration, WidthCalibration)


def make_gripper(
    config: GripperConfig,
    publisher: Publisher,
    feel: Callable[[GripperStatus], None],
    on_event: Callable[[LinkEvent], None],
) -> GripperTask:
    """Return the gripper's task; raises DriverError when its calibration cannot be used."""
    client = make_gripper_client(config)
    gripper = RobotiqGripper(client, gripper_calibration(config), on_event=on_event)
    return GripperTask(gripper, publisher, feel, measures_diameters=config.calibration is not None)


class Rig:
    """Everything that acts, and what belongs to it."""

    def __init__(
        self,
        config: DaemonConfig,
        publisher: Publisher,
        clock: Clock,
        fingertips: Mapping[str, TorqueSource],
        tare_fingertips: Callable[[], Awaitable[str]],
        died: Callable[[], Mapping[str, str]],
        tap: Callable[[str], Tap] = lambda _: no_tap,
    ) -> None:
        """Read the settings of every device; none is opened yet.

        `died` names the daemon's dead tasks, and why; `tap` gives what hears of a source's raw inputs.
        """
        if config.robot is None:
            raise ValueError("a rig has a robot")
        self._tare_fingertips = tare_fingertips
        self._stops = 0
        sources = dict(fingertips)
        self.load_cell: LoadCellTask | None = None
        if config.load_cell is not None:
            self.load_cell = make_load_cell(
                config.load_cell, publisher, clock, self._hear, self.link_of(LOAD_CELL), tap(LOAD_CELL)
            )
            sources[self.load_cell.source.name] = self.load_cell.source
        robot = read_settings(config.robot)
        sources[WRENCH] = wrench_source(robot.rate_hz)
        required = ("robot", "gripper") if config.gripper is not None else ("robot",)
        creep = {
            name: tip.creep
            for name, tip in (*config.fingertips.items(), (COMBINED, config.combined))
            if tip is not None
        }
        gels = {name: Creep(own.share, own.time_s) for name, own in creep.items() if own is not None}
        self.brain = ControlLoop(config.loop, sources, required, gels)
        self.gripper = None
        if config.gripper is not None:
            self.gripper = make_gripper(config.gripper, publisher, self._feel, self.link_of("gripper"))
        self.robot = UrRobot(robot, on_link=self._robot_link)
        self.loop = ControlLoopRunner(
            self.brain,
            self.robot,
            self.gripper,
            self.take_zero,
            publisher,
            clock,
            died,
            config.loop.wrist_acceleration_rad_per_s2,
        )

    def link_of(self, device: str) -> Callable[[LinkEvent], None]:
        """Return what hears of a device that comes or goes: the log, and the loop, which stops at once."""

        def heard(event: LinkEvent) -> None:
            log_link(device, event)
            self._come_or_gone(device, event.up, event.sentence)

        return heard

    def tasks(self) -> Iterator[tuple[str, Callable[[], Awaitable[None]]]]:
        """Yield the name and the coroutine of every task but the load cell's, which may run without a rig."""
        if self.gripper is not None:
            yield "gripper", self.gripper.read
        yield "robot", self.robot.run
        yield "loop", self.loop.drive

    async def take_zero(self) -> str:
        """Take the zero of every torque sensor at once; return why one could not, or an empty text."""
        zeros = [self._tare_fingertips()]
        if self.load_cell is not None:
            zeros.append(self.load_cell.zero())
        return " ".join(filter(None, await asyncio.gather(*zeros)))

    async def start(self, path: Path) -> str | None:
        """Begin the experiment in a file, or return why not; raises UserError for a file that is none."""
        before = self._stops
        why = await self.loop.start(read_experiment(path))
        if why is None and self._stops != before:
            self.brain.stop("the operator said stop")
            return "stop was said while it was being started"
        return why

    def stop(self) -> str:
        """End the experiment that runs, or is just being started, on the operator's word; return its name."""
        self._stops += 1
        experiment = self.brain.experiment
        if experiment is None or not experiment.running:
            return ""
        self.brain.stop("the operator said stop")
        return experiment.file.name

    def end(self) -> None:
        """Stop the experiment that runs, for the daemon ends, and tell of it as of every other end."""
        experiment = self.brain.experiment
        if experiment is not None and experiment.running:
            self.brain.stop("the daemon was told to end: the wrist is stopped, a tool that is gripped stays gripped")
            # No other state of the robot may be decided upon before the loop is cancelled.
            self.loop.decide_now()

    def _robot_link(self, event: UrLinkEvent) -> None:
        up = event.status == "up"
        log_event("robot", up, event.sentence, repeated=event.losses > 1)
        self._come_or_gone("robot", up, event.sentence)

    def _come_or_gone(self, device: str, up: bool, sentence: str) -> None:
        if up:
            self.brain.inputs.lost.pop(device, None)
        else:
            self.brain.inputs.lost[device] = sentence
            self.loop.decide_now()

    def _hear(self, torque: TorqueSample) -> None:
        self.brain.on_torque(torque)

    def _feel(self, hand: GripperStatus) -> None:
        known = self.brain.inputs.gripper
        if known is None or hand.t_ns >= known.t_ns:
            self.brain.inputs.gripper = hand
