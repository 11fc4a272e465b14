"""A rehearsal: a configuration of real devices, with an emulated one in the place of each."""

import contextlib
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shearloop.cli.free_ports import LOOPBACKS, free_loopback, free_port
from shearloop.cli.temporary_folders import run_folder
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS
from shearloop.drivers.defaults import URCAP_PORT
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig, FingertipConfig, LoadCellConfig, SkinConfig
    from shearloop.drivers.ur.settings import UrSettings

# Control cycles per second: twice the states that the daemon asks for, and gentle to this computer.
EMULATED_RATE_HZ = "250"
# Of the emulated tool, where no experiment of the configuration has a `tool_mm`.
_TOOL_MM = 20


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The configuration to run, and the sentences that name the emulator of each device."""

    config: "DaemonConfig"
    sentences: tuple[str, ...]


@contextlib.contextmanager
def rehearsal(config: "DaemonConfig", path: Path) -> Iterator[Rehearsal]:
    """Yield the configuration with emulated devices; its ports and settings are in a temporary folder.

    Every port, address and serial number of the configuration is replaced: none of the real devices is opened.

    Raises:
        UserError: the configuration is emulated already, or a device cannot be played; DriverError: wrong settings.
    """
    if config.emulated or config.emulators:
        raise UserError(f"{path} is emulated already: run it without --emulate")
    with run_folder() as folder:
        yield _DeviceReplacer(config, path, folder).rehearsal()


def refuse_what_cannot_be_emulated(config: "DaemonConfig", path: Path) -> None:
    """Raise UserError for a real rig that has a fingertip without a bank, or a workspace beyond the emulated arm."""
    from shearloop.drivers.errors import DriverError
    from shearloop.drivers.ur.settings import read_settings

    if config.emulated:
        return
    for name, fingertip in config.fingertips.items():
        _bank(name, fingertip, path)
    if config.robot is None:
        return
    # The check of the robot's settings reports their mistakes.
    with contextlib.suppress(DriverError):
        _robot_arguments(read_settings(config.robot))


def sentences_of_run(config: "DaemonConfig") -> Iterator[str]:
    """Yield what a run with a rehearsed configuration starts and records, and the cap of its robot.

    Raises UserError for a report that cannot be read.
    """
    from shearloop.daemon.report_in_use import commissioning_of
    from shearloop.daemon.rig import open_settings

    if (settings := open_settings(config)) is not None:
        yield commissioning_of(config, settings).sentence
    if config.experiment is not None:
        yield f"{config.experiment} starts by itself, and ends the rehearsal"
    elif settings is not None:
        reached = f" --connect {shlex.quote(config.commands)}" if config.commands != COMMAND_ADDRESS else ""
        yield f"no `experiment` is configured: start one with `shearloop command start --experiment FILE{reached}`"
    if config.recording is not None:
        yield f"recordings go into {config.recording.folder}"


class _DeviceReplacer:
    """Replaces one device after the other."""

    def __init__(self, config: "DaemonConfig", path: Path, folder: Path) -> None:
        self._config = config
        self._path = path
        self._folder = folder
        # As a file has it, to be checked again once every device is replaced.
        self._content: dict[str, Any] = config.model_dump()
        # A report supplies values that are not given.
        self._content["loop"] = config.loop.model_dump(exclude_unset=True)
        self._emulators: list[dict[str, Any]] = []
        self._sentences = ["every device is played on this computer; none of the real ones is opened"]
        self._host = free_loopback() if config.robot is not None else LOOPBACKS[0]

    def rehearsal(self) -> Rehearsal:
        """Replace all devices."""
        from shearloop.cli.rehearsed_config import RehearsedConfig

        config = self._config
        robot = self._robot(config.robot) if config.robot is not None else None
        # Without another sensor on the tool, the robot turns it on the skin.
        others = config.fingertips or config.load_cell is not None or config.gripper is not None
        on_skin = config.skin is not None and not others
        skin = self._skin(config.skin) if config.skin is not None else []
        if robot is not None and not on_skin:
            self._rig(robot, skin)
        else:
            self._boards()
            if skin:
                turned = ["--robot", self._host, *_robot_arguments(robot)] if robot is not None else []
                self._emulators.append({"device": "skin", "arguments": skin + turned})
        if config.experiment is not None:
            self._content |= {"autostart": True, "stop_when_done": True}
        if config.recording is not None:
            self._content["recording"] = {"folder": config.recording.folder / "emulated"}
        self._content |= {"emulated": True, "emulators": self._emulators}
        return Rehearsal(RehearsedConfig(config, self._content), tuple(self._sentences))

    def _robot(self, source: Path) -> "UrSettings":
        """Write the robot's settings of a file with a loopback address, and return them."""
        import yaml

        from shearloop.daemon.rig import robot_settings, why_not_driven
        from shearloop.yaml_files import read_yaml

        settings = robot_settings(source)
        copy = self._folder / "ur.yaml"
        copy.write_text(yaml.safe_dump({**read_yaml(source, UserError), "host": self._host}), encoding="utf-8")
        self._content["robot"] = copy
        self._sentences.append(
            f"the robot at {settings.host} is played at {self._host}; its limits are those of {source}"
        )
        self._sentences += why_not_driven(self._config, settings)
        return replace(settings, host=self._host)

    def _rig(self, robot: "UrSettings", skin: list[str]) -> None:
        """Play robot, gripper, load cell, fingertips and skin over one physics; `skin` are the skin's arguments."""
        config = self._config
        arguments = ["--host", self._host, "--run-dir", str(self._folder), *_robot_arguments(robot), *skin]
        if skin:
            self._sentences.append("the skin bears the whole torque of the emulated tool, as its other sensors do")
        for name, fingertip in config.fingertips.items():
            arguments += ["--fingertip", name, _bank(name, fingertip, self._path)]
            self._replace_port("fingertips", name, link=self._folder / f"eit-{name}")
        if config.load_cell is not None:
            arguments += self._load_cell(config.load_cell)
        else:
            arguments.append("--no-load-cell")
        arguments += self._gripper()
        arguments += ["--diameter-mm", self._tool_mm()]
        self._emulators.append({"device": "rig", "arguments": arguments})

    def _tool_mm(self) -> str:
        """Return the diameter of the emulated tool, which all experiments of the rehearsal grip."""
        from shearloop.daemon.experiment_files import read_document

        experiment = self._config.experiment
        named = read_document(experiment).content.get("tool_mm") if experiment is not None else None
        tool_mm = str(_TOOL_MM if named is None else named)
        reason = (
            f"as `tool_mm` of {experiment} says" if named is not None else "as no `experiment` with `tool_mm` is named"
        )
        self._sentences.append(
            f"the emulated tool has a diameter of {tool_mm} mm, {reason}; "
            "every experiment that you start grips this tool"
        )
        return tool_mm

    def _boards(self) -> None:
        """Play boards that no robot turns: each repeats a programme of twists, or rests."""
        for name, fingertip in self._config.fingertips.items():
            link = self._folder / f"eit-{name}"
            self._replace_port("fingertips", name, link=link)
            source = ["--bank", _bank(name, fingertip, self._path)]
            self._emulators.append({"device": "eit-kit", "arguments": ["--link", str(link)], "synthetic": source})
        if (cell := self._config.load_cell) is not None:
            arguments = ["--link", str(self._folder / "load-cell"), *self._load_cell(cell)]
            self._emulators.append({"device": "hx711", "arguments": arguments})

    def _load_cell(self, cell: "LoadCellConfig") -> list[str]:
        self._replace_port("load_cell", link=self._folder / "load-cell")
        calibration = ["--paper-sketch"] if cell.calibration is None else ["--load-calibration", str(cell.calibration)]
        return [*calibration, "--load-rate-hz", str(cell.rate_hz)]

    def _gripper(self) -> list[str]:
        gripper = self._config.gripper
        if gripper is None:
            self._sentences.append("no gripper is configured: the tool is clamped to the wrist")
            return ["--gripper", "none"]
        section = self._content["gripper"]
        if gripper.socket is not None:
            section["socket"] = {"host": self._host, "port": URCAP_PORT}
            where, interface = f"{self._host}:{URCAP_PORT}", "socket"
        else:
            section["modbus"] = {"path": self._folder / "gripper"}
            where, interface = str(self._folder / "gripper"), "modbus"
        self._sentences.append(f"the gripper, a {gripper.model}, is played at {where}")
        return ["--gripper", interface, "--model", gripper.model]

    def _skin(self, skin: "SkinConfig") -> list[str]:
        """Replace the addresses of the skin's instruments, and return the emulator's arguments for it."""
        arguments = ["--bind", LOOPBACKS[0], "--normal-n", str(skin.normal_n)]
        if skin.tool_radius_mm is not None:
            arguments += ["--radius-mm", str(skin.tool_radius_mm)]
        section = self._content["skin"]
        arguments += self._instrument(section["source"], "source", "socket", "serial")
        if skin.daq.scanner is not None:
            arguments += self._instrument(section["daq"]["scanner"], "daq", "socket", "")
        else:
            arguments += self._instrument(section["daq"]["adc"], "daq", "", "device")
            arguments += ["--daq-rate-hz", str(skin.daq.rate_hz)]
        return arguments

    def _instrument(self, section: dict[str, Any], name: str, by_socket: str, by_serial: str) -> list[str]:
        """Replace the address of an instrument, and return the emulator's arguments for the new one."""
        if by_socket and section.get(by_socket) is not None:
            was, port = section[by_socket], free_port(LOOPBACKS[0])
            self._sentences.append(
                f"the skin's {name} at {was['host']}:{was['port']} is played at {LOOPBACKS[0]}:{port}"
            )
            section[by_socket] = {"host": LOOPBACKS[0], "port": port}
            return [f"--{name}-port", str(port)]
        link = self._folder / f"skin-{name}"
        self._sentences.append(f"the skin's {name} is played at {link}")
        section[by_serial] = {"path": link}
        return [f"--{name}-link", str(link)]

    def _replace_port(self, *keys: str, link: Path) -> None:
        """Replace the serial port of a board."""
        section = self._content
        for key in keys:
            section = section[key]
        was = section["device"]
        section["device"] = {"path": link}
        self._sentences.append(f"`{'.'.join(keys)}`, {was['serial_number'] or was['path']}, is played at {link}")


