"""The daemon's configuration. Units are in the keys; unknown keys are refused; loaded values do not change."""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from shearloop.daemon.config_file import NAMED_FILES, ConfigModel, FileKind, either, load_yaml_model, not_of_kind
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging import addresses
from shearloop.daemon.torques import SIGNS, Direction
from shearloop.drivers import ranges
from shearloop.drivers.defaults import (
    ADC_FULL_SCALE_V,
    DAQ_RATE_HZ,
    DRIFT_PER_HOUR,
    FRAME_PERIOD_S,
    LOAD_CELL_RATE_HZ,
    SCANNER_CHANNELS,
    SCANNER_RANGE_V,
    SOURCE_BAUD,
    SOURCE_COMPLIANCE_V,
    SOURCE_CURRENT_MA,
    URCAP_PORT,
)
from shearloop.drivers.hosts import is_loopback_host, one_spelling, why_no_address, why_no_host
from shearloop.drivers.robotiq.models import MODELS, GripperModel, ModelName
from shearloop.estimation.defaults import BASELINE_FRAMES
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.words import shown

# Names of other tasks, sources and recordings; a fingertip needs a different one.
TAKEN_NAMES = {
    *("load_cell", "wrench", "skin", "combined", "robot", "gripper", "loop", "experiment", "recording"),
    *("commands", "stop", "publish", "clients", "health", "daemon", "clock", "memory"),
}


def _known_transport(address: str, info: ValidationInfo) -> str:
    usual = addresses.usual(str(info.field_name))
    if not address.startswith(("ipc://", "tcp://")):
        raise ValueError(f"must be ipc or a tcp address, for this machine only a loopback one: {usual}")
    address = addresses.expanded(address)
    if not addresses.has_valid_port(address):
        raise ValueError(f"must end in a port, a whole number from 1 to {addresses.LARGEST_PORT}, as in {usual}")
    if addresses.names_localhost(address):
        raise ValueError("names localhost, and a socket is bound to an address: write 127.0.0.1 instead of localhost")
    if (size := addresses.ipc_size(address)) > addresses.LONGEST_IPC:
        raise ValueError(
            f"has a path of {size} bytes, and a socket's has at most {addresses.LONGEST_IPC}: choose a shorter one"
        )
    return address


_NAME = r"^[a-z][a-z0-9_-]{0,31}$"


def _valid_host(host: str) -> str:
    if reason := why_no_host(host):
        raise ValueError(f"{shown(host)} {reason}; give the device's name or address")
    return host


def _valid_address(host: str) -> str:
    if reason := why_no_address(host):
        raise ValueError(f"{shown(host)} {reason}")
    return host


def _valid_name(name: str) -> str:
    if not re.fullmatch(_NAME, name):
        near = re.sub(r"[^a-z0-9_-]", "_", name.lower())
        hint = f"; did you mean {near}?" if re.fullmatch(_NAME, near) else ""
        form = "a lower-case letter, then up to 31 lower-case letters, digits, - and _"
        raise ValueError(f"{shown(name)} is no name of a fingertip: a name is {form}{hint}")
    return name


Address = Annotated[str, AfterValidator(_known_transport)]
# A multimeter's channels are numbered with the slot first, such as 1601.
Channel = Annotated[int, Field(ge=1, le=9999)]
FingertipName = Annotated[str, AfterValidator(_valid_name), WithJsonSchema({"type": "string", "pattern": _NAME})]
Host = Annotated[str, AfterValidator(_valid_host)]
DeviceAddress = Annotated[str, AfterValidator(_valid_address)]


class CurveConfig(ConfigModel):
    """Keys for addresses that are open to the network; made by `shearloop keys server`."""

    server_key: Path = Field(description="the daemon's own .key_secret; under systemd the credential with this name")
    clients: Path = Field(description="the allow-list: a folder with the .key of each client")


class SerialDevice(ConfigModel):
    """A board on a serial port, identified by its serial number or by a path."""

    serial_number: str | None = Field(None, min_length=1, description="USB serial number, as the port's maker set it")
    path: Path | None = Field(None, description="path of the port, such as /dev/serial/by-id/…")

    _one_name = either("serial_number", "path")


