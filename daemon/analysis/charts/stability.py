"""Estimators where methods fail: bias, spread, valid and false-valid share of each, as a fault grows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.errors import BankError
from shearloop.bank.estimation import (
    Calibration,
    Estimate,
    EstimatorSession,
    FrameSeries,
    Name,
    Physics,
    TactileFrame,
    fit,
)
from shearloop.bank.estimation.fingertip_validator import channel_noise
from shearloop.daemon.analysis.charts.faults import FAULTS, Fault, Scene, Spoilt, scene_of
from shearloop.daemon.analysis.charts.sources import Split
from shearloop.daemon.scene import residual_noise
from shearloop.daemon.workers import Executor, in_order

# Of valid estimates one in twenty may miss its 95 % interval; an estimator that is wrong so often says it is right
# when it is not: it breaks silently.
BROKEN_SHARE = 0.2
# Frames of a stream that are judged: enough for a twist and a half.
_MOST_FRAMES = 180
_DRAWS = 3
_LOADED_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Level:
    """Errors at one strength of a fault: bias and spread in N·m of valid estimates, None without any; shares of all.

    false_valid is the share of frames that are called valid although the truth is outside the 95 % interval.
    """

    level: float
    bias_nm: float | None
    spread_nm: float | None
    valid: float
    false_valid: float


@dataclass(frozen=True, slots=True)
class Curve:
    """One estimator through one sweep; breaks_at is the mildest level at which it is silently wrong too often."""

    fault: str
    unit: str
    estimator: str
    levels: tuple[Level, ...]
    breaks_at: float | None


def curve(fault: str, unit: str, estimator: str, levels: Iterable[Level]) -> Curve:
    """Return a sweep with its breaking point."""
    found = tuple(levels)
    broken = [one.level for one in found if one.false_valid > BROKEN_SHARE]
    # Levels go from mild to grave, or, where a fault has two directions, through 0.
    mildest = min(broken, key=abs, default=None) if any(one.level < 0 for one in found) else next(iter(broken), None)
    return Curve(fault, unit, estimator, found, mildest)


def judged(estimates: Sequence[Estimate], truth_nm: FloatArray, level: float) -> Level:
    """Return the figures of estimates against (n,) truths, of which only those that are known count."""
    known = np.isfinite(truth_nm)
    rows = [
        (one.torque_nm - truth, one.torque_low_nm <= truth <= one.torque_high_nm)
        for one, truth in zip(estimates, truth_nm, strict=True)
        if one.valid
        and np.isfinite(truth)
        and one.torque_nm is not None and one.torque_low_nm is not None and one.torque_high_nm is not None
    ]  # fmt: skip
    if not rows:
        return Level(level, None, None, 0.0, 0.0)
    error, inside = np.array(rows, dtype=np.float64).T
    n = int(known.sum())
    return Level(level, float(error.mean()), float(error.std()), len(rows) / n, float((inside == 0).sum()) / n)


def estimates_of(tracker: EstimatorSession, spoilt: Spoilt) -> list[Estimate]:
    """Return the estimates of spoilt frames, in order, as live, in a session of their own."""
    tracker.tare()
    found = []
    for i, (t_s, channels) in enumerate(zip(spoilt.series.t_s, spoilt.series.channels, strict=True)):
        usable = None if spoilt.usable is None else spoilt.usable[i]
        found.append(tracker.estimate(TactileFrame.of(float(t_s), channels, usable)))
    return found


def truth_of(series: FrameSeries) -> FloatArray:
    """Return the (n,) torques that a series is judged by, NaN where it is not."""
    torque = series.torque_at_frames()
    return balanced(torque) if series.kind == "raw" else torque


def balanced(truth_nm: FloatArray) -> FloatArray:
    """Return (n,) truths of which as many are loaded as free of load, the rest NaN: most of a stream is free of load.

    Zero is easily met; an estimator that always says so would look stable.
    """
    loaded = np.abs(truth_nm) > _LOADED_SHARE * np.nanmax(np.abs(truth_nm))
    free = np.flatnonzero(np.isfinite(truth_nm) & ~loaded)
    kept = free[np.linspace(0, len(free) - 1, min(len(free), int(loaded.sum()))).astype(int)] if len(free) else free
    return np.where(loaded | np.isin(np.arange(len(truth_nm)), kept), truth_nm, np.nan)


def sweep(tracker: EstimatorSession, scene: Scene, fault: Fault) -> Curve:
    """Return an estimator through one fault; where chance decides which electrodes, several times."""
    truth = truth_of(scene.series)
    levels = []
    for level in fault.levels:
        estimates: list[Estimate] = []
        draws = _DRAWS if level > fault.levels[0] and scene.series.kind == "difference" else 1
        for draw in range(draws):
            spoilt = fault.apply(scene, level, np.random.default_rng((5, draw)))
            estimates += estimates_of(tracker, spoilt)
        levels.append(judged(estimates, np.tile(truth, draws), level))
    return curve(fault.name, fault.unit, tracker.calibration.estimator, levels)


def fitted(split: Split, names: Sequence[Name], physics: Physics) -> list[Calibration]:
    """Return the estimators that the past determines; why one is missing is printed."""
    found = []
    for name in names:
        try:
            found.append(fit(name, [split.past], split.title, physics))
        except BankError as error:
            print(f"{split.title}: {name} is left out: {error}")
    return found


def misaligned(split: Split, names: Sequence[Name], physics: Physics, shifts_s: Sequence[float]) -> list[Curve]:
    """Return estimators whose calibration took each torque for one measured so much later, judged on the truth.

    A calibration that is refused gives no valid estimate.
    """
    levels: dict[str, list[Level]] = {name: [] for name in names}
    for shift in shifts_s:
        past = split.past
        late = replace(past, torque_t_s=past.torque_t_s + shift)
        calibrated = {one.estimator: one for one in fitted(replace(split, past=late), names, physics)}
        for name, found in levels.items():
            estimates: list[Estimate] = []
            if name in calibrated:
                estimates = estimates_of(
                    EstimatorSession(calibrated[name], physics.bank), Spoilt(shortened(split.future))
                )
            truth = truth_of(shortened(split.future)) if estimates else np.zeros(0)
            found.append(judged(estimates, truth, shift))
    return [curve("calibrated on misaligned times", "s", name, found) for name, found in levels.items()]


def shortened(series: FrameSeries) -> FrameSeries:
    """Return no more frames than are judged."""
    return series.between(0, min(len(series.t_s), _MOST_FRAMES))


def scene_for(split: Split, bank: Bank) -> Scene:
    """Return what the faults are applied to: the later frames, with idle frames and noise of the earlier ones.

    Slices have no idle frame: the bank's homogeneous voltages stand in, in volts as the board reads them on average.
    """
    series = shortened(split.future)
    if series.kind == "difference":
        idle = np.abs(bank.homogeneous) * (_MEAN_V / float(np.abs(bank.homogeneous).mean()))
        noise = residual_noise(split.past.channels[:, 0])
        return scene_of(series, np.tile(idle, (len(series.sides), 1)), noise)
    idle = np.median(split.past.channels[:5], axis=0)
    return scene_of(series, idle, float(np.median(channel_noise(split.past.channels[:, 0]))))


_MEAN_V = 0.13


def sweeps(split: Split, names: Sequence[Name], physics: Physics, bank: Bank, pool: Executor) -> list[Curve]:
    """Return all estimators through all faults on one split; each estimator is a task of its own."""
    tasks = fitted(split, names, physics)
    found = in_order(pool.map(swept, (scene_for(split, bank), str(bank.path.resolve())), tasks))
    return [one for curves in found for one in curves]


def swept(shared: tuple[Scene, str], calibration: Calibration) -> list[Curve]:
    """Return one estimator through all faults; a worker has to reach the bank's file."""
    scene, path = shared
    tracker = EstimatorSession(calibration, Bank.open(path))
    return [sweep(tracker, scene, fault) for fault in FAULTS]
