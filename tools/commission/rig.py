"""The rig's devices for a commissioning; each is opened when a stage needs it."""

import asyncio
from collections.abc import AsyncGenerator
from contextlib import AbstractContextManager, aclosing, suppress
from typing import Protocol

from shearloop.daemon.config import DaemonConfig, LoadCellConfig, SkinConfig
from shearloop.daemon.patience import patience_of
from shearloop.daemon.rig import gripper_calibration, make_gripper_client
from shearloop.daemon.sensing.skin_task import skin_device
from shearloop.daemon.sensors import load_cell_calibration
from shearloop.drivers.connection import SerialLink
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.load_cell import LoadCell, LoadSample
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.drivers.ur.control_box import ControllerInfo, query_controller
from shearloop.drivers.ur.dashboard import ask_dashboard
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.rtde import has_other_client, register_round_trip
from shearloop.drivers.ur.script import ScriptRegisters
from shearloop.drivers.ur.settings import UrSettings
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.arm_models import Arm, read_arm
from shearloop.tools.commission.arrivals import REAL_CLOCK, Arrivals, Clock
from shearloop.tools.commission.fingers import ConnectedGripper, Gripper
from shearloop.tools.commission.listening import BoardListener
from shearloop.tools.commission.mover import Mover, MoverProcess
from shearloop.tools.commission.observer import Observer
from shearloop.tools.commission.observer_process import ObserverProcess
from shearloop.tools.fingertip_table import fingertip_table
from shearloop.tools.robot_use import read_outputs


class Rig(Protocol):
    """The devices and their time; a simulation has the same ones in a time of its own."""

    clock: Clock

    def controller(self) -> ControllerInfo:
        """Return what the controller says of itself; raises DriverError if it does not answer."""

    def outputs(self, registers: ScriptRegisters) -> RtdeOutputs:
        """Return the controller's present outputs."""

    def arm(self) -> Arm:
        """Return the arm's model and its rated payload."""

    def has_other_client(self, own: ScriptRegisters) -> bool:
        """Return whether another client writes registers too."""

    def write_register(self, registers: ScriptRegisters, value: int) -> int:
        """Write a value into our register, and return what the controller reports of it."""

    def stop_program(self) -> None:
        """Stop the program at the controller's dashboard."""

    def observer(self, registers: ScriptRegisters) -> AbstractContextManager[Observer]:
        """Return an observer of the robot."""

    def mover(self, settings: UrSettings) -> AbstractContextManager[Mover]:
        """Return what drives the robot within the limits of these settings."""

    def gripper(self) -> AbstractContextManager[Gripper]:
        """Return the configured gripper."""

    def load_cell(self) -> AbstractContextManager[Arrivals[LoadSample]]:
        """Return the trusted samples of the configured load cell."""

    def fingertip(self, name: str) -> AbstractContextManager[Arrivals[Frame]]:
        """Return the frames of a configured fingertip."""

    def skin(self) -> AbstractContextManager[Arrivals[SkinSample]]:
        """Return the readings of the configured skin, which are not averaged."""


class ConnectedRig:
    """The devices of a configuration, over their ports."""

    clock: Clock = REAL_CLOCK

    def __init__(self, config: DaemonConfig, settings: UrSettings) -> None:
        """Take the configuration and its robot's settings; nothing is opened yet."""
        self._config, self._settings = config, settings

    def controller(self) -> ControllerInfo:
        """Return what the controller says of itself."""
        return query_controller(self._settings.host, self._settings.connect_timeout_s)

    def outputs(self, registers: ScriptRegisters) -> RtdeOutputs:
        """Return the controller's present outputs; raises RobotLostError if it does not answer."""
        return read_outputs(self._settings.host, self._settings.connect_timeout_s, registers)

    def arm(self) -> Arm:
        """Return the arm's model and its rated payload."""
        settings = self._settings
        return read_arm(settings.host, settings.connect_timeout_s, settings.facts.major)

    def has_other_client(self, own: ScriptRegisters) -> bool:
        """Return whether another client writes registers too."""
        return has_other_client(self._settings.host, self._settings.connect_timeout_s, own)

    def write_register(self, registers: ScriptRegisters, value: int) -> int:
        """Write a value into our register, and return what the controller reports of it."""
        return register_round_trip(self._settings.host, self._settings.connect_timeout_s, registers, value)

    def stop_program(self) -> None:
        """Stop the program at the controller's dashboard."""
        ask_dashboard(self._settings.host, self._settings.connect_timeout_s, ("stop",))

    def observer(self, registers: ScriptRegisters) -> ObserverProcess:
        """Start the observer's process."""
        return ObserverProcess(self._settings.host, self._settings.rate_hz, registers)

    def mover(self, settings: UrSettings) -> MoverProcess:
        """Return the process that drives the robot."""
        return MoverProcess(settings)

    def gripper(self) -> ConnectedGripper:
        """Return the configured gripper."""
        config = self._config.gripper
        if config is None:
            raise ValueError("the configuration has no gripper")
        client = make_gripper_client(config, patience_of(self._config))
        return ConnectedGripper(RobotiqGripper(client, gripper_calibration(config)))

    def load_cell(self) -> BoardListener[LoadSample]:
        """Return the trusted samples of the configured load cell."""
        config = self._config.load_cell
        if config is None:
            raise ValueError("the configuration has no load cell")
        return BoardListener("the load cell", lambda: self._trusted(config))

    async def _trusted(self, config: LoadCellConfig) -> AsyncGenerator[LoadSample]:
        link = SerialLink(**config.device.model_dump())
        cell = LoadCell(link, load_cell_calibration(config), config.rate_hz, patience=patience_of(self._config))
        async with aclosing(cell.readings()) as readings:
            async for sample in readings:
                if sample.trusted:
                    yield sample

    def fingertip(self, name: str) -> BoardListener[Frame]:
        """Return the frames of a configured fingertip."""
        config = self._config.fingertips[name]
        link, zero_slots = SerialLink(**config.device.model_dump()), fingertip_table(config).zero_slots
        board = EitKit(link, zero_slots, config.frame_period_s, patience=patience_of(self._config))
        return BoardListener(f"the fingertip {name}", board.readings)

    def skin(self) -> BoardListener[SkinSample]:
        """Return the readings of the configured skin, which are not averaged."""
        config = self._config.skin
        if config is None:
            raise ValueError("the configuration has no skin")
        return BoardListener("the skin", lambda: _readings(config))


async def _readings(config: SkinConfig) -> AsyncGenerator[SkinSample]:
    """Yield the skin's readings, and watch its current source; switch it off at the end."""
    # No observer: the report names lost readings, and the terminal shows the commissioning's lines alone.
    skin = skin_device(config, load_calibration(config.calibration), averaged=1, observer_of=lambda _: None)
    watching = asyncio.create_task(skin.watch_source())
    try:
        async with aclosing(skin.batches()) as batches:
            async for samples in batches:
                for sample in samples:
                    yield sample
    finally:
        watching.cancel()
        with suppress(asyncio.CancelledError):
            await watching
