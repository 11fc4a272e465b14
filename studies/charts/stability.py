"""`shearloop chart stability`: estimators under faults, checks of slices, the rim of the bank, the loop on the skin."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import BankError
from shearloop.bank.mesh import Mesh
from shearloop.errors import UserError
from shearloop.estimation import Calibration, Physics, TactileFrame, bank_match
from shearloop.estimation.bank_match import NOT_TURNED
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.studies.charts import skin_loop
from shearloop.studies.charts.chart_data import Split, SyntheticSlices, fitted, played_bank, splits, torque_of
from shearloop.studies.charts.fault_sweeps import (
    BROKEN_FRACTION,
    FaultCurve,
    FaultLevel,
    estimate_frames,
    fault_curve,
    judge_level,
    label_panel,
    misaligned,
    offset_places,
    reading_with,
    sweeps,
    sweeps_figure,
)
from shearloop.studies.charts.speed_accuracy import matched_sigma, parabola
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.reader import SliceReader
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.banks import Grid
from shearloop.tools.drawing import figure, look, save, slug
from shearloop.tools.estimate_tracks import values_of
from shearloop.tools.parallel import Executor

AnyCalibration: TypeAlias = Calibration | SliceCalibration
STEPS = 25
SLICE_NAMES: tuple[EstimatorName, ...] = ("paper", "bank", "regression", "reconstruction", "motion_regression")
STREAM_NAMES: tuple[EstimatorName, ...] = ("bank", "regression", "motion_regression")
SHIFTS_S = (-0.54, -0.27, -0.13, 0.0, 0.13, 0.27, 0.54, 1.08)


def chart(parts: Sequence[Split], bank: Bank, mesh: Mesh, scratch: Path, out: Path, executor: Executor) -> list[Path]:
    """Measure, draw and write a chart per recording, the checks of slices, the bank's rim, and the loop on the skin."""
    physics, written = Physics(bank, mesh), []
    for number, split in enumerate(parts, start=1):
        _report(f"{split.title} ({number} of {len(parts)})")
        of_slices = isinstance(split.past, SliceSeries)
        curves = sweeps(split, SLICE_NAMES if of_slices else STREAM_NAMES, physics, bank, executor)
        if not of_slices:
            curves += misaligned(split, STREAM_NAMES, physics, SHIFTS_S)
        if not curves:
            raise UserError(
                f"{split.title}: no estimator can be calibrated on it (see above); chart a longer recording"
            )
        written += _written(f"stability-{slug(split.title)}", split.title, curves, out)
        if of_slices:
            written += _of_slices(split, bank, mesh, out, executor)
    _report("the rim of the bank")
    synthetic = next(split for split in splits([], 0.6, scratch) if isinstance(split.past, SliceSeries))
    curves = list(sweep_rims(fitted(synthetic, SLICE_NAMES, physics), bank, scratch))
    written += _written("stability-rims", "the rim of the bank, on synthetic slices", curves, out)
    _report("the loop on the skin")
    return written + skin_loop.chart(out, executor)


def _report(part: str) -> None:
    print(f"shearloop chart: measuring {part}, which may take minutes", file=sys.stderr, flush=True)


def _of_slices(split: Split, bank: Bank, mesh: Mesh, out: Path, executor: Executor) -> list[Path]:
    """Write the charts of slices: continuity, and torques beyond the calibrated ones."""
    name, physics = slug(split.title), Physics(bank, mesh)
    found = walks(split, bank, fitted(split, ("regression", "motion_regression"), physics))
    content: dict[str, Any] = {"steps": STEPS, "walks": [asdict(walk) for walk in found]}
    written = save(continuity_figure(split.title, found), content, out, f"continuity-{name}")
    beyond = extrapolate(split, SLICE_NAMES, bank, mesh, executor)
    content = {
        "broken_share": BROKEN_FRACTION,
        "title": split.title,
        "extrapolations": [
            asdict(extrapolation) | {"times_good": extrapolation.times_good} for extrapolation in beyond
        ],
    }
    return written + save(extrapolation_figure(split.title, beyond), content, out, f"extrapolation-{name}")


def _written(name: str, title: str, curves: Sequence[FaultCurve], out: Path) -> list[Path]:
    content = {"broken_share": BROKEN_FRACTION, "title": title, "curves": [asdict(curve) for curve in curves]}
    return save(sweeps_figure(f"Estimators under faults: {title}", curves), content, out, name)


