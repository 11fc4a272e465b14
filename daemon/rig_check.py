"""Whether the files of a rig are in order and its experiment can be carried out with what is configured."""

from collections.abc import Mapping
from pathlib import Path

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment_schema import (
    ExperimentFile,
    GripStep,
    HoldTorqueStep,
    IdentifyStep,
    ReleaseStep,
    TareStep,
    check_limits,
)
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.control.runner import WRENCH
from shearloop.daemon.errors import UserError
from shearloop.daemon.sensing.estimators import COMBINED
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL
from shearloop.daemon.sensing.skin_task import SKIN


def read_experiment(path: Path) -> ExperimentFile:
    """Return the experiment in a file; UserError where it is none, or asks for more than its own limits."""
    file = load_yaml_model(path, ExperimentFile)
    if why := check_limits(file):
        raise UserError(f"{path}: {why}")
    return file


def checked_experiment(config: DaemonConfig, sources: Mapping[str, TorqueSource]) -> ExperimentFile | None:
    """Return the configured experiment, None where there is none; UserError where it can never be carried out.

    `sources` are the torques of fingertips and skin.
    """
    path = config.experiment
    if path is None:
        return None
    file = read_experiment(path)
    measured = [name for name, source in sources.items() if source.measures_torque]
    driving = [*measured, *([LOAD_CELL] if config.load_cell is not None else []), WRENCH]
    if file.drive not in driving:
        raise UserError(f"{path}: `drive: {file.drive}` {_why_not(file.drive, config)}; there are {', '.join(driving)}")
    if config.gripper is None:
        for number, step in enumerate(file.steps, 1):
            if isinstance(step, GripStep | ReleaseStep):
                raise UserError(
                    f"{path}: step {number} is `{step.do}`, and no gripper is configured; "
                    "add a `gripper` section to the configuration, or take the step out"
                )
    if (unknown := _held_unknown(file)) is not None:
        raise UserError(
            f"{path}: step {unknown} is `hold_torque`, and the tool is not known then; put an `identify` step before "
            "it, after the last `tare`, `grip` or `release`"
        )
    return file


def _held_unknown(file: ExperimentFile) -> int | None:
    """Return the number of the first step that closes the loop on a tool of which nothing was learnt, or None.

    What was learnt is forgotten with another grip and another zero (`Wrist.forget`).
    """
    known = False
    for number, step in enumerate(file.steps, 1):
        match step:
            case IdentifyStep():
                known = True
            case TareStep() | GripStep() | ReleaseStep():
                known = False
            case HoldTorqueStep() if not known:
                return number
    return None


def _why_not(drive: str, config: DaemonConfig) -> str:
    if drive in config.fingertips and config.fingertips[drive].calibration is None:
        return "is a fingertip without a calibration, which has no torque: add `calibration`, or take another"
    if drive in config.fingertips or (drive == COMBINED and config.combined is not None):
        return (
            "has a calibration of diameters alone: calibrate on a recording of one tool with the load cell beside, or "
            "take another"
        )
    if drive == SKIN and config.skin is not None:
        return "has no torque without a radius: add `skin.tool_radius_mm`, or take another"
    return "is not a measured torque: choose another, or configure its device"
