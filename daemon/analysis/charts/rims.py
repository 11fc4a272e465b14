"""Where the bank ends: conductivity near zero, k and σ at the rim of the grid and beyond, on frames solved for it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.models import conductivity
from shearloop.bank.estimation import Calibration, EstimatorSession, FrameSeries
from shearloop.daemon.analysis.charts.faults import Spoilt
from shearloop.daemon.analysis.charts.sources import (
    PLAYED_MESH_SIZE_CM,
    homogeneous_of,
    mean_frame,
    own_fingertip,
    played_bank,
    torque_of,
)
from shearloop.daemon.analysis.charts.stability import Curve, curve, estimates_of, judged
from shearloop.daemon.synthetic import Synthesiser

MODEL = "gaussian_derivative"
_K, _SIGMA = 3.2, 1.5
_FRAMES = 6
_STEEPEST = float(np.exp(-0.5))


@dataclass(frozen=True, slots=True)
class Rim:
    """A walk out of what the bank covers: the places (k, σ) in cm of each level."""

    name: str
    unit: str
    levels: tuple[float, ...]
    places: tuple[tuple[float, float], ...]


def rims(bank: Bank) -> list[Rim]:
    """Return the walks for this bank's grid."""
    lowest = (0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)
    k_end, sigma_end = float(bank.k_grid[-1]), float(bank.sigma_grid[-1])
    ks = (_K, *(round(k_end + step, 3) for step in (-0.3, -0.1, 0.0, 0.1, 0.2)))
    sigmas = (_SIGMA, *(round(sigma_end + step, 3) for step in (-0.3, -0.1, 0.0, 0.2, 0.5, 1.0)))
    return [
        # The steepest fall of the Gaussian derivative is exp(−1/2)/σ below 1.
        Rim("conductivity near zero", "smallest conductivity (homogeneous = 1)", lowest,
            tuple((_K, _STEEPEST / (1.0 - least)) for least in lowest)),
        Rim(f"k at the rim of the grid ({k_end:g} cm) and beyond", "k, cm", ks, tuple((k, _SIGMA) for k in ks)),
        Rim(f"σ at the rim of the grid ({sigma_end:g} cm) and beyond", "σ, cm", sigmas,
            tuple((_K, sigma) for sigma in sigmas)),
    ]  # fmt: skip


class _Solving(Synthesiser):
    """Frames of any place, solved for it: no bank's grid bounds them."""

    def __init__(self, bank: Bank, seed: int) -> None:
        super().__init__(bank, seed=seed)
        self._forward = ForwardModel(own_fingertip(PLAYED_MESH_SIZE_CM).mesh())
        self._homogeneous = self._forward.homogeneous()
        self._solved: dict[tuple[float, float], FloatArray] = {}

    def signal(self, k: float, sigma: float | FloatArray) -> FloatArray:
        """Return the (896,) difference signal of one k and σ, solved once: frames of a place differ by noise alone."""
        place = k, float(np.mean(sigma))
        if place not in self._solved:
            cell = conductivity(self._forward.mesh, MODEL, *place)
            self._solved[place] = self._forward.voltages(cell) - self._homogeneous
        return self._solved[place]


def at_rims(calibrations: Sequence[Calibration], bank: Bank, scratch: Path) -> Iterable[Curve]:
    """Return the estimators, which were calibrated on synthetic slices, on their way out of the bank."""
    # The same homogeneous frame as the slices': its noise is in every difference, and the guard knows it.
    synthesiser = _Solving(played_bank(scratch), 0)
    homogeneous = homogeneous_of(synthesiser)
    trackers = [EstimatorSession(calibration, bank) for calibration in calibrations]
    for rim in rims(bank):
        series = [_series(synthesiser, homogeneous, k, sigma) for k, sigma in rim.places]
        for tracker in trackers:
            levels = [
                judged(estimates_of(tracker, Spoilt(one)), one.torque_nm, level)
                for level, one in zip(rim.levels, series, strict=True)
            ]
            yield curve(rim.name, rim.unit, tracker.calibration.estimator, levels)


def _series(synthesiser: Synthesiser, homogeneous: FloatArray, k: float, sigma: float) -> FrameSeries:
    frames = np.array([np.abs(mean_frame(synthesiser, k, sigma, 1.0) - homogeneous) for _ in range(_FRAMES)])[:, None]
    t_s = np.arange(float(_FRAMES))
    return FrameSeries(
        "difference", ("right",), t_s, frames, t_s, np.full(_FRAMES, torque_of(sigma)), np.full(_FRAMES, np.nan)
    )
