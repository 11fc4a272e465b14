"""Describes each part of a configuration, or its mistake; opens every file that it names."""

import errno
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from shearloop.daemon.config_file import ConfigModel
from shearloop.daemon.errors import USER_ERRORS
from shearloop.errors import Hint, UserError
from shearloop.models import as_model
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.daemon.config import CurveConfig, DaemonConfig, EmulatorConfig, SkinConfig
    from shearloop.daemon.control.experiment_schema import ExperimentFile, Mistake
    from shearloop.daemon.control.plan import Plan
    from shearloop.daemon.loop_config import LoopConfig
    from shearloop.daemon.motion_cap import Commissioning
    from shearloop.daemon.torques import TorqueSource
    from shearloop.drivers.robotiq.models import GripperModel
    from shearloop.drivers.ur.settings import UrLimits
    from shearloop.estimation import Calibration
    from shearloop.yaml_files import Document

# Raises UserError for an emulator of a configuration that cannot be started; the emulators are no affair of this room.
CheckEmulators = Callable[[tuple["EmulatorConfig", ...], Path], object]


# Linux: Documentation/admin-guide/devices.txt.
_MEMORY_DEVICES = 1


# The part with what the robot's settings leave open and a gripper elsewhere, and the one with calibrations on emulated
# devices.
OPEN_KEYS, EMULATED_CALIBRATIONS = "robot's settings", "calibrations"
# What only a run with the real devices is refused for: a rehearsal runs.
OF_REAL_DEVICES = (OPEN_KEYS, EMULATED_CALIBRATIONS)