class CreepConfig(ConfigModel):
    """Loss of a gel's torque under a held shear."""

    share: float = Field(ge=0, lt=1, description="final loss, as a fraction of the torque")
    time_s: float = Field(gt=0, le=3600, description="time constant")


class FingertipConfig(ConfigModel):
    """One EIT fingertip: its board, its bank and its calibration."""

    device: SerialDevice = Field(description="the board's serial port")
    bank: Path | None = Field(
        None, description="bank of `shearloop bank build`, for k, sigma, heatmaps and the estimator `paper`"
    )
    calibration: Path | None = Field(
        None, description="calibration; without one the daemon publishes k and sigma, but no torque"
    )
    estimator: EstimatorName | None = Field(None, description="required estimator; default: the calibration's")
    matching: Literal["all_lags", "zero_lag"] = Field("all_lags", description="shifts of a frame to search")
    baseline_frames: int = Field(BASELINE_FRAMES, ge=2, le=1000, description="frames in the idle frame of a tare")
    average_frames: int = Field(1, ge=1, le=100, description="latest frames averaged before matching")
    creep: CreepConfig | None = Field(None, description="creep of the gel, which the loop subtracts from its torque")
    frame_period_s: float = Field(FRAME_PERIOD_S, gt=0, le=60, description="frame period before it is measured")
    heatmap: Literal["on_request", "always"] = Field("on_request", description="when to compute eit.heatmap")


class CombinedConfig(ConfigModel):
    """One estimate from several fingertips on one tool; their names are the sides of the calibration."""

    calibration: Path = Field(description="made by `shearloop calibrate` from recordings of all these sides")
    estimator: EstimatorName | None = Field(None, description="required estimator; default: the calibration's")
    creep: CreepConfig | None = Field(None, description="creep of the gels, as for a single fingertip")


class LoadCellConfig(ConfigModel):
    """The load cell on the lever."""

    device: SerialDevice = Field(description="the board's serial port")
    calibration: Path | None = Field(None, description="calibration; default: the board sends torques in N·m")
    rate_hz: float = Field(LOAD_CELL_RATE_HZ, gt=0, le=1000, description="lines per second")
    direction: Direction | None = Field(
        None, description="the only direction of torques that the lever measures; default: both"
    )

    @property
    def only_sign(self) -> int:
        """The sign of the only torques that the lever measures; 0 for both."""
        return 0 if self.direction is None else SIGNS[self.direction]


class InstrumentSocket(ConfigModel):
    """An instrument on the network, or a serial one behind a terminal server."""

    host: Host = Field(description="name or address")
    port: int = Field(ge=1, le=65535, description="TCP port, as set on the instrument or server")


class SkinSourceConfig(ConfigModel):
    """The Keithley 6430 that feeds the skin's gauges, on RS-232 or a socket."""

    socket: InstrumentSocket | None = Field(None, description="its network address; else `serial`")
    serial: SerialDevice | None = Field(None, description="its RS-232 port; else `socket`")
    baud: int = Field(
        SOURCE_BAUD, ge=300, le=57600, description="speed of the RS-232 interface, as set on the instrument"
    )
    current_ma: float = Field(SOURCE_CURRENT_MA, gt=0, le=20, description="current through both gauges in series")
    compliance_v: float = Field(SOURCE_COMPLIANCE_V, gt=0, le=5, description="largest voltage of the source")

    _one_way_in = either("socket", "serial")


class ScannerConfig(ConfigModel):
    """A scanning multimeter on a socket."""

    socket: InstrumentSocket = Field(description="its network address")
    channels: tuple[Channel, Channel] = Field(SCANNER_CHANNELS, description="channels of gauge 1 and 2")
    range_v: float = Field(
        SCANNER_RANGE_V, gt=0, le=300, description="measuring range, which must exceed each gauge's voltage"
    )

    @model_validator(mode="after")
    def _two_channels(self) -> "ScannerConfig":
        if self.channels[0] == self.channels[1]:
            raise ValueError(f"gives both gauges the channel {self.channels[0]}; each has its own")
        return self


