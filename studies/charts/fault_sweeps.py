"""Sweeps: how each estimator behaves as a fault grows from mild to grave, and their figure."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.eit_kit import ADC_STEP_V
from shearloop.emulators.synthetic_frames import MEAN_V
from shearloop.estimation import Calibration, Estimate, FrameSeries, Physics, Session, TactileFrame
from shearloop.estimation.bank_match import ElectrodeNumbering
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.twists import LOADED_FRACTION
from shearloop.estimation.validator_fit import channel_noise
from shearloop.studies.charts.chart_data import Split, fitted
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.reader import SliceReader
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.bank_design import residual_noise
from shearloop.tools.drawing import figure, look
from shearloop.tools.estimate_tracks import values_of
from shearloop.tools.parallel import Executor


@dataclass(frozen=True, slots=True, eq=False)
class FaultScene:
    """Frames of a recording, the idle fingertips' voltages `idle` (m, 896), and another fingertip's frame `foreign`."""

    series: FrameSeries
    idle: FloatArray
    noise_v: float
    foreign: FloatArray


@dataclass(frozen=True, slots=True)
class FrameFault:
    """One sweep: `change(scene, level, rng)` returns the series' changed channels; the first level is no fault.

    Of a `reported` fault the board marks the channels that it changes.
    """

    name: str
    unit: str
    levels: tuple[float, ...]
    change: Callable[[FaultScene, float, np.random.Generator], FloatArray]
    reported: bool = False

    def apply(self, scene: FaultScene, level: float, rng: np.random.Generator) -> tuple[FrameSeries, BoolArray | None]:
        """Return the faulty frames, and which channels (n, m, 896) a board that reports them calls usable.

        Differences are magnitudes.
        """
        series, channels = scene.series, self.change(scene, level, rng)
        usable = channels == series.channels if self.reported else None
        magnitudes = np.abs(channels) if isinstance(series, SliceSeries) else channels
        return replace(series, channels=magnitudes), usable


def _noise(scene: FaultScene, level: float, rng: np.random.Generator) -> FloatArray:
    channels = scene.series.channels
    return channels + rng.normal(0.0, 1.0, channels.shape) * level * scene.noise_v


def lost_channels(electrodes: IntArray) -> BoolArray:
    """Return the (896,) channels that inject or measure at one of these electrodes."""
    return np.asarray(np.isin(PAPER_TABLE.electrodes, electrodes).any(axis=1))


def _lost(scene: FaultScene, level: float, rng: np.random.Generator) -> FloatArray:
    """Let electrodes read one ADC step."""
    lost = lost_channels(rng.choice(PAPER_TABLE.n_electrodes, int(level), replace=False))
    channels = scene.series.channels.copy()
    channels[:, :, lost] = ADC_STEP_V - scene.idle[:, lost] if isinstance(scene.series, SliceSeries) else ADC_STEP_V
    return channels


def _saturated(scene: FaultScene, level: float, _: np.random.Generator) -> FloatArray:
    """Clip the amplifier's readings so that this fraction of the idle frame's channels is at its rail."""
    channels = scene.series.channels
    if not level:
        return channels
    rail = np.quantile(scene.idle, 1.0 - level)
    if not isinstance(scene.series, SliceSeries):
        return np.minimum(channels, rail)
    # Differences have lost their sign: let half of the channels rise.
    signs = np.where(np.arange(PAPER_TABLE.n_channels) % 2, -1.0, 1.0)
    return np.minimum(scene.idle + signs * channels, rail) - np.minimum(scene.idle, rail)


def _drift(scene: FaultScene, level: float, rng: np.random.Generator) -> FloatArray:
    """Move the baseline over the recording by a random pattern of RMS `level` of the idle frame."""
    channels = scene.series.channels
    pattern = rng.normal(0.0, 1.0, channels.shape[1:]) * scene.idle * level
    if not isinstance(scene.series, SliceSeries):
        pattern = np.linspace(0.5, 1.0, len(channels))[:, None, None] * pattern
    return channels + pattern


def _gain(scene: FaultScene, level: float, _: np.random.Generator) -> FloatArray:
    """Raise all channels by this fraction, as when the gel dries or the current source drifts."""
    channels = scene.series.channels
    return channels + level * (scene.idle if isinstance(scene.series, SliceSeries) else channels)


def _turned(scene: FaultScene, level: float, _: np.random.Generator) -> FloatArray:
    order = ElectrodeNumbering(int(level), reflected=False).model_channels(PAPER_TABLE)
    return scene.series.channels[:, :, order]


def _swapped(scene: FaultScene, level: float, rng: np.random.Generator) -> FloatArray:
    """Exchange the wires of pairs of electrodes; a channel that no longer exists keeps its value."""
    wires = np.arange(PAPER_TABLE.n_electrodes)
    chosen = rng.choice(PAPER_TABLE.n_electrodes, 2 * int(level), replace=False)
    wires[chosen[::2]], wires[chosen[1::2]] = chosen[1::2], chosen[::2]
    # The electrodes of the sink and of the positive input name a channel.
    pairs = PAPER_TABLE.electrodes[:, [0, 2]]
    place = {(sink, positive): i for i, (sink, positive) in enumerate(pairs.tolist())}
    order = [place.get((sink, positive), i) for i, (sink, positive) in enumerate(wires[pairs].tolist())]
    return scene.series.channels[:, :, order]


def _foreign(scene: FaultScene, level: float, _: np.random.Generator) -> FloatArray:
    return (1.0 - level) * scene.series.channels + level * scene.foreign


_ELECTRODES = (0, 1, 2, 4, 6, 8, 12, 16)
FAULTS = (
    FrameFault("noise added", "times the measured noise", (0, 0.5, 1, 2, 4, 8, 16, 32), _noise),
    FrameFault("lost electrodes, reported by the board", "electrodes", _ELECTRODES, _lost, reported=True),
    FrameFault("lost electrodes, unreported", "electrodes", _ELECTRODES, _lost),
    FrameFault(
        "saturation, unreported", "share of the channels at the rail", (0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7), _saturated
    ),
    FrameFault(
        "baseline drift, a pattern", "RMS share of the idle frame", (0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1), _drift
    ),
    FrameFault("baseline drift, gain", "share", (0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2), _gain),
    FrameFault("electrodes numbered from elsewhere", "electrodes of turn", (0, 1, 2, 4, 8, 16), _turned),
    FrameFault("pairs of electrodes exchanged", "pairs", (0, 1, 2, 4, 8, 16), _swapped),
    FrameFault("a foreign frame mixed in", "share of the foreign frame", (0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0), _foreign),
)


# An estimator breaks silently where more frames than this are false-valid; one in twenty is the promise.
BROKEN_FRACTION = 0.2
# Judged frames of a stream: enough for a twist and a half.
_MAX_FRAMES = 180
_DRAWS = 3


@dataclass(frozen=True, slots=True)
class FaultLevel:
    """Errors at one level of a fault: bias and spread of valid estimates in N·m, and fractions of all frames.

    `false_valid` is the fraction of frames called valid although the truth is outside the 95 % interval. Without more,
    no estimate is valid.
    """

    level: float
    bias_nm: float | None = None
    spread_nm: float | None = None
    valid: float = 0.0
    false_valid: float = 0.0


@dataclass(frozen=True, slots=True)
class FaultCurve:
    """One estimator through one sweep; it breaks silently from the level `breaks_at` on."""

    fault: str
    unit: str
    estimator: str
    levels: tuple[FaultLevel, ...]
    breaks_at: float | None


def fault_curve(fault: str, unit: str, estimator: str, levels: Iterable[FaultLevel]) -> FaultCurve:
    """Return a curve with its breaking point."""
    found = tuple(levels)
    broken = [level.level for level in found if level.false_valid > BROKEN_FRACTION]
    # Levels go from mild to grave, or through 0 for a fault with two directions.
    if any(level.level < 0 for level in found):
        broken.sort(key=abs)
    mildest = broken[0] if broken else None
    return FaultCurve(fault, unit, estimator, found, mildest)


def judge_level(estimates: Sequence[Estimate], truth_nm: FloatArray, level: float) -> FaultLevel:
    """Return the figures of estimates against (n,) truths; NaN truths do not count."""
    torque_nm, low_nm, high_nm = values_of(estimates)
    known = np.isfinite(truth_nm)
    judged = known & np.isfinite(torque_nm)
    if not judged.any():
        return FaultLevel(level)
    error, missed = (torque_nm - truth_nm)[judged], judged & ~((low_nm <= truth_nm) & (truth_nm <= high_nm))
    valid, false_valid = (float(some.sum() / known.sum()) for some in (judged, missed))
    return FaultLevel(level, float(error.mean()), float(error.std()), valid, false_valid)


def reading_with(calibration: Calibration | SliceCalibration, bank: Bank | None) -> Session | SliceReader:
    """Return what estimates with a calibration."""
    if isinstance(calibration, SliceCalibration):
        return SliceReader(calibration, bank)
    return Session(calibration, bank)


def estimate_frames(
    tracker: Session | SliceReader, series: FrameSeries, usable: BoolArray | None = None
) -> list[Estimate]:
    """Return the estimates of frames with usable channels (n, m, 896), as in a live session that starts with them."""
    if isinstance(tracker, Session):
        tracker.reset()
    masks = repeat(None) if usable is None else usable
    frames = zip(series.t_s.tolist(), series.channels, masks, strict=False)
    return [tracker.estimate(TactileFrame.of(*frame)) for frame in frames]


def true_torques(series: FrameSeries) -> FloatArray:
    """Return the (n,) true torques of a series, NaN for frames that do not count."""
    torque = series.torque_at_frames()
    return torque if isinstance(series, SliceSeries) else balanced(torque)


def balanced(truth_nm: FloatArray) -> FloatArray:
    """Return (n,) truths with as many loaded frames as free ones, the rest NaN.

    Most of a stream is free of load: an estimator that always says zero would look stable.
    """
    loaded = np.abs(truth_nm) > LOADED_FRACTION * np.nanmax(np.abs(truth_nm))
    free = np.flatnonzero(np.isfinite(truth_nm) & ~loaded)
    kept = free[np.linspace(0, len(free) - 1, min(len(free), int(loaded.sum()))).astype(int)] if len(free) else free
    return np.where(loaded | np.isin(np.arange(len(truth_nm)), kept), truth_nm, np.nan)


def sweep(tracker: Session | SliceReader, scene: FaultScene, fault: FrameFault) -> FaultCurve:
    """Return an estimator's curve through one fault; slices are drawn several times, as chance picks electrodes."""
    truth = true_torques(scene.series)
    levels = []
    for level in fault.levels:
        estimates: list[Estimate] = []
        draws = _DRAWS if level > fault.levels[0] and isinstance(scene.series, SliceSeries) else 1
        for draw in range(draws):
            estimates += estimate_frames(tracker, *fault.apply(scene, level, np.random.default_rng((5, draw))))
        levels.append(judge_level(estimates, np.tile(truth, draws), level))
    return fault_curve(fault.name, fault.unit, tracker.calibration.estimator.name, levels)