@dataclass(frozen=True, slots=True)
class Parts:
    """A sentence on each part of a configuration, or its mistakes, so that one hides no other."""

    texts: dict[str, str] = field(default_factory=dict)
    mistakes: dict[str, str] = field(default_factory=dict)
    # Of the experiment, if there is one that can be read; also of one that is refused.
    plans: "list[Plan]" = field(default_factory=list)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Keep the mistake that ends the context."""
        try:
            yield
        except USER_ERRORS as error:
            self.mistakes[name] = str(error)


class _NamedFile(ConfigModel):
    path: Path


def named_file(value: object, folder: Path) -> Path | None:
    """Return the file that a value of a configuration in `folder` names, None for a value that names none."""
    with suppress(ValidationError):
        return as_model({"path": value}, _NamedFile, folder).path
    return None


def check_parts(config: "DaemonConfig", path: Path, check_emulators: CheckEmulators) -> Parts:
    """Return what each part of the configuration in this file is; opens every file that it names."""
    from shearloop.daemon.sensing.sessions import (
        COMBINED,
        open_combined,
        open_session,
        refuse_emulated_calibrations,
        torque_sources,
    )
    from shearloop.daemon.torques import TorqueSource

    parts, sessions, combined = Parts(), {}, None
    with parts.of("emulators"):
        check_emulators(config.emulators, path)
    if config.curve is not None:
        with parts.of("keys"):
            parts.texts["keys"] = _clients(config.curve)
    with parts.of(EMULATED_CALIBRATIONS):
        refuse_emulated_calibrations(config)
    for name, fingertip in config.fingertips.items():
        with parts.of(name):
            session = sessions[name] = open_session(fingertip, name)
            bank, search = "no bank", session.search
            if search is not None:
                bank = f"bank {fingertip.bank} of {search.k_grid.size} × {search.sigma_grid.size} cells"
            parts.texts[name] = f"{bank}, {_torque(session.calibration)}"
    if config.combined is not None:
        with parts.of(COMBINED):
            combined = open_combined(config.combined, config.fingertips)
            sides = " and ".join(combined.calibration.sides)
            parts.texts[COMBINED] = f"{sides} together, {_torque(combined.calibration)}"
    if config.skin is not None:
        with parts.of("skin"):
            parts.texts["skin"] = _skin(config.skin)
    robot = _check_rig(config, parts)
    _check_paths(config, parts)
    # A device that cannot be opened yet counts as configured.
    files = {name: fingertip.calibration for name, fingertip in config.fingertips.items()}
    files |= {COMBINED: config.combined.calibration} if config.combined is not None else {}
    unopened = {
        name: TorqueSource(name=name, period_s=1.0, measures_torque=bool(file), has_gain=bool(file))
        for name, file in files.items()
    }
    sources = unopened | torque_sources(config, sessions, combined)
    with parts.of("experiment"):
        _check_experiment(config, parts, sources, robot)
    return parts


def _check_experiment(
    config: "DaemonConfig", parts: Parts, sources: Mapping[str, "TorqueSource"], robot: "Commissioning | None"
) -> None:
    """Add the plan of the configured experiment, its mistakes, and what drives it."""
    from shearloop.daemon.control.experiment_check import experiment_mistakes
    from shearloop.daemon.control.sensor_reach import tool_note
    from shearloop.daemon.experiment_files import check_experiment, read_document
    from shearloop.daemon.torques import WRENCH

    warm_up_s = max((source.warm_up_s for source in sources.values() if source.measures_torque), default=0.0)
    if config.experiment is not None:
        document = read_document(config.experiment)
        mistakes = experiment_mistakes(document.content, config, sources, robot)
        limits = robot.settings.limits if robot is not None else None
        _add_plan(parts, document, mistakes, limits, config.gripper_model, warm_up_s, config.loop)
    experiment = check_experiment(config, sources, robot)
    if experiment is not None:
        text = f"{experiment.name!r}, {counted(len(experiment.steps), 'step')}, driven by {experiment.torque_source}"
        if warm_up_s:
            text += f"; after a grip it waits up to {warm_up_s:.0f} s for the first torques"
        if robot is not None and experiment.torque_source != WRENCH:
            noise_nm = robot.settings.facts.mean_noise_nm
            if noise_nm:
                text += f"; the wrench supervises it to {noise_nm:g} N·m beyond its limits only"
        if note := tool_note(experiment, config, sources, robot):
            text += f"; {note}"
        parts.texts["experiment"] = text


def read_experiment(path: Path) -> "ExperimentFile":
    """Return the experiment of a file; raises UserError for an invalid one, or one beyond its limits."""
    from shearloop.daemon.control.experiment_check import check_steps
    from shearloop.daemon.control.experiment_schema import outline
    from shearloop.daemon.experiment_files import read_document, without_mistakes

    document = read_document(path)
    return without_mistakes(document, check_steps(outline(document.content)))


def check_experiment_alone(path: Path) -> Parts:
    """Return the plan of an experiment, or its mistakes, without a configuration."""
    from shearloop.daemon.control.experiment_check import check_steps
    from shearloop.daemon.control.experiment_schema import outline
    from shearloop.daemon.experiment_files import read_document, without_mistakes

    parts = Parts()
    with parts.of("experiment"):
        document = read_document(path)
        mistakes = check_steps(outline(document.content))
        _add_plan(parts, document, mistakes)
        without_mistakes(document, mistakes)
    return parts


def _add_plan(
    parts: Parts,
    document: "Document",
    mistakes: "Sequence[Mistake]",
    robot: "UrLimits | None" = None,
    gripper: "GripperModel | None" = None,
    warm_up_s: float = 0.0,
    loop: "LoopConfig | None" = None,
) -> None:
    """Add the plan of an experiment with valid keys and values."""
    from shearloop.daemon.control.experiment_schema import ExperimentFile
    from shearloop.daemon.control.plan import plan_of

    refused: dict[int, tuple[str, ...]] = {}
    for (section, *place), why in mistakes:
        if section == "steps" and place and isinstance(place[0], int):
            refused[place[0]] = (*refused.get(place[0], ()), why)
    # A file that cannot be read is named with its mistakes.
    with suppress(UserError):
        parts.plans.append(plan_of(document.model(ExperimentFile), robot, gripper, refused, warm_up_s, loop=loop))


def _torque(calibration: "Calibration") -> str:
    if not calibration.measures_torque:
        return "without torque: no calibration is configured"
    assumed = calibration.assumption_text
    return f"with torque, assuming that {assumed}" if assumed else "with torque"


def _check_rig(config: "DaemonConfig", parts: Parts) -> "Commissioning | None":
    """Check load cell, gripper and robot; return the robot's settings with their cap, if there are any."""
    from shearloop.daemon.report_in_use import commissioning_of
    from shearloop.daemon.rig import configured_settings, gripper_calibration, why_not_driven
    from shearloop.daemon.sensors import load_cell_calibration

    if (cell := config.load_cell) is not None:
        with parts.of("load_cell"):
            load_cell_calibration(cell)
            own = f"calibration {cell.calibration}" if cell.calibration else "torques in N·m from the board"
            parts.texts["load_cell"] = own
    if (gripper := config.gripper) is not None:
        with parts.of("gripper"):
            gripper_calibration(gripper)
            widths = "widths by the manufacturer's figures"
            if gripper.calibration is not None:
                widths = f"calibration {gripper.calibration}"
            parts.texts["gripper"] = f"{gripper.model}, {widths}"
    with parts.of("robot"):
        if (settings := configured_settings(config)) is not None:
            if lines := why_not_driven(config, settings):
                parts.mistakes[OPEN_KEYS] = "\n".join(lines)
            parts.texts["robot"] = f"{settings.host}, limits of {config.robot}"
            with parts.of("commissioned"):
                commissioning = commissioning_of(config, settings)
                if sentence := commissioning.sentence:
                    parts.texts["commissioned"] = sentence
                return commissioning
    return None


