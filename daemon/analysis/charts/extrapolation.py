"""Torques beyond those calibrated on: slices up to a torque, or from one on, are calibrated on, the others judged."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.errors import BankError
from shearloop.bank.estimation import EstimatorSession, FrameSeries, Name, Physics, fit
from shearloop.daemon.analysis.charts.faults import Spoilt
from shearloop.daemon.analysis.charts.sources import Split
from shearloop.daemon.analysis.charts.stability import Curve, Level, curve, estimates_of, judged
from shearloop.daemon.workers import Executor, in_order

# So many of the slices are calibrated on, those of the smallest torques or those of the largest.
SHARES = (0.8, 0.65, 0.5, 0.4, 0.3)
SMALLER = "calibrated on the smaller torques alone"
LARGER = "calibrated on the larger torques alone"
UNITS = {SMALLER: "largest torque calibrated on, N·m", LARGER: "smallest torque calibrated on, N·m"}


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The slices that are calibrated on, up to the limit in N·m or from it on, and those that are judged."""

    limit_nm: float
    fitted: IntArray
    others: IntArray


@dataclass(frozen=True, slots=True)
class Extrapolation:
    """One estimator calibrated on ever fewer of the torques; at the first level on all, and judged on later slices.

    For each level of the curve slices is how many were calibrated on, and width_nm the median width in N·m of the
    valid ones' 95 % intervals, None where nothing is valid.
    """

    curve: Curve
    slices: tuple[int, ...]
    width_nm: tuple[float | None, ...]

    @property
    def times_good(self) -> tuple[float | None, ...]:
        """The widths in units of that of good later slices, None where either is not known."""
        good = self.width_nm[0]
        return tuple(None if good is None or width is None else width / good for width in self.width_nm)


def parts(torque_nm: FloatArray) -> dict[str, list[Part]]:
    """Return the parts of (n,) torques by direction, of ever fewer torques.

    Limits are quantiles of the torques, each that of a slice; one at which no slice would be left to judge is left out.
    """
    found = {}
    for which, beyond in ((SMALLER, np.greater), (LARGER, np.less)):
        quantiles = np.array(SHARES) if which == SMALLER else 1.0 - np.array(SHARES)
        limits = np.quantile(torque_nm, quantiles, method="nearest").tolist()
        masks = [(limit, beyond(torque_nm, limit)) for limit in dict.fromkeys(limits)]
        found[which] = [Part(limit, np.flatnonzero(~mask), np.flatnonzero(mask)) for limit, mask in masks if mask.any()]
    return found


def extrapolated(
    split: Split, names: Sequence[Name], bank: Bank, mesh: Mesh | None, pool: Executor
) -> list[Extrapolation]:
    """Return each estimator beyond the torques that it was calibrated on; each calibration is a task of its own.

    One that is refused calls nothing valid; why is printed.
    """
    known = of_rows(split.whole, np.flatnonzero(np.isfinite(split.whole.torque_at_frames())))
    rows, n_earlier = np.arange(len(known.t_s)), int((known.t_s <= split.past.t_s[-1]).sum())
    earlier = {
        which: Part(float(extreme(known.torque_nm[:n_earlier])), rows[:n_earlier], rows[n_earlier:])
        for which, extreme in ((SMALLER, np.max), (LARGER, np.min))
    }
    shared, beyond = (known, str(bank.path.resolve()), mesh), parts(known.torque_nm)
    tasks = [(name, part) for name in names for part in (earlier[SMALLER], *beyond[SMALLER], *beyond[LARGER])]
    outcomes = dict(zip(tasks, in_order(pool.map(others_judged, shared, tasks)), strict=True))
    found = []
    for which, some in beyond.items():
        for name in names:
            steps = [(earlier[which], outcomes[name, earlier[SMALLER]])]
            steps += [(part, outcomes[name, part]) for part in some]
            found.append(_extrapolation(split.title, which, name, steps))
    return found


def of_rows(series: FrameSeries, rows: IntArray) -> FrameSeries:
    """Return these frames of a series with the torques at them alone: beside the others' nothing may be learned."""
    t_s = series.t_s[rows]
    return replace(
        series, t_s=t_s, channels=series.channels[rows], torque_t_s=t_s, torque_nm=series.torque_at_frames()[rows],
        diameter_mm=series.diameter_mm[rows],
    )  # fmt: skip


Outcome = tuple[Level, float | None] | str


def others_judged(shared: tuple[FrameSeries, str, Mesh | None], task: tuple[Name, Part]) -> Outcome:
    """Return the figures and the median width of the judged slices of a part, or why it was not calibrated on.

    A worker has to reach the bank's file.
    """
    (series, path, mesh), (name, part) = shared, task
    bank = Bank.open(path)
    try:
        calibration = fit(name, [of_rows(series, part.fitted)], "some torques", Physics(bank, mesh))
    except BankError as error:
        return str(error)
    others = of_rows(series, part.others)
    estimates = estimates_of(EstimatorSession(calibration, bank), Spoilt(others))
    widths = [
        one.torque_high_nm - one.torque_low_nm
        for one in estimates
        if one.torque_low_nm is not None and one.torque_high_nm is not None
    ]
    return judged(estimates, others.torque_nm, part.limit_nm), float(np.median(widths)) if widths else None


def _extrapolation(title: str, which: str, name: Name, steps: Sequence[tuple[Part, Outcome]]) -> Extrapolation:
    levels: list[Level] = []
    widths: list[float | None] = []
    for part, outcome in steps:
        if isinstance(outcome, str):
            print(f"{title}: {name}, {which} ({part.limit_nm:.3f} N·m), is left out: {outcome}")
            level, width = Level(part.limit_nm, None, None, 0.0, 0.0), None
        else:
            # The earlier slices are calibrated on once, and stand at the end of both directions.
            level, width = replace(outcome[0], level=part.limit_nm), outcome[1]
        levels.append(level)
        widths.append(width)
    slices = tuple(len(part.fitted) for part, _ in steps)
    return Extrapolation(curve(which, UNITS[which], name, levels), slices, tuple(widths))