def misaligned(
    split: Split, names: Sequence[EstimatorName], physics: Physics, shifts_s: Sequence[float]
) -> list[FaultCurve]:
    """Return curves of estimators calibrated on torques stamped too late by each shift.

    A refused calibration gives no valid estimate.
    """
    judged = shortened(split.future)

    def level(name: EstimatorName, shift_s: float) -> FaultLevel:
        late = replace(split.past, torque_t_s=split.past.torque_t_s + shift_s)
        shifted = f"{split.title}, torques that this chart shifted by {shift_s:+g} s"
        calibrations = fitted(replace(split, title=shifted, past=late), [name], physics)
        if not calibrations:
            return FaultLevel(shift_s)
        estimates = estimate_frames(reading_with(calibrations[0], physics.bank), judged)
        return judge_level(estimates, true_torques(judged), shift_s)

    fault = "calibrated on misaligned times"
    return [fault_curve(fault, "s", name, [level(name, shift_s) for shift_s in shifts_s]) for name in names]


def shortened(series: FrameSeries) -> FrameSeries:
    """Return the first frames, as many as are judged."""
    return series.between(0, min(len(series.t_s), _MAX_FRAMES))


def scene_for(split: Split, bank: Bank) -> FaultScene:
    """Return the later frames with idle frame and noise of the earlier ones.

    Slices have no idle frame: the bank's homogeneous voltages take its place, scaled to the board's mean voltage.
    The foreign frame has the mean frame's voltages at shuffled channels.
    """
    series = shortened(split.future)
    rng = np.random.default_rng(7)
    foreign = np.array([layer[rng.permutation(PAPER_TABLE.n_channels)] for layer in series.channels.mean(axis=0)])
    if isinstance(series, SliceSeries):
        idle = np.abs(bank.homogeneous) * (MEAN_V / float(np.abs(bank.homogeneous).mean()))
        noise = residual_noise(split.past.channels[:, 0])
        return FaultScene(series, np.tile(idle, (len(series.sides), 1)), noise, foreign)
    idle = np.median(split.past.channels[:5], axis=0)
    return FaultScene(series, idle, float(np.median(channel_noise(split.past.channels[:, 0]))), foreign)


