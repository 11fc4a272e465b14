"""What a daemon is told in YAML. Units are in the keys; unknown keys are refused; nothing changes after loading."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field, model_validator

from shearloop.daemon.config_file import ConfigModel, load_yaml_model
from shearloop.daemon.control.settings import LoopConfig
from shearloop.daemon.messaging.addresses import (
    COMMAND_ADDRESS,
    LARGEST_PORT,
    PUBLISH_ADDRESS,
    has_a_port,
    open_to_the_network,
    stays_on_this_machine,
)

# What else a daemon has a task of, publishes as, drives by or records under. A fingertip of such a name would be taken
# for it: its torque for the load cell's that supervises it, its zero for the other's.
TAKEN_NAMES = frozenset(
    (
        *("load_cell", "wrench", "skin", "combined", "robot", "gripper", "loop", "experiment", "recording", "slices"),
        *("commands", "open_stop", "keys", "health", "log", "shown", "daemon", "clock"),
    )
)


def _known_transport(address: str) -> str:
    if not address.startswith(("ipc://", "tcp://")):
        raise ValueError("must be ipc or a tcp address, for this machine alone a loopback one: tcp://127.0.0.1:7761")
    if not has_a_port(address):
        raise ValueError(f"must end in a port, a whole number up to {LARGEST_PORT}, as in tcp://127.0.0.1:7761")
    return address


Address = Annotated[str, AfterValidator(_known_transport)]


class CurveConfig(ConfigModel):
    """Keys for the addresses that can be reached from the network; made by `shearloop keys`."""

    server_key: Path = Field(description="the daemon's own .key_secret; under systemd its credential of this name")
    clients: Path = Field(description="the allow-list: a folder with the .key of each client")


class SerialDevice(ConfigModel):
    """A board on a serial port, named by what does not change when cables are swapped."""

    serial_number: str | None = Field(None, min_length=1, description="USB serial number, as the port's maker set it")
    path: Path | None = Field(None, description="a port that is named by path, e.g. /dev/serial/by-id/…")

    @model_validator(mode="after")
    def _one_name(self) -> "SerialDevice":
        if (self.serial_number is None) == (self.path is None):
            raise ValueError("give either serial_number or path, and not both")
        return self


EstimatorName = Literal["paper", "bank", "regression", "reconstruction", "motion_regression"]


class CreepConfig(ConfigModel):
    """What a gel's torque loses under a held shear; see daemon/control/creep.py."""

    share: float = Field(ge=0, lt=1, description="of the torque, in the end")
    time_s: float = Field(gt=0, le=3600, description="time constant")


class FingertipConfig(ConfigModel):
    """One EIT fingertip: its board, its bank and its calibration."""

    device: SerialDevice
    bank: Path | None = Field(
        None, description="made by `shearloop bank build`; for k, sigma and heatmaps, and for the paper's estimator"
    )
    calibration: Path | None = Field(None, description="without one, k and sigma are published, but no torque")
    estimator: EstimatorName | None = Field(None, description="default: the one that the calibration was made for")
    matching: Literal["all_lags", "zero_lag"] = "all_lags"
    baseline_frames: int = Field(10, ge=2, le=1000, description="frames averaged into the homogeneous frame")
    average_frames: int = Field(1, ge=1, le=100, description="latest frames averaged before matching")
    creep: CreepConfig | None = Field(
        None, description="of the gel, where the calibration gives its shear; the loop is driven by what is left"
    )
    # shearloop.drivers.eit_format.FRAME_PERIOD_S, which comes with NumPy: a configuration is read without.
    frame_period_s: float = Field(0.5408, gt=0, le=60, description="the board's frame period before it is measured")
    heatmap: Literal["on_request", "always"] = Field(
        "on_request", description="whether eit.heatmap is computed only while somebody subscribes to it"
    )


class CombinedConfig(ConfigModel):
    """One estimate from several fingertips on one tool; they are named as the sides of the calibration."""

    calibration: Path = Field(description="made by `shearloop calibrate` on recordings of all these sides")
    estimator: EstimatorName | None = Field(None, description="default: the one that the calibration was made for")
    creep: CreepConfig | None = Field(None, description="of the gels, as of a single fingertip")


class LoadCellConfig(ConfigModel):
    """The load cell on the lever."""

    device: SerialDevice
    calibration: Path | None = Field(
        None, description="made by `shearloop calibrate load`; without one the board's lines are torques in N·m"
    )
    rate_hz: float = Field(10.9, gt=0, le=1000, description="how many lines a second the board sends")