def _robot_arguments(robot: "UrSettings") -> list[str]:
    """Return the emulator's arguments for the pose, the payload and the tool centre point that the settings allow."""
    from shearloop.emulators.ur_arm import joints_within

    limits, tool = robot.limits, robot.tool
    offset = tool.tcp_offset or (0.0,) * 6
    margin_rad = limits.joints.margin_rad
    joints_rad = joints_within(
        [low + margin_rad for low in limits.joints.lower_rad],
        [high - margin_rad for high in limits.joints.upper_rad],
        limits.box.lower_m,
        limits.box.upper_m,
        offset,
    )
    if joints_rad is None:
        box = ", ".join(
            f"{axis} from {low:g} to {high:g} m"
            for axis, low, high in zip("xyz", limits.box.lower_m, limits.box.upper_m, strict=True)
        )
        raise UserError(
            "the emulated arm, a UR5e, reaches no point in the middle of the workspace with its tool downwards: "
            f"{box}; check `limits.workspace` and `limits.joints` of the robot's settings"
        )
    arguments = ["--rate-hz", EMULATED_RATE_HZ, "--joints-rad", *(f"{angle:.6f}" for angle in joints_rad)]
    arguments += ["--tcp-offset", *map(str, offset)]
    if robot.generation == "cb3":
        arguments.append("--cb3")
    if tool.payload_kg is not None:
        arguments += ["--payload-kg", str(tool.payload_kg)]
    if tool.payload_cog_m is not None:
        arguments += ["--payload-cog-m", *map(str, tool.payload_cog_m)]
    return arguments


def _bank(name: str, fingertip: "FingertipConfig", path: Path) -> str:
    if fingertip.bank is None:
        raise UserError(
            f"{path}: `fingertips.{name}` has no `bank`, whose signals make the emulated frames; give one, "
            "built with `shearloop bank build`"
        )
    return str(fingertip.bank)