@dataclass(frozen=True, slots=True, eq=False)
class ContinuityWalk:
    """Torques (n,) in N·m along a path through frames, NaN where not valid; `share_nm` is the fair fraction of a step.

    `largest_hop_nm` is the largest change within a step, 0 where nothing was valid; `hops` counts the changes by more
    than ten fair fractions.
    """

    name: str
    torque_nm: FloatArray
    share_nm: float
    largest_hop_nm: float
    hops: int


def walks(split: Split, bank: Bank, calibrations: Sequence[AnyCalibration]) -> list[ContinuityWalk]:
    """Return the torques of each estimator along the straight lines between later frames, by rising torque.

    The first three estimators differ only in the cell they choose.
    """
    torque_nm = split.future.torque_at_frames()
    frames = np.abs(split.future.channels[np.argsort(torque_nm), 0])
    shares = np.linspace(0.0, 1.0, STEPS, endpoint=False)[:, None]
    path = np.concatenate([*((1 - shares) * frame + shares * other for frame, other in pairwise(frames)), frames[-1:]])
    share_nm = float(np.ptp(torque_nm)) / len(path)
    locators: dict[str, bank_match.BankMatcher] = {
        "paper: the maximum of all lags": bank_match.PaperMatcher(bank),
        "zero lag: the maximum, refined": bank_match.RefinedMatcher(bank, NOT_TURNED, mean_of_alike=False),
        "zero lag: mean of the cells alike (the fix)": bank_match.RefinedMatcher(bank, NOT_TURNED),
    }
    torques: dict[str, FloatArray] = {}
    for name, locator in locators.items():
        torque_nm_of = parabola(split, partial(matched_sigma, locator))
        torques[name] = np.array([torque_nm_of(frame) for frame in path])
    for calibration in calibrations:
        tracker = reading_with(calibration, bank)
        estimates = [tracker.estimate(TactileFrame.of(0.0, frame[None])) for frame in path]
        torques[calibration.estimator.name] = values_of(estimates)[0]
    found = []
    for name, torque in torques.items():
        change_nm = np.nan_to_num(np.abs(np.diff(torque)))
        hops = int(np.count_nonzero(change_nm > 10 * share_nm))
        found.append(ContinuityWalk(name, torque, share_nm, float(change_nm.max(initial=0.0)), hops))
    return found


# Fractions of the slices to calibrate on, from the smallest torques or from the largest.
CALIBRATED_FRACTIONS = (0.8, 0.65, 0.5, 0.4, 0.3)
SMALLER = "calibrated on the smaller torques alone"
LARGER = "calibrated on the larger torques alone"
UNITS = {SMALLER: "largest torque calibrated on, N·m", LARGER: "smallest torque calibrated on, N·m"}
# The limit of the calibrated torques in N·m, and whether each slice (n,) lies beyond it and is judged.
CalibrationPart: TypeAlias = tuple[float, BoolArray]


@dataclass(frozen=True, slots=True)
class Extrapolation:
    """One estimator calibrated on ever fewer of the torques; the first level has all, and judges later slices.

    For each level `slices` counts those calibrated on, and `width_nm` is the median width of valid 95 % intervals.
    """

    curve: FaultCurve
    slices: tuple[int, ...]
    width_nm: tuple[float | None, ...]

    @property
    def times_good(self) -> tuple[float | None, ...]:
        """The widths relative to the first level's, None where either is unknown."""
        good = self.width_nm[0]
        return tuple(None if good is None or width is None else width / good for width in self.width_nm)


def calibration_parts(torque_nm: FloatArray) -> dict[str, list[CalibrationPart]]:
    """Return the parts of (n,) torques by direction, with ever fewer torques; limits are quantiles.

    A limit that leaves no slice to judge is left out.
    """
    found = {}
    for which, beyond in ((SMALLER, np.greater), (LARGER, np.less)):
        quantiles = np.array(CALIBRATED_FRACTIONS) if which == SMALLER else 1.0 - np.array(CALIBRATED_FRACTIONS)
        limits = np.quantile(torque_nm, quantiles, method="nearest").tolist()
        parts = [(limit, beyond(torque_nm, limit)) for limit in dict.fromkeys(limits)]
        found[which] = [(limit, judged) for limit, judged in parts if judged.any()]
    return found