def sweeps(
    split: Split, names: Sequence[EstimatorName], physics: Physics, bank: Bank, executor: Executor
) -> list[FaultCurve]:
    """Return the curves of all estimators through all faults; each estimator is one task for the workers."""
    shared = scene_for(split, bank), str(bank.path.resolve())
    return [
        curve for curves in executor.map(sweep_estimator, shared, fitted(split, names, physics)) for curve in curves
    ]


def sweep_estimator(shared: tuple[FaultScene, str], calibration: Calibration | SliceCalibration) -> list[FaultCurve]:
    """Return one estimator's curves through all faults; a worker opens the bank's file by its path."""
    scene, path = shared
    tracker = reading_with(calibration, Bank.open(path))
    return [sweep(tracker, scene, fault) for fault in FAULTS]


def sweeps_figure(title: str, curves: Sequence[FaultCurve], panels: int = 3) -> Figure:
    """Draw bias, valid and false-valid fraction of every estimator, one row per fault; more panels stay empty."""
    faults = list(dict.fromkeys((curve.fault, curve.unit) for curve in curves))
    names = list(dict.fromkeys(curve.estimator for curve in curves))
    made = figure(5 * panels, 2.75 * len(faults) + 1.0)
    rows = made.subplots(len(faults), panels, squeeze=False)
    for row, (fault, unit) in zip(rows, faults, strict=True):
        for panel, heading in zip(
            row, ("bias, and spread as bars, mN·m", "valid share", "FALSE-VALID share"), strict=False
        ):
            label_panel(panel, unit, heading)
        row[0].set_title(fault, fontsize=10.5, loc="left", fontweight="bold")
        row[0].axhline(0, color="#999999", linewidth=0.8)
        row[2].axhline(BROKEN_FRACTION, color="#999999", linewidth=1.2, linestyle=(0, (1, 2)))
        for panel in row[1:3]:
            panel.set_ylim(-0.04, 1.04)
        for curve in curves:
            if curve.fault == fault:
                _draw_curve(row, curve, names.index(curve.estimator), len(names))
    made.legend(*rows[0, 2].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=len(names))
    made.suptitle(
        f"{title}\n× breaks silently: more than {BROKEN_FRACTION:.0%} of the frames are called valid and miss "
        "their 95 % interval",
        fontsize=12,
    )  # fmt: skip
    return made