def _check_paths(config: "DaemonConfig", parts: Parts) -> None:
    """Check that no port is a file, that recordings can be written, and that the folders of experiments exist.

    A missing port is accepted: its device may come later.
    """
    from shearloop.daemon.config import SerialDevice

    for key, section in config.walk():
        if isinstance(section, SerialDevice) and section.path is not None and (kind := _no_port(section.path)):
            parts.mistakes[key] = f"`{key}.path: {section.path}` is {kind}; name a serial port: `shearloop ports`"
    if (recording := config.recording) is not None and (reason := why_not_recorded(recording.folder)):
        parts.mistakes["recording"] = f"`recording.folder: {recording.folder}`: {reason.clause}"
    if wrong := [f"`experiments`: {folder} {why}" for folder in config.experiments if (why := _no_folder(folder))]:
        parts.mistakes["experiments"] = "\n".join(wrong)


def why_not_recorded(folder: Path) -> Hint | None:
    """Return why this user cannot record in a folder that exists or is still to be made, with the cure, or None."""
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
        if existing.is_symlink() and not existing.exists():
            return Hint(f"{existing} is a link to {existing.readlink()}, which does not exist", "choose another folder")
        if not existing.is_dir():
            return Hint(f"{existing} is a file", "name a folder")
        file_system = os.statvfs(existing)
    except OSError as error:
        return Hint(f"{error.filename}: {error.strerror}", "choose another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        read_only = file_system.f_flag & os.ST_RDONLY
        why = os.strerror(errno.EROFS if read_only else errno.EACCES)
        return Hint(f"you may not write in {existing} ({why})", "choose another folder, or make this one writable")
    if not file_system.f_blocks:
        return Hint(f"{existing} keeps no files", "choose another folder")
    if not file_system.f_bavail:
        return Hint(f"the disk of {existing} is full", "free some space, or choose another folder")
    return None


def _no_folder(folder: Path) -> str:
    """Return why no experiment can be in a folder, with the cure, or an empty string."""
    if folder.is_dir():
        return ""
    if folder.exists():
        return "is a file: name its folder"
    with suppress(OSError):
        names = [one.name for one in folder.parent.iterdir() if one.is_dir()]
        if near := get_close_matches(folder.name, names, 1):
            return f"does not exist; did you mean {folder.parent / near[0]}?"
    return "does not exist: make this folder, or name another"


def _no_port(path: Path) -> str:
    """Return what a path is instead of a serial port, or an empty string, also where nothing exists."""
    try:
        status = path.stat()
    except OSError:
        return ""
    if not stat.S_ISCHR(status.st_mode):
        return "a folder" if stat.S_ISDIR(status.st_mode) else "a file"
    # Character devices without a terminal: /dev/null, /dev/zero and their kind.
    return "no serial port" if os.major(status.st_rdev) == _MEMORY_DEVICES else ""


def _clients(curve: "CurveConfig") -> str:
    from shearloop.daemon.messaging.keys import check_allowed_clients, load_server_keys

    load_server_keys(curve.server_key)
    clients = check_allowed_clients(curve.clients)
    return "; ".join([f"{', '.join(sorted(clients.names.values()))} may connect", *clients.unusable])


def _skin(config: "SkinConfig") -> str:
    from shearloop.daemon.sensing.skin_estimator import are_exchanged
    from shearloop.daemon.sensing.skin_task import check_circuit, friction_band_n
    from shearloop.estimation.skin.calibration import load_calibration

    calibration = load_calibration(config.calibration)
    check_circuit(config, calibration)
    radius = "without torque: no tool_radius_mm" if config.tool_radius_mm is None else "with torque"
    text = (
        f"calibration {config.calibration} to {calibration.tension_n[0]:+.1f} … {calibration.tension_n[-1]:+.1f} N, "
        f"± {calibration.prediction_half_width_n:.3f} N and {friction_band_n(config, calibration):.2f} N of friction, "
        f"{radius}"
    )
    if side := calibration.missing_side:
        text += f"; it has no {side} shear forces, and measures none"
    first_ohm, second_ohm = calibration.rest_ohm
    if not are_exchanged(calibration.rest_ohm, second_ohm, first_ohm):
        text += "; its gauges are too similar at rest to detect swapped wires: check the sign of a push"
    return text
