"""How much of a foreign frame can be seen in a slice: by the guard's limit, and by the best limit there could be.

A slice's own drift moves it as far from the calibration as a small share of a foreign frame does. The best limit is the
lowest that refuses none of the later slices; only the future knows it. What it lets pass no rule on the misfit can
refuse without refusing good slices, whatever its limit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation import FrameSeries
from shearloop.bank.estimation.bank_match import Registration
from shearloop.bank.estimation.novelty import NoveltyDetector
from shearloop.bank.estimation.reciprocity import ReciprocityCheck
from shearloop.daemon.analysis.charts.picture import SHADES, figure, look

SHARES = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
ORIGINS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_SHOWN_ORIGIN = 0.6
_TURNED_ELECTRODES = 5


@dataclass(frozen=True, slots=True)
class Detected:
    """One origin, kind of foreign frame and share of it: misfits of the later slices in units of their limit.

    The misfit is that of what is measured twice. passing is the share that the guard lets through, passing_best that of
    the best limit; auc is how often a spoilt slice has a larger misfit than a good one.
    """

    origin: float
    kind: str
    share: float
    misfits: tuple[float, ...]
    passing: float
    passing_best: float
    auc: float


def detected(series: FrameSeries, origins: Sequence[float] = ORIGINS, seed: int = 7) -> list[Detected]:
    """Return what each share of a foreign frame looks like to a guard of the slices before each origin."""
    frames = np.abs(series.channels[:, 0])
    usable = np.ones(N_CHANNELS, dtype=np.bool_)
    turned = Registration(_TURNED_ELECTRODES, reflected=False, score=1.0, runner_up=0.0).model_channels()
    found = []
    for origin in origins:
        n = round(origin * len(frames))
        guard, later = NoveltyDetector.fit(frames[:n]), frames[n:]
        mean = later.mean(axis=0)
        foreign = {
            "another fingertip": mean[np.random.default_rng(seed).permutation(N_CHANNELS)],
            f"turned by {_TURNED_ELECTRODES} electrodes": mean[turned],
        }
        twins = ReciprocityCheck.fit(frames[:n])
        good = _misfits(twins, later)
        for kind, one in foreign.items():
            for share in SHARES:
                spoilt = (1 - share) * later + share * one
                misfits = _misfits(twins, spoilt)
                found.append(
                    Detected(
                        origin, kind, share, tuple(misfits),
                        float(np.mean([not guard.judge(frame, usable).why for frame in spoilt])),
                        float((misfits <= good.max()).mean()),
                        float((misfits[:, None] > good).mean() + 0.5 * (misfits[:, None] == good).mean()),
                    )
                )  # fmt: skip
    return found


def _misfits(twins: ReciprocityCheck, frames: FloatArray) -> FloatArray:
    usable = np.ones(N_CHANNELS, dtype=np.bool_)
    return np.array([twins.misfit(one, usable) for one in frames]) / twins.largest_misfit


def detectability_figure(title: str, found: Sequence[Detected]) -> Figure:
    """Draw the misfits of one origin, and what passes at all of them."""
    made = figure(15, 6)
    clouds, passing = made.subplots(1, 2, gridspec_kw={"width_ratios": [1, 1.15]})
    kinds = list(dict.fromkeys(one.kind for one in found))
    origins = list(dict.fromkeys(one.origin for one in found))
    shown = min(origins, key=lambda one: abs(one - _SHOWN_ORIGIN))
    for one in found:
        if one.origin == shown and one.kind == kinds[0]:
            x = np.full(len(one.misfits), one.share) + np.linspace(-0.008, 0.008, len(one.misfits))
            clouds.plot(x, one.misfits, "o", color=SHADES[1], markersize=4, alpha=0.7)
    good = next(one for one in found if one.origin == shown and one.share == 0)
    clouds.axhline(1.0, color="black", linewidth=1.4, label="the guard's limit, from the earlier slices alone")
    clouds.axhline(
        max(good.misfits), color="black", linestyle=":", linewidth=1.4, label="best limit: the worst good slice"
    )
    clouds.set(
        xlabel=f"share of a foreign frame ({kinds[0]})", ylabel="misfit of each later slice, by what it measures twice",
        title=f"calibrated on the first {shown:.0%}", yscale="log",
    )  # fmt: skip
    clouds.legend(fontsize=8.5, loc="upper left")
    for number, (kind, name, label) in enumerate(
        [(kind, name, label) for kind in kinds
         for name, label in (("passing", "guard"), ("passing_best", "best limit there could be"))]
    ):  # fmt: skip
        rows = [[getattr(one, name) for one in found if one.kind == kind and one.share == share] for share in SHARES]
        mean = [float(np.mean(row)) for row in rows]
        bars = np.array([[m - min(row), max(row) - m] for m, row in zip(mean, rows, strict=True)]).T
        x = np.array(SHARES) + 0.003 * (number - 1.5)
        passing.errorbar(x, mean, yerr=bars, linewidth=1.4, elinewidth=0.8, label=f"{kind}: {label}", **look(number))
    passing.set(
        xlabel="share of the foreign frame", ylabel="share of the slices that passes",
        title=f"mean of {len(origins)} origins (bars: lowest and highest)", ylim=(-0.04, 1.04),
    )  # fmt: skip
    passing.legend(fontsize=8.5, loc="upper right")
    for panel in (clouds, passing):
        panel.grid(alpha=0.25)
    made.suptitle(f"How much of a foreign frame can be seen: {title}")
    return made
