"""How far an estimate moves when a frame moves a little: between two frames, in small steps, along a straight line."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation import Calibration, EstimatorSession, TactileFrame
from shearloop.bank.estimation.bank_match import NOT_TURNED, BankMatcher, BestCell, NearestCell
from shearloop.bank.estimation.fitting_regressor import fit_reader
from shearloop.bank.estimation.regressors import Ridge
from shearloop.daemon.analysis.charts.sources import Split

STEPS = 25


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """Torques (n,) in N·m along a way through frames, NaN where not valid; hops are the moves from step to step."""

    name: str
    torque_nm: FloatArray
    share_nm: float

    @property
    def largest_hop_nm(self) -> float:
        """The largest move within one step, 0 where nothing was valid."""
        hops = np.abs(np.diff(self.torque_nm))
        return float(np.nanmax(hops)) if np.isfinite(hops).any() else 0.0

    @property
    def hops(self) -> int:
        """How many steps moved it by more than ten times the fair share of a step."""
        return int(np.count_nonzero(np.nan_to_num(np.abs(np.diff(self.torque_nm))) > 10 * self.share_nm))


def way(split: Split) -> tuple[FloatArray, float]:
    """Return (n, 896) differences from the least to the largest torque of the future, and a step's share of it."""
    torque = split.future.torque_at_frames()
    frames = np.abs(split.future.channels[np.argsort(torque), 0])
    shares = np.linspace(0.0, 1.0, STEPS, endpoint=False)[:, None]
    steps = [(1 - shares) * one + shares * other for one, other in pairwise(frames)]
    path = np.concatenate([*steps, frames[-1:]])
    return path, float(np.ptp(torque)) / len(path)


def walks(split: Split, bank: Bank, calibrations: list[Calibration]) -> list[Walk]:
    """Return what each way of reading says along the way; the first ones differ in the place they take alone."""
    path, share = way(split)
    locators: dict[str, BankMatcher] = {
        "paper: the maximum of all lags": BestCell(bank),
        "zero lag: the maximum, refined": NearestCell(bank, NOT_TURNED, mean_of_alike=False),
        "zero lag: mean of the cells alike (the fix)": NearestCell(bank, NOT_TURNED),
    }
    found = [Walk(name, _read(split, locator, path), share) for name, locator in locators.items()]
    for calibration in calibrations:
        if calibration.estimator in ("regression", "fused"):
            tracker = EstimatorSession(calibration, bank)
            torque = [tracker.estimate(TactileFrame.of(0.0, one[None])).torque_nm for one in path]
            found.append(Walk(calibration.estimator, np.array([np.nan if t is None else t for t in torque]), share))
    return found


def _read(split: Split, locator: BankMatcher, path: FloatArray) -> FloatArray:
    def features(frames: FloatArray) -> FloatArray:
        sigma = np.array([locator.locate(one).sigma for one in frames])
        return np.column_stack([sigma, sigma**2])

    past = features(np.abs(split.past.channels[:, 0]))
    reader = fit_reader(past, split.past.torque_at_frames(), Ridge.fit_scaled, strengths=(1e-9,))
    read: Callable[[FloatArray], float] = lambda one: reader.read(one)[0]  # noqa: E731
    return np.array([read(one) for one in features(path)])