class InstrumentSocket(ConfigModel):
    """An instrument on the network, or a serial one behind a terminal server."""

    host: str = Field(min_length=1)
    port: int = Field(ge=1, le=65535)


class SkinSourceConfig(ConfigModel):
    """The Keithley 6430 that feeds the skin's gauges, by its RS-232 interface or a socket."""

    socket: InstrumentSocket | None = None
    serial: SerialDevice | None = None
    baud: int = Field(9600, ge=300, le=57600, description="of the RS-232 interface, as set on the instrument")
    current_ma: float = Field(5.0, gt=0, le=20)
    compliance_v: float = Field(1.0, gt=0, le=5)

    @model_validator(mode="after")
    def _one_way_in(self) -> "SkinSourceConfig":
        if (self.socket is None) == (self.serial is None):
            raise ValueError("give either socket or serial, and not both")
        return self


class ScannerConfig(ConfigModel):
    """A scanning multimeter on a socket."""

    socket: InstrumentSocket
    channels: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] = Field(
        (101, 102), description="the channels of gauge 1 and gauge 2"
    )
    range_v: float = Field(1.0, gt=0, le=300)

    @model_validator(mode="after")
    def _two_channels(self) -> "ScannerConfig":
        if self.channels[0] == self.channels[1]:
            raise ValueError(f"gives both gauges the channel {self.channels[0]}; each has its own")
        return self


class AdcConfig(ConfigModel):
    """A converter board that sends `v1,v2` in volts, a line a reading."""

    device: SerialDevice
    full_scale_v: float = Field(0.512, gt=0, le=10)


class SkinDaqConfig(ConfigModel):
    """What reads the voltages of the skin's gauges, one of two."""

    scanner: ScannerConfig | None = None
    adc: AdcConfig | None = None
    rate_hz: float = Field(10.0, ge=1, le=1000)

    @model_validator(mode="after")
    def _one_way_in(self) -> "SkinDaqConfig":
        if (self.scanner is None) == (self.adc is None):
            raise ValueError("give either scanner or adc, and not both")
        return self


class SkinConfig(ConfigModel):
    """The shear skin: its instruments, its calibration, and what it touches."""

    source: SkinSourceConfig
    daq: SkinDaqConfig
    calibration: Path = Field(description="made by `shearloop skin calibrate`")
    normal_n: float = Field(1.0, ge=0, le=100, description="normal force on the skin, by which friction goes")
    tool_radius_mm: float | None = Field(
        None, gt=0, le=200, description="from the axis of the wrist to the skin; makes a torque of the shear force"
    )
    zero_samples: int = Field(20, ge=10, le=1000, description="readings averaged into the zero")
    drift_per_hour: float = Field(2.9e-4, ge=0, le=1, description="95 % bound on the response's drift; the paper's")


class GripperSocket(ConfigModel):
    """The gripper behind the URCap's socket."""

    host: str = Field(min_length=1)
    port: int = Field(63352, ge=1, le=65535)


class GripperConfig(ConfigModel):
    """The gripper, by one of its two ways in."""

    socket: GripperSocket | None = None
    modbus: SerialDevice | None = None
    calibration: Path | None = Field(
        None, description="made by `shearloop calibrate gripper`; else the maker's figures"
    )

    @model_validator(mode="after")
    def _one_way_in(self) -> "GripperConfig":
        if (self.socket is None) == (self.modbus is None):
            raise ValueError("give either socket or modbus, and not both")
        return self


class RecordingConfig(ConfigModel):
    """What is kept of every run: all messages and all raw inputs, a file for each experiment."""

    folder: Path = Field(description="made where it is not there; a rig with one fingertip writes some 50 MB an hour")


class EventConfig(ConfigModel):
    """What befalls an emulated device in the course of an experiment."""

    step: int = Field(ge=1, description="number of the experiment's step, from 1")
    held_for_s: float = Field(0.0, ge=0, description="after its torque or angle has been held for so long")
    say: str = Field(min_length=1, pattern=r"^[^\n]*$", description="a command of the emulator, see its --help")


class EmulatorConfig(ConfigModel):
    """A device that is played by a process of its own, for demonstrations."""

    device: str
    arguments: tuple[str, ...] = ()
    synthetic: tuple[str, ...] = Field((), description="further arguments where no recording is played")
    happenings: tuple[EventConfig, ...] = ()


