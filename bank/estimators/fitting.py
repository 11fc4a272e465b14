"""Fitting an estimator to recordings: one function, five estimators, each on raw frames or on slices.

Everything that is chosen is chosen on data later than what it was fitted to; nothing looks at the recordings that the
calibration will be judged on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bank.bank_file import Bank
from bank.channels import N_CHANNELS
from bank.errors import CalibrationError
from bank.estimators.calibrated import NEEDS_BANK, Calibration, Name, Task, columns_for, features_of, locator_for
from bank.estimators.guard import DifferenceGuard, SideGuard
from bank.estimators.heads import Censored, Curve, Ridge
from bank.estimators.memory import Memory, Motion, gripped_part
from bank.estimators.physics import NOT_TURNED, Locator, Registration, image_matrix, register
from bank.estimators.reader import STRENGTHS, Head, Reader, fit_reader, one_sided
from bank.estimators.values import FloatArray, FrameSeries, TactileFrame
from bank.mesh import Mesh

# Directions of motion per fingertip, and frames back: 13 frames are 7 s, about twice the gel's creep.
N_DIRECTIONS, N_LAGS = 4, 12
# Degree of the curve of frames over torque and over diameter, and directions of drift about it.
TORQUE_CURVE, DIAMETER_CURVE = (2, 2), (1, 1)
# A hundred features of a few directions need little holding back.
_MOTION_STRENGTHS = (1e-6, 1e-5, 1e-4)
# A full heatmap over all lags takes a good part of a second: more frames than this are thinned out to calibrate on.
_LARGEST_MATCHED = 120


@dataclass(frozen=True, slots=True)
class Physics:
    """What was known beforehand: the bank, and the mesh that an image is reconstructed on."""

    bank: Bank | None = None
    mesh: Mesh | None = None


def fit(name: Name, recordings: Sequence[FrameSeries], source: str, physics: Physics | None = None) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` says in words what they are.

    Slices with torque give a torque, those with diameters a diameter. Raises CalibrationError for recordings that do
    not determine the calibration, and for physics that the estimator needs and did not get.
    """
    physics = physics or Physics()
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    kinds = {one.kind for one in recordings}
    if len(kinds) > 1:
        raise CalibrationError("raw frames and slices of differences do not go into one calibration; make two")
    sides = tuple(side for side in recordings[0].sides if all(side in one.sides for one in recordings))
    if not sides:
        raise CalibrationError("the recordings have no side in common; name the side of each when importing")
    if name in NEEDS_BANK and physics.bank is None:
        raise CalibrationError(f"the estimator {name} needs a bank; name it with --bank")
    if name == "reconstruction" and physics.mesh is None:
        raise CalibrationError("the estimator reconstruction needs a mesh; name it with --mesh")
    blank = Calibration(
        estimator=name,
        kind=recordings[0].kind,
        sides=sides,
        source=source,
        bank_identity=physics.bank.identity if physics.bank is not None and name in NEEDS_BANK else "",
        registration=NOT_TURNED,
        scale=np.ones((len(sides), N_CHANNELS)),
        guards=(),
        motion=None,
        image=image_matrix(physics.mesh) if name == "reconstruction" and physics.mesh is not None else None,
        torque=None,
        diameter=None,
    )
    chosen = [one.of_sides(sides) for one in recordings]
    return _fit_raw(blank, chosen, physics) if blank.kind == "raw" else _fit_slices(blank, chosen, physics)


def _fit_slices(blank: Calibration, recordings: list[FrameSeries], physics: Physics) -> Calibration:
    frames = np.concatenate([one.channels for one in recordings])
    torque = np.concatenate([one.torque_at_frames() for one in recordings])
    diameter = np.concatenate([one.diameter_mm for one in recordings])
    registered = _locator(blank, physics)
    tasks = {}
    for name, values in (("torque", torque), ("diameter", diameter)):
        # Cylinders were twisted too, at one torque each: that does not determine a torque.
        known = np.isfinite(values) & (np.isfinite(diameter) if name == "diameter" else ~np.isfinite(diameter))
        if not known.any():
            continue
        differences = np.abs(frames[known])
        features = np.array([features_of(blank, registered, one, None).features for one in differences])
        columns = columns_for(blank.estimator, name, features)
        curve = TORQUE_CURVE if name == "torque" else DIAMETER_CURVE
        reader = fit_reader(
            columns,
            values[known],
            _curve(curve) if blank.estimator == "fused" else _ridge(blank.estimator),
            strengths=_strengths(blank.estimator),
        )
        tasks[name] = Task(reader, DifferenceGuard.fit(differences[:, 0]))
    if not tasks:
        raise CalibrationError("the slices come with neither torque nor diameter")
    return replace(blank, torque=tasks.get("torque"), diameter=tasks.get("diameter"))


