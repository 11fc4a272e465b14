"""Identifies the rig of a commissioning's report: versions, the robot's serial number, and hashes of its settings.

Keys and files that only some stages judge have separate hashes. After a change only those stages are measured again.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from shearloop.daemon.config import DaemonConfig
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.script import own_script_hash
from shearloop.drivers.ur.settings import read_settings
from shearloop.errors import UserError

# The parts of a configuration that name devices.
_DEVICE_KEYS: Final[Any] = {
    "fingertips": {"__all__": {"device", "frame_period_s"}},
    "skin": {"source", "daq"},
    "load_cell": {"device", "rate_hz"},
    "gripper": {"model", "socket", "modbus"},
}
# Keys and files that only some stages judge, with the first figures of the stages. Of a file only the content counts.
_JUDGED_BY: Final = {
    "gripper.calibration": "2",
    "reaction_s": "3",
    "rest_rad_per_s": "34",
    "limits.force_n": "5",
    "limits.torque_nm": "5",
    "load_cell.calibration": "67",
}


class Record(BaseModel):
    """A part of a report."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class RigIdentity(Record):
    """Which rig a report is about: hashes in hexadecimal, versions, and the robot's serial number."""

    emulated: bool
    configuration_sha256: str
    robot_settings_sha256: str
    script_sha256: str
    ur_rtde: str
    polyscope: str
    robot_serial_number: str

    def differences(self, other: "RigIdentity") -> Iterator[str]:
        """Yield each difference in words."""
        for key, what in _IDENTITY.items():
            if getattr(self, key) != getattr(other, key):
                yield what


_IDENTITY: Final = {
    "emulated": "`emulated`",
    "configuration_sha256": "the devices in the configuration",
    "robot_settings_sha256": "the robot's settings",
    "script_sha256": "the script for the robot",
    "ur_rtde": "the version of ur-rtde",
    "polyscope": "the version of PolyScope",
    "robot_serial_number": "the robot's serial number",
}


def identity_of(config: DaemonConfig, polyscope: str, robot_serial_number: str) -> RigIdentity:
    """Return which rig this is, a rehearsal being the one that it plays, on emulated devices.

    Raises UserError where a file that the configuration names cannot be read.
    """
    devices = config.real.model_dump(mode="json", exclude_unset=True, include=_DEVICE_KEYS)
    settings, _ = _settings_of(config)
    return RigIdentity(
        emulated=config.emulated,
        configuration_sha256=_sha256_of(devices),
        robot_settings_sha256=_sha256_of(settings),
        script_sha256=own_script_hash(),
        ur_rtde=_installed("ur-rtde"),
        polyscope=polyscope,
        robot_serial_number=EMULATED_SERIAL_NUMBER if config.emulated else robot_serial_number,
    )


def why_not_emulated(host: str, robot_serial_number: str) -> str:
    """Return that the controller at an address is no emulated one, by its serial number, or an empty string."""
    if robot_serial_number == EMULATED_SERIAL_NUMBER:
        return ""
    return (
        f"The configuration says `emulated: true`, and the controller at {host} is no emulated one: its serial number "
        f"is {robot_serial_number or 'unknown'}, not {EMULATED_SERIAL_NUMBER}; take `emulated` out for a real robot."
    )


def judged_sha256s(config: DaemonConfig) -> dict[str, str]:
    """Return the hash of each value and file that only some stages judge, by its key; raises UserError."""
    real = config.real
    _, judged = _settings_of(config)
    gripper, load_cell = real.gripper, real.load_cell
    contents = {
        "gripper.calibration": gripper.calibration if gripper is not None else None,
        "load_cell.calibration": load_cell.calibration if load_cell is not None else None,
    }
    hashes = {name: _sha256_of(value) for name, value in judged.items()}
    return hashes | {name: hashlib.sha256(_content(path)).hexdigest() for name, path in contents.items()}


def judged_by(stage: str, hashes: Mapping[str, str]) -> dict[str, str]:
    """Return the hashes of the keys and files that a stage judges."""
    return {name: own for name, own in hashes.items() if stage[0] in _JUDGED_BY[name]}


def _settings_of(config: DaemonConfig) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the robot's settings that all stages need, and those that only some judge, by their keys."""
    if config.real.robot is None:
        return {}, {}
    try:
        settings = asdict(read_settings(config.real.robot))
    except DriverError as error:
        raise UserError(str(error)) from error
    limits = settings["limits"]
    judged = {key: settings.pop(key) for key in ("reaction_s", "rest_rad_per_s")}
    return settings, judged | {f"limits.{key}": limits.pop(key) for key in ("force_n", "torque_nm")}


def _content(path: Path | None) -> bytes:
    try:
        return path.read_bytes() if path is not None else b""
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def _sha256_of(values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _installed(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