class AdcConfig(ConfigModel):
    """A converter board that sends lines `v1,v2` in volts."""

    device: SerialDevice = Field(description="the board's serial port")
    full_scale_v: float = Field(ADC_FULL_SCALE_V, gt=0, le=10, description="largest voltage of the converter")


class SkinDaqConfig(ConfigModel):
    """The instrument that reads the gauges' voltages: a scanner or an ADC board."""

    scanner: ScannerConfig | None = Field(None, description="a scanning multimeter; else `adc`")
    adc: AdcConfig | None = Field(None, description="a converter board; else `scanner`")
    rate_hz: float = Field(DAQ_RATE_HZ, ge=1, le=1000, description="readings of both gauges per second")
    average_s: float = Field(
        0.0, ge=0, le=10, description="time of readings that are averaged into one sample; 1 as in the paper's DAQ"
    )

    _one_way_in = either("scanner", "adc")

    @property
    def averaged(self) -> int:
        """The readings of one sample."""
        return max(round(self.average_s * self.rate_hz), 1)

    @property
    def sample_period_s(self) -> float:
        """The time from sample to sample."""
        return self.averaged / self.rate_hz


class SkinConfig(ConfigModel):
    """The shear skin: its instruments, its calibration and its contact."""

    source: SkinSourceConfig = Field(description="the current source")
    daq: SkinDaqConfig = Field(description="the instrument that reads the voltages")
    calibration: Path = Field(description="made by `shearloop skin calibrate`")
    normal_n: float = Field(1.0, ge=0, le=100, description="normal force on the skin, for its friction")
    tool_radius_mm: float | None = Field(
        None, gt=0, le=200, description="distance from wrist axis to skin, for the torque"
    )
    zero_samples: int = Field(20, ge=10, le=1000, description="readings averaged into the zero")
    drift_per_hour: float = Field(DRIFT_PER_HOUR, ge=0, le=1, description="95 % bound of the response's drift")


class GripperSocket(ConfigModel):
    """The gripper behind the URCap's socket."""

    host: DeviceAddress = Field(description="the robot's address, as in its settings; else a real rig does not run")
    port: int = Field(URCAP_PORT, ge=1, le=65535, description="TCP port of the URCap")


class GripperConfig(ConfigModel):
    """The gripper, on a socket or on Modbus."""

    # No status of a gripper says which model it is.
    model: ModelName = Field(description="the model, as on its type plate; it sets stroke, speeds, forces and counts")
    socket: GripperSocket | None = Field(None, description="connection through the robot's URCap; else `modbus`")
    modbus: SerialDevice | None = Field(None, description="Modbus RTU by USB; else `socket`")
    calibration: Path | None = Field(
        None, description="calibration of `shearloop calibrate gripper`; default: the maker's data"
    )

    _one_way_in = either("socket", "modbus")


class RecordingConfig(ConfigModel):
    """Recordings of all messages and raw inputs, one file per experiment."""

    folder: Path = Field(description="folder, created if missing; a rig with one fingertip writes some 50 MB an hour")


class EventConfig(ConfigModel):
    """A command to an emulated device during an experiment."""

    step: int = Field(ge=1, le=1000, description="number of the experiment's step, from 1")
    held_for_s: ranges.Seconds = Field(0.0, description="delay after the step begins to hold its torque or angle")
    command: str = Field(min_length=1, pattern=r"^[^\n]*$", description="see the emulator's --help")


class EmulatorConfig(ConfigModel):
    """A device that is emulated by its own process, for demonstrations."""

    device: str = Field(description="a device of `shearloop emulate`")
    arguments: tuple[str, ...] = Field((), description="arguments of `shearloop emulate`; see its --help")
    synthetic: tuple[str, ...] = Field((), description="further arguments, unless a recording is played")
    events: tuple[EventConfig, ...] = Field((), description="commands to the device during an experiment")


