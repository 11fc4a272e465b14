"""What each part of a configuration is, or what is wrong with it; every file that it names is opened."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.errors import USER_ERRORS
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.daemon.config import CurveConfig, DaemonConfig, EmulatorConfig, SkinConfig
    from shearloop.daemon.sensing.frame_estimator import FrameEstimator

# Raises UserError for an emulator of a configuration that cannot be started; the emulators are no affair of this room.
CheckEmulators = Callable[[tuple["EmulatorConfig", ...], Path], object]


@dataclass(frozen=True, slots=True)
class Parts:
    """A sentence on each part of a configuration, or its mistakes, so that one hides no other."""

    texts: dict[str, str] = field(default_factory=dict)
    mistakes: dict[str, str] = field(default_factory=dict)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Keep the mistake that ends the context."""
        try:
            yield
        except USER_ERRORS as error:
            self.mistakes[name] = str(error)


def check_parts(config: "DaemonConfig", path: Path, check_emulators: CheckEmulators) -> Parts:
    """Return what each part of the configuration in this file is; opens every file that it names."""
    from shearloop.daemon.control.loop_inputs import TorqueSource
    from shearloop.daemon.rig import check_experiment
    from shearloop.daemon.sensing.frame_estimator import COMBINED, open_combined, open_estimator, torque_sources

    parts, estimators, combined = Parts(), {}, None
    with parts.of("emulators"):
        check_emulators(config.emulators, path)
    if config.curve is not None:
        with parts.of("keys"):
            parts.texts["keys"] = f"{_clients(config.curve)} may connect"
    for name, fingertip in config.fingertips.items():
        with parts.of(name):
            estimator = estimators[name] = open_estimator(fingertip, name)
            grids, torque = estimator.grids, _torque(estimator)
            bank = "no bank" if grids is None else f"bank {fingertip.bank} of {grids[0].size} × {grids[1].size} cells"
            parts.texts[name] = f"{bank}, {torque}"
    if config.combined is not None:
        with parts.of(COMBINED):
            combined = open_combined(config.combined, config.fingertips)
            sides = " and ".join(combined.calibration.sides)
            parts.texts[COMBINED] = f"{sides} together, {_torque(combined)}"
    if config.skin is not None:
        with parts.of("skin"):
            parts.texts["skin"] = _skin(config.skin)
    _check_rig(config, parts)
    # What cannot be opened yet counts as what it is configured to be.
    files = {name: fingertip.calibration for name, fingertip in config.fingertips.items()}
    files |= {COMBINED: config.combined.calibration} if config.combined is not None else {}
    unopened = {
        name: TorqueSource(name=name, period_s=1.0, measures_torque=bool(file), has_gain=bool(file))
        for name, file in files.items()
    }
    sources = unopened | torque_sources(config, estimators, combined)
    with parts.of("experiment"):
        experiment = check_experiment(config, sources)
        if experiment is not None:
            text = (
                f"{experiment.name!r}, {counted(len(experiment.steps), 'step')}, driven by {experiment.torque_source}"
            )
            if warm_up_s := max((one.warm_up_s for one in sources.values() if one.measures_torque), default=0.0):
                text += f"; after a grip it waits up to {warm_up_s:.0f} s for the first torques"
            parts.texts["experiment"] = text
    return parts


def _torque(estimator: "FrameEstimator") -> str:
    if not estimator.measures_torque:
        return "without torque: no calibration is configured"
    assumed = estimator.calibration.assumption_text
    return f"with torque, assuming that {assumed}" if assumed else "with torque"


def _check_rig(config: "DaemonConfig", parts: Parts) -> None:
    from shearloop.daemon.rig import gripper_calibration, load_cell_calibration, open_settings

    if (cell := config.load_cell) is not None:
        with parts.of("load_cell"):
            load_cell_calibration(cell)
            own = f"calibration {cell.calibration}" if cell.calibration else "torques in N·m from the board"
            parts.texts["load_cell"] = own
    if (hand := config.gripper) is not None:
        with parts.of("gripper"):
            gripper_calibration(hand)
            own = f"calibration {hand.calibration}" if hand.calibration else "widths by the manufacturer's figures"
            parts.texts["gripper"] = own
    with parts.of("robot"):
        if (settings := open_settings(config)) is not None:
            text = f"{settings.host}, limits of {config.robot}"
            parts.texts["robot"] = f"{text}. {settings.warning}" if settings.warning else text


def _clients(curve: "CurveConfig") -> str:
    from shearloop.daemon.messaging.keys import check_allowed_clients, load_server_keys

    load_server_keys(curve.server_key)
    return ", ".join(sorted(check_allowed_clients(curve.clients).values()))


def _skin(config: "SkinConfig") -> str:
    from shearloop.daemon.sensing.skin_estimator import MAX_CHANGE
    from shearloop.daemon.sensing.skin_task import check_circuit
    from shearloop.estimation.skin.calibration import load_calibration

    calibration = load_calibration(config.calibration)
    check_circuit(config, calibration)
    radius = "without torque: no tool_radius_mm" if config.tool_radius_mm is None else "with torque"
    text = (
        f"calibration {config.calibration} to {calibration.tension_n[0]:+.1f} … {calibration.tension_n[-1]:+.1f} N, "
        f"± {calibration.prediction_half_width_n:.3f} N, {radius}"
    )
    if abs(math.log(calibration.rest_ohm[0] / calibration.rest_ohm[1])) < MAX_CHANGE:
        text += "; its gauges are too similar at rest to detect swapped wires: check the sign of a push"
    return text
