"""Identifies the rig of a commissioning's report: versions, the robot's serial number, and hashes of its settings.

Keys and files that only some stages judge have separate hashes. After a change only those stages are measured again.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any, Final

from shearloop.daemon.commissioning_report import RigIdentity
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.daemon.torques import LOAD_CELL, WRENCH
from shearloop.drivers.calibration_files import CalibrationModel, load_device_calibration
from shearloop.drivers.defaults import EMULATED_SERIAL_NUMBER
from shearloop.drivers.errors import DriverError
from shearloop.drivers.load_cell import LoadCalibration
from shearloop.drivers.robotiq.models import DEFAULT_MODEL
from shearloop.drivers.robotiq.widths import WidthCalibration
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
# What changes a torque of the fingertips, apart from their calibrations. A calibration names its bank.
_TORQUE_KEYS: Final[Any] = {
    "fingertips": {"__all__": {"estimator", "matching", "baseline_frames", "average_frames", "creep"}},
    "combined": {"estimator", "creep"},
}
# Keys and calibrations that only some stages judge, with the first figures of the stages.
_JUDGED_BY: Final = {
    "gripper.calibration": "2",
    "reaction_s": "3",
    "rest_rad_per_s": "34",
    "limits.force_n": "5",
    "limits.torque_nm": "5",
    "load_cell.calibration": "67",
    "load_cell.direction": "7",
}


def identity_of(
    config: DaemonConfig, polyscope: str, robot_serial_number: str, found: RigIdentity | None = None
) -> RigIdentity:
    """Return which rig this is, a rehearsal being the one that it plays, on emulated devices.

    A default that is written out changes nothing. A report of an earlier version has another hash of the same devices,
    and `found` is its identity: if that hash is of this configuration, the result has it. Raises UserError where a file
    that the configuration names cannot be read.
    """
    settings, _ = _settings_of(config)
    devices, *earlier = _device_sha256s(config.real)
    if found is not None and found.configuration_sha256 in earlier:
        devices = found.configuration_sha256
    return RigIdentity(
        emulated=config.emulated,
        configuration_sha256=devices,
        robot_settings_sha256=_sha256_of(settings),
        script_sha256=own_script_hash(),
        ur_rtde=_installed("ur-rtde"),
        polyscope=polyscope,
        robot_serial_number=EMULATED_SERIAL_NUMBER if config.emulated else robot_serial_number,
    )


def _device_sha256s(config: DaemonConfig) -> list[str]:
    """Return the hash of the devices' settings, and after it those of earlier versions."""
    effective = config.model_dump(mode="json", exclude_defaults=True, include=_DEVICE_KEYS)
    as_written = config.model_dump(mode="json", exclude_unset=True, include=_DEVICE_KEYS)
    found = [effective, as_written]
    if config.gripper is not None and config.gripper.model == DEFAULT_MODEL:
        # This model was the default, and its key was absent.
        for settings in (effective, as_written):
            gripper = {key: value for key, value in settings["gripper"].items() if key != "model"}
            found.append({**settings, "gripper": gripper})
    return [_sha256_of(settings) for settings in found]


def judged_sha256s(config: DaemonConfig) -> dict[str, str]:
    """Return the hash of each value and calibration that only some stages judge, by its key; raises UserError.

    Of a calibration the values count, not the text: comments and a default that is written out change nothing.
    """
    _, judged = _settings_of(config)
    for name, (path, model) in _calibrations(config).items():
        judged[name] = _values_of(path, model)
    load_cell = config.real.load_cell
    if load_cell is not None and load_cell.direction is not None:
        judged["load_cell.direction"] = load_cell.direction
    return {name: _sha256_of(value) for name, value in judged.items()}


def text_sha256s(config: DaemonConfig) -> dict[str, str]:
    """Return the hash of each calibration's text, which reports of earlier versions have; raises UserError."""
    return {name: _sha256_of_file(path) for name, (path, _) in _calibrations(config).items()}


def _calibrations(config: DaemonConfig) -> dict[str, tuple[Path | None, type[CalibrationModel]]]:
    """Return the file and the model of each calibration that some stages judge, by its key."""
    gripper, load_cell = config.real.gripper, config.real.load_cell
    return {
        "gripper.calibration": (gripper.calibration if gripper is not None else None, WidthCalibration),
        "load_cell.calibration": (load_cell.calibration if load_cell is not None else None, LoadCalibration),
    }


def _values_of(path: Path | None, model: type[CalibrationModel]) -> dict[str, Any] | None:
    """Return the values of a calibration that are no defaults, and None without a file; raises UserError."""
    if path is None:
        return None
    try:
        return load_device_calibration(path, model).model_dump(mode="json", exclude_defaults=True)
    except DriverError as error:
        raise UserError(str(error)) from error


def judged_by(number: str, hashes: Mapping[str, str]) -> dict[str, str]:
    """Return the hashes of the keys and files that the stage with this number judges."""
    return {name: own for name, own in hashes.items() if number in _JUDGED_BY[name]}


def source_sha256(config: DaemonConfig, source: str) -> str | None:
    """Return the hash of the settings and the calibration behind a source's torques, of a fingertip or of several.

    It is empty for the load cell and the wrench, whose settings belong to the stages of a commissioning, and None for a
    source that no stage compares with the load cell. Raises UserError where the calibration cannot be read.
    """
    if source in (LOAD_CELL, WRENCH):
        return ""
    real = config.real
    settings = real.model_dump(mode="json", include=_TORQUE_KEYS)
    estimated = {**real.fingertips, COMBINED: real.combined}.get(source)
    return _sha256_of([settings, _sha256_of_file(estimated.calibration)]) if estimated is not None else None


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


def _sha256_of_file(path: Path | None) -> str:
    """Return the hash of a file's content, and of nothing without a file; raises UserError."""
    try:
        return hashlib.sha256(path.read_bytes() if path is not None else b"").hexdigest()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def _sha256_of(values: object) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _installed(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