class DaemonConfig(ConfigModel):
    """A whole configuration."""

    publish: Address = PUBLISH_ADDRESS
    commands: Address = COMMAND_ADDRESS
    curve: CurveConfig | None = Field(None, description="keys, for addresses that are not on this machine alone")
    fingertips: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")], FingertipConfig] = Field(
        default_factory=dict
    )
    combined: CombinedConfig | None = Field(
        None, description="an estimate from both fingertips together, published as `combined`"
    )
    skin: SkinConfig | None = None
    load_cell: LoadCellConfig | None = None
    robot: Path | None = Field(None, description="the robot's settings, a file such as config/ur.yaml")
    gripper: GripperConfig | None = None
    loop: LoopConfig = LoopConfig()
    experiment: Path | None = Field(None, description="started as soon as all devices are there")
    stop_when_done: bool = Field(
        False, description="whether the daemon ends with that experiment: status 0 when done, else 3"
    )
    recording: RecordingConfig | None = Field(None, description="without one, nothing is recorded")
    lock_memory: bool = Field(False, description="keep all memory out of swap, see docs/service.md")
    emulators: tuple[EmulatorConfig, ...] = ()

    @model_validator(mode="after")
    def _loop_is_whole(self) -> "DaemonConfig":
        if not self.fingertips and self.skin is None:
            raise ValueError("nothing is measured: give `fingertips`, a `skin`, or both")
        if taken := sorted(TAKEN_NAMES & self.fingertips.keys()):
            raise ValueError(
                f"a fingertip cannot be named {taken[0]!r}, as another part of the daemon is: try right or left"
            )
        if self.combined is not None and len(self.fingertips) < 2:
            raise ValueError("`combined` needs two `fingertips`, named as the sides of its calibration: right and left")
        for key, address in self.network_addresses.items():
            if self.curve is None:
                raise ValueError(open_to_the_network(address, key))
        if self.publish == self.commands and not self.publish.endswith(":*"):
            raise ValueError(f"`publish` and `commands` are both {self.publish}; give each an address of its own")
        for port, keys in self._ports().items():
            if len(keys) > 1:
                raise ValueError(f"`{keys[0]}` and `{keys[1]}` are both {port}; each device has its own")
        if self.experiment is not None and self.robot is None:
            raise ValueError("an experiment needs a robot: add `robot: ur.yaml`, or take `experiment` out")
        if self.gripper is not None and self.robot is None:
            raise ValueError("a gripper without a robot cannot be driven: add `robot: ur.yaml`, or take `gripper` out")
        return self

    def _ports(self) -> dict[str, list[str]]:
        """Return the keys that name each serial port and each socket."""
        found: dict[str, list[str]] = {}
        for key, section in _sections(self, ""):
            match section:
                case SerialDevice(serial_number=str(number)):
                    found.setdefault(f"the port with the serial number {number}", []).append(key)
                case SerialDevice(path=Path() as path):
                    found.setdefault(f"the port {os.path.normpath(path)}", []).append(key)
                case InstrumentSocket(host=host, port=port):
                    found.setdefault(f"{host}:{port}", []).append(key)
        return found

    @property
    def network_addresses(self) -> dict[str, str]:
        """The keys and addresses that can be reached from beyond this machine."""
        addresses = {"publish": self.publish, "commands": self.commands}
        return {key: address for key, address in addresses.items() if not stays_on_this_machine(address)}


def load_daemon_config(path: Path) -> DaemonConfig:
    """Return the configuration in a YAML file, with the paths in it taken from the file's own folder.

    Raises UserError naming every mistake at once.
    """
    config = load_yaml_model(path, DaemonConfig)
    folder = path.resolve().parent
    return _from_folder(config, folder)


def _sections(section: ConfigModel, key: str) -> Iterator[tuple[str, ConfigModel]]:
    """Yield every section within a section, with its key in the file."""
    for name in type(section).model_fields:
        value, own = getattr(section, name), f"{key}.{name}".lstrip(".")
        inner = {f"{own}.{part}": item for part, item in value.items()} if isinstance(value, dict) else {own: value}
        for path, item in inner.items():
            if isinstance(item, ConfigModel):
                yield path, item
                yield from _sections(item, path)


Model = TypeVar("Model", bound=ConfigModel)


def _from_folder(section: Model, folder: Path) -> Model:
    """Return the section with every relative path in it taken from a folder."""
    changed: dict[str, object] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Path):
            # Normalised, not resolved: a port's link must be named, and not what it points to today.
            changed[name] = Path(os.path.normpath(folder / value))
        elif isinstance(value, ConfigModel):
            changed[name] = _from_folder(value, folder)
        elif isinstance(value, dict):
            changed[name] = {key: _from_folder(item, folder) for key, item in value.items()}
    return section.model_copy(update=changed)