def extrapolate(
    split: Split, names: Sequence[EstimatorName], bank: Bank, mesh: Mesh | None, executor: Executor
) -> list[Extrapolation]:
    """Return each estimator beyond the torques it was calibrated on; each calibration is one task for the workers.

    A refused calibration gives no valid estimate; its reason is printed.
    """
    if not isinstance(split.whole, SliceSeries):
        raise TypeError("only slices have levels to leave out")
    known = select_rows(split.whole, np.isfinite(split.whole.torque_at_frames()))
    later, beyond = known.t_s > split.past.t_s[-1], calibration_parts(known.torque_nm)
    for which, extreme in ((SMALLER, np.max), (LARGER, np.min)):
        beyond[which].insert(0, (float(extreme(known.torque_nm[~later])), later))
    tasks = [(which, name, part) for which, parts in beyond.items() for name in names for part in parts]
    outcomes = executor.map(judge_others, (known, str(bank.path.resolve()), mesh), tasks)
    found = []
    for (which, name), steps in groupby(zip(tasks, outcomes, strict=True), key=lambda one: one[0][:2]):
        levels, slices, widths = [], [], []
        for (_, _, (limit_nm, judged)), (level, width_nm, refusal) in steps:
            levels.append(level)
            slices.append(int(np.count_nonzero(~judged)))
            widths.append(width_nm)
            if refusal:
                print(f"{split.title}: {name}, {which} ({limit_nm:.3f} N·m), is left out: {refusal}")
        curve = fault_curve(which, UNITS[which], name, levels)
        found.append(Extrapolation(curve, tuple(slices), tuple(widths)))
    return found


def select_rows(series: SliceSeries, chosen: BoolArray) -> SliceSeries:
    """Return the chosen (n,) frames of a series with their own torques only."""
    t_s = series.t_s[chosen]
    return replace(
        series, t_s=t_s, channels=series.channels[chosen], torque_t_s=t_s, torque_nm=series.torque_at_frames()[chosen],
        diameter_mm=series.diameter_mm[chosen],
        fingers_moved=None if series.fingers_moved is None else series.fingers_moved[chosen],
    )  # fmt: skip


def judge_others(
    shared: tuple[SliceSeries, str, Mesh | None], task: tuple[str, EstimatorName, CalibrationPart]
) -> tuple[FaultLevel, float | None, str]:
    """Return the figures and the median width of a part's judged slices, and the reason of a refused calibration."""
    (series, path, mesh), (_, name, (limit_nm, judged)) = shared, task
    bank = Bank.open(path)
    try:
        calibration = fit_slices(name, [select_rows(series, ~judged)], "some torques", Physics(bank, mesh))
    except BankError as error:
        return FaultLevel(limit_nm), None, str(error)
    others = select_rows(series, judged)
    estimates = estimate_frames(SliceReader(calibration, bank), others)
    _, low_nm, high_nm = values_of([estimate for estimate in estimates if estimate.valid])
    width_nm = float(np.median(high_nm - low_nm)) if len(low_nm) else None
    return judge_level(estimates, others.torque_nm, limit_nm), width_nm, ""


_K, _SIGMA = 3.2, 1.5
_FRAMES = 6
# The steepest fall of the Gaussian derivative is this over σ, below 1.
_STEEPEST = float(np.exp(-0.5))