class DaemonConfig(ConfigModel):
    """A whole configuration."""

    _kind = not_of_kind(
        FileKind(
            "an experiment",
            "name it in a configuration as `experiment`, or start it with `shearloop command start --experiment FILE`",
            ("steps",),
        ),
        *NAMED_FILES,
    )

    name: str = Field("", max_length=60, description="name of the rig, for the page; default: the name of this file")
    publish: Address = Field(addresses.PUBLISH_ADDRESS, description="ZeroMQ address of the messages")
    commands: Address = Field(addresses.COMMAND_ADDRESS, description="ZeroMQ address of the commands")
    curve: CurveConfig | None = Field(None, description="keys for addresses that are open to the network")
    fingertips: dict[FingertipName, FingertipConfig] = Field(default_factory=dict, description="by name: right, left")
    combined: CombinedConfig | None = Field(None, description="one estimate of both fingertips")
    skin: SkinConfig | None = Field(None, description="the shear skin")
    load_cell: LoadCellConfig | None = Field(None, description="the load cell")
    robot: Path | None = Field(None, description="the robot's settings, a file such as config/ur.yaml")
    gripper: GripperConfig | None = Field(None, description="the gripper; needs `robot`")
    commissioned: Path | None = Field(
        None, description="report of `shearloop commission`; without one a real robot is capped"
    )
    loop: LoopConfig = Field(LoopConfig(), description="settings of the closed loop")
    emulated: bool = Field(
        False, description="every device is emulated on this computer; real addresses and controllers are refused"
    )
    emulated_deadlines: Literal["patient", "real"] = Field(
        "patient", description="deadlines of an emulated rig: longer for a busy computer, or as on a real rig"
    )
    experiment: Path | None = Field(
        None, description="the experiment that `shearloop command start` runs if it names no other one"
    )
    autostart: bool = Field(False, description="start `experiment` as soon as nothing refuses it; needs `emulated`")
    experiments: tuple[Path, ...] = Field(
        (),
        validate_default=True,
        description="folders of the experiments that `start` may name; default: this file's folder",
    )
    stop_when_done: bool = Field(
        False, description="the daemon ends with the experiment: status 0 if done, else 3 or 4"
    )
    recording: RecordingConfig | None = Field(None, description="where to record; default: no recording")
    lock_memory: bool = Field(False, description="keep all memory out of swap, see docs/service.md")
    emulators: tuple[EmulatorConfig, ...] = Field((), description="devices that are emulated; needs `emulated`")
    _file: Path | None = PrivateAttr(None)

    @field_validator("experiments")
    @classmethod
    def _own_folder(cls, folders: tuple[Path, ...], info: ValidationInfo) -> tuple[Path, ...]:
        if not info.context:
            return folders
        own: Path = info.context["folder"]
        return folders or (own,)

    @property
    def real(self) -> "DaemonConfig":
        """What a report is about: this configuration, or the one that it rehearses."""
        return self

    @property
    def file(self) -> Path | None:
        """The file that it was read from, None if it was made in another way."""
        return self._file

    def note_file(self, path: Path) -> None:
        """Note the file that it was read from."""
        self._file = path

    @property
    def experiment_folders(self) -> tuple[Path, ...]:
        """The folders of the experiments that a request may name: the configured ones and `experiment`'s."""
        return (*self.experiments, *((self.experiment.parent,) if self.experiment is not None else ()))

    @property
    def gripper_model(self) -> GripperModel | None:
        """The model of the configured gripper, if there is one."""
        return MODELS[self.gripper.model] if self.gripper is not None else None

    @model_validator(mode="after")
    def _measures_and_is_consistent(self) -> "DaemonConfig":
        if not self.fingertips and self.skin is None and self.load_cell is None:
            raise ValueError("nothing is measured: give `fingertips`, a `skin` or a `load_cell`")
        if taken := sorted(TAKEN_NAMES & self.fingertips.keys()):
            text = f"`fingertips.{taken[0]}` has the name of another part of the daemon"
            raise ValueError(f"{text}: name the fingertip right or left")
        if self.combined is not None and len(self.fingertips) < 2:
            raise ValueError("`combined` needs two `fingertips`, named as the sides of its calibration: right and left")
        for key, address in self.network_addresses.items():
            if self.curve is None:
                raise ValueError(addresses.network_refusal(address, key))
        if self.publish == self.commands and not self.publish.endswith(":*"):
            raise ValueError(f"`publish` and `commands` are both {self.publish}; give them different addresses")
        for port, keys in self._ports().items():
            if len(keys) > 1:
                raise ValueError(f"`{keys[0]}` and `{keys[1]}` are both {port}; each device needs its own")
        if self.autostart and not self.emulated:
            raise ValueError(
                "`autostart` moves the robot without a command: it needs `emulated: true`; "
                "on a real rig take it out, and send `shearloop command start`"
            )
        if self.autostart and self.experiment is None:
            raise ValueError("`autostart` starts no experiment: name one in `experiment`, or take `autostart` out")
        for key, device in self._real_devices():
            if self.emulated:
                raise ValueError(f"`emulated: true` and `{key}: {device}`, a real device: take one of the two out")
        if self.emulators and not self.emulated:
            raise ValueError("`emulators` play devices: add `emulated: true`, or take the emulators out")
        return self

    @model_validator(mode="after")
    def _has_its_robot(self) -> "DaemonConfig":
        needs = {
            "experiment": "an experiment needs a robot",
            "commissioned": "`commissioned` is of a robot",
            "gripper": "a gripper without a robot cannot be driven",
        }
        for key, why in needs.items():
            if getattr(self, key) is not None and self.robot is None:
                raise ValueError(f"{why}: add `robot: ur.yaml`, or take `{key}` out")
        return self

    @property
    def gripper_address(self) -> tuple[str, int] | None:
        """Host and port of the gripper's socket, None without one."""
        socket = self.gripper.socket if self.gripper is not None else None
        return (socket.host, socket.port) if socket is not None else None

    def _real_devices(self) -> Iterator[tuple[str, str]]:
        """Yield the key and the name of each device that no emulator plays."""
        for key, section in self.walk():
            match section:
                case SerialDevice(serial_number=str(number)):
                    yield f"{key}.serial_number", number
                case SerialDevice(path=Path() as path) if _is_hardware(path.resolve()):
                    yield f"{key}.path", str(path)
                case InstrumentSocket(host=host) | GripperSocket(host=host) if not is_loopback_host(host):
                    yield f"{key}.host", host

    @property
    def device_addresses(self) -> dict[str, str]:
        """The serial number, path or socket of each device, by its key; the robot's is in its own settings."""
        found: dict[str, str] = {}
        for key, section in self.walk():
            if isinstance(section, SerialDevice):
                found[key] = section.serial_number or str(section.path)
            elif isinstance(section, InstrumentSocket | GripperSocket):
                found[key] = f"{section.host}:{section.port}"
        return found

    def _ports(self) -> dict[str, list[str]]:
        """Return the configuration keys of each serial port and socket."""
        found: dict[str, list[str]] = {}
        for key, section in self.walk():
            match section:
                case SerialDevice(serial_number=str(number)):
                    found.setdefault(f"the port with the serial number {number}", []).append(key)
                case SerialDevice(path=Path() as path):
                    # A name in /dev/serial/by-id is a link to the port.
                    port_path = os.path.realpath(path) if path.is_symlink() else os.path.normpath(path)
                    found.setdefault(f"the port {port_path}", []).append(key)
                case InstrumentSocket(host=host, port=port):
                    found.setdefault(f"{one_spelling(host)}:{port}", []).append(key)
        return found

    @property
    def network_addresses(self) -> dict[str, str]:
        """The configuration keys and addresses that are open to the network."""
        both = {"publish": self.publish, "commands": self.commands}
        return {key: address for key, address in both.items() if not addresses.is_local(address)}


def _is_hardware(port: Path) -> bool:
    """Return whether a port is in /dev, but no pseudo-terminal; a missing port counts as no port in /dev."""
    return port.is_relative_to("/dev") and not port.is_relative_to("/dev/pts")


def load_daemon_config(path: Path, values: Mapping[str, str] | None = None) -> DaemonConfig:
    """Return the configuration of a YAML file, some `values` of it replaced; raises UserError with every mistake."""
    config = load_yaml_model(path, DaemonConfig, values)
    named = config if config.name else config.model_copy(update={"name": path.stem})
    named.note_file(path)
    return named