def label_panel(panel: Axes, unit: str, heading: str) -> None:
    """Label both axes and draw a grid."""
    panel.set_ylabel(heading, fontsize=9)
    panel.set_xlabel(unit, fontsize=9)
    panel.grid(alpha=0.25)


def offset_places(count: int, number: int, of: int) -> FloatArray:
    """Return the x places of one curve's marks, offset so that curves do not cover each other."""
    return np.arange(float(count)) + 0.12 * (number - (of - 1) / 2)


def _draw_curve(row: Sequence[Axes], one: FaultCurve, number: int, count: int) -> None:
    style = look(number) | {"linewidth": 1.3, "markersize": 5}
    labels = [f"{level.level:g}" for level in one.levels]
    x = offset_places(len(labels), number, count)
    # None becomes NaN.
    bias_nm, spread_nm = np.array([(level.bias_nm, level.spread_nm) for level in one.levels], dtype=float).T
    row[0].errorbar(x, 1e3 * bias_nm, yerr=1e3 * spread_nm, elinewidth=0.8, **style)
    row[1].plot(x, [level.valid for level in one.levels], **style)
    false = [level.false_valid for level in one.levels]
    row[2].plot(x, false, label=one.estimator, **style)
    for i, level in enumerate(one.levels):
        if level.level == one.breaks_at:
            row[2].plot(x[i], false[i], "x", color="black", markersize=13, markeredgewidth=2.5, zorder=5)
    for panel in row[:3]:
        panel.set_xticks(range(len(labels)), labels, fontsize=8)
        panel.set_xlim(-0.6, len(labels) - 0.4)