def _ridge(name: Name) -> Callable[[FloatArray, FloatArray, float], Head]:
    return Ridge.fit_scaled if name in NEEDS_BANK else Ridge.fit


def _strengths(name: Name) -> tuple[float, ...]:
    """Return the strengths to choose from: none for the paper's polynomials, nor for curves."""
    return {"paper": (1e-9,), "fused": (0.0,)}.get(name, STRENGTHS)


def _curve(shape: tuple[int, int]) -> Callable[[FloatArray, FloatArray, float], Head]:
    return lambda features, values, _: Curve.fit(features, values, *shape)


def _fit_raw(blank: Calibration, recordings: list[FrameSeries], physics: Physics) -> Calibration:
    parts = [gripped_part(one) for one in recordings]
    guards = tuple(
        SideGuard.fit(
            side,
            *(np.concatenate([one.channels[part[i], layer] for one, part in zip(recordings, parts, strict=True)])
              for i in range(3)),
        )
        for layer, side in enumerate(blank.sides)
    )  # fmt: skip
    calibration = replace(blank, guards=guards, scale=_finite(np.array([guard.noise for guard in guards])))
    if blank.estimator == "fused":
        gripped = [one.channels[part[1]] for one, part in zip(recordings, parts, strict=True)]
        calibration = replace(calibration, motion=Motion.fit(gripped, guards, N_DIRECTIONS, N_LAGS))
    if blank.estimator == "bank" and physics.bank is not None:
        calibration = replace(calibration, registration=register(guards[0].idle, physics.bank.homogeneous))
    locator = _locator(calibration, physics)
    every = _thinning(calibration, recordings)
    features, torque = [], []
    for one in recordings:
        rows, values = _replayed(calibration, locator, one, every)
        features += rows
        torque += values
    if not features:
        raise CalibrationError("no frame of the recordings is gripped and undisturbed for long enough to calibrate on")
    reader = _torque_reader(calibration, np.array(features), np.array(torque))
    return replace(calibration, torque=Task(reader, None))


def _torque_reader(calibration: Calibration, features: FloatArray, torque: FloatArray) -> Reader:
    motion = calibration.motion is not None
    head = Censored.fit if motion and one_sided(torque) else _ridge(calibration.estimator)
    return fit_reader(
        columns_for(calibration.estimator, "torque", features),
        torque,
        head,
        strengths=_MOTION_STRENGTHS if motion else _strengths(calibration.estimator),
        # Places in the bank are within its grid; all else would follow a drift to wherever it leads.
        limit_reach=calibration.estimator not in NEEDS_BANK,
    )


def _replayed(
    calibration: Calibration, locator: Locator | None, series: FrameSeries, every: int
) -> tuple[list[FloatArray], list[float]]:
    """Return features and torques of the frames that an estimate would be made of, by the way that makes it."""
    memory = Memory(calibration.guards, calibration.motion)
    rows, values = [], []
    for i, (t_s, channels, torque) in enumerate(
        zip(series.t_s, series.channels, series.torque_at_frames(), strict=True)
    ):
        moment = memory.see(TactileFrame.of(float(t_s), channels))
        if not moment.why and np.isfinite(torque) and i % every == 0:
            rows.append(features_of(calibration, locator, moment.difference, memory.recent).features)
            values.append(float(torque))
    return rows, values


def _thinning(calibration: Calibration, recordings: list[FrameSeries]) -> int:
    if calibration.estimator != "paper":
        return 1
    return max(1, sum(len(one.t_s) for one in recordings) // _LARGEST_MATCHED)


def _locator(calibration: Calibration, physics: Physics) -> Locator | None:
    if calibration.estimator not in NEEDS_BANK or physics.bank is None:
        return None
    return locator_for(calibration.estimator, physics.bank, calibration.registration)


def _finite(noise: FloatArray) -> FloatArray:
    """Return the noise with that of dead channels so large that they say nothing."""
    return np.where(np.isfinite(noise), noise, 1e9)


__all__ = ["N_DIRECTIONS", "N_LAGS", "Physics", "Registration", "fit"]