def sweep_rims(calibrations: Sequence[AnyCalibration], bank: Bank, scratch: Path) -> Iterable[FaultCurve]:
    """Return the curves of estimators calibrated on synthetic slices along three paths of (k, σ) out of the bank."""
    lowest = (0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)
    k_end, sigma_end = float(bank.k_grid[-1]), float(bank.sigma_grid[-1])
    ks = (_K, *(round(k_end + step, 3) for step in (-0.3, -0.1, 0.0, 0.1, 0.2)))
    sigmas = (_SIGMA, *(round(sigma_end + step, 3) for step in (-0.3, -0.1, 0.0, 0.2, 0.5, 1.0)))
    rims = (
        ("conductivity near zero", "smallest conductivity (homogeneous = 1)", lowest,
            [(_K, _STEEPEST / (1.0 - least)) for least in lowest]),
        (f"k at the rim of the grid ({k_end:g} cm) and beyond", "k, cm", ks, [(k, _SIGMA) for k in ks]),
        (f"σ at the rim of the grid ({sigma_end:g} cm) and beyond", "σ, cm", sigmas, [(_K, sigma) for sigma in sigmas]),
    )  # fmt: skip
    k_grid, sigma_grid = (
        np.unique(coordinates) for coordinates in np.array([place for *_, places in rims for place in places]).T
    )
    # The same idle frame as the slices': its noise is in every difference.
    slices = SyntheticSlices(played_bank(scratch, Grid(k_grid, sigma_grid)))
    trackers = [reading_with(calibration, bank) for calibration in calibrations]
    for name, unit, settings, places in rims:
        series = [slices.series([(k, s, 1.0)] * _FRAMES, np.full(_FRAMES, torque_of(s))) for k, s in places]
        for tracker in trackers:
            levels = [
                judge_level(estimate_frames(tracker, slice_series), slice_series.torque_nm, level)
                for level, slice_series in zip(settings, series, strict=True)
            ]
            yield fault_curve(name, unit, tracker.calibration.estimator.name, levels)


def extrapolation_figure(title: str, found: Sequence[Extrapolation]) -> Figure:
    """Draw the estimators beyond the torques they were calibrated on, and the width of their intervals."""
    made = sweeps_figure(
        f"Torques beyond the calibrated ones: {title}\nat “all”: calibrated on the earlier slices, judged on the later "
        "ones; else all other slices are judged; below each limit: number of calibrated slices",
        [extrapolation.curve for extrapolation in found], panels=4,
    )  # fmt: skip
    for first, (_, group) in enumerate(groupby(found, key=lambda extrapolation: extrapolation.curve.fault)):
        here, row = list(group), made.axes[4 * first : 4 * first + 4]
        label_panel(row[3], here[0].curve.unit, "median width ÷ that at “all”")
        row[3].axhline(1.0, color="#999999", linewidth=0.8)
        for number, extrapolation in enumerate(here):
            times = np.array(extrapolation.times_good, dtype=float)
            x = offset_places(len(times), number, len(here))
            row[3].plot(x, times, linewidth=1.3, markersize=5, **look(number))
        row[3].set_ylim(bottom=0.0)
        labels = [f"{level.level:.3f}\n{n}" for level, n in zip(here[0].curve.levels, here[0].slices, strict=True)]
        for panel in row:
            panel.set_xticks(range(len(labels)), ["all\n" + labels[0].split("\n")[1], *labels[1:]], fontsize=8)
            panel.set_xlim(-0.6, len(labels) - 0.4)
    return made


def continuity_figure(title: str, walks: Sequence[ContinuityWalk]) -> Figure:
    """Draw the estimates along a path through the frames, and the largest change of each within one small step."""
    made = figure(15, 6.2)
    way, bars = made.subplots(1, 2, gridspec_kw={"width_ratios": [2.3, 1]})
    for number, walk in enumerate(walks):
        style = look(number) | {"linewidth": 1.4, "markersize": 4}
        at = np.arange(len(walk.torque_nm)) / STEPS
        way.plot(at, walk.torque_nm, markevery=(2 * number, 40), label=walk.name, **style)
        hop_mnm = 1e3 * walk.largest_hop_nm
        bars.barh(number, hop_mnm, color="#d9d9d9", edgecolor="black", hatch="/\\x.o"[number % 5])
        bars.text(hop_mnm, number, f"  {hop_mnm:.2f} ({walk.hops} hops)", va="center", fontsize=9)
    bars.set_yticks(range(len(walks)), [walk.name.replace(": ", ":\n") for walk in walks], fontsize=8.5)
    bars.invert_yaxis()
    bars.margins(x=0.45)
    bars.axvline(1e3 * walks[0].share_nm, color="black", linestyle=":", linewidth=1)
    bars.set(
        xlabel="largest change of the torque in one step, mN·m\n(dotted: a step's fair share of the path)",
        title=f"in {STEPS} steps from one frame to the next",
    )  # fmt: skip
    way.set(
        xlabel="frames of the later part by rising torque, joined by straight lines", ylabel="torque, N·m",
        title="estimates along the path",
    )  # fmt: skip
    way.grid(alpha=0.25)
    way.legend(fontsize=8.5)
    made.suptitle(f"Continuity: how far the estimate jumps for a small change of the frame, {title}")
    return made
