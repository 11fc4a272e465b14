"""Frames of a twisted tool from a bank's signals: torque becomes sigma and diameter k, as on the paper's rig."""

from pathlib import Path

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation import Calibration
from shearloop.bank.estimation.interval_regressor import PolynomialRegressor
from shearloop.daemon.errors import UserError
from shearloop.daemon.synthetic import INJECTIONS, Synthesiser
from shearloop.drivers.emulators.rig import FrameOf

# σ at rest and at the largest torque of the recorded slices, in N·m; k of the thinnest and thickest recorded cylinder.
SIGMA_CM, LARGEST_TORQUE_NM = (1.85, 1.25), 0.14
K_CM, DIAMETER_MM = (3.78, 3.47), (10.0, 40.0)
WIDEST_MM = 140.0
N_PLACES = 2000


def frame_maker(
    bank_path: Path, seed: int, *, sigma: tuple[float, float] | None = None, calibration: Path | None = None
) -> FrameOf:
    """Return what makes a line (1024,) of the grip and shear torque at each injection, (32,) each, and a diameter.

    σ falls along a line as the torque rises, from `sigma[0]` at none to `sigma[1]` at 0.14 N·m, and goes on upwards
    for torques the other way; or it is where a calibration has that torque. Where the bank ends σ and k stay at its
    edge. Raises UserError for a σ at rest that the bank does not have, BankError for files that cannot be read.
    """
    bank = Bank.open(bank_path)
    synthesiser = Synthesiser(bank, seed=seed)
    if calibration is None:
        torques_nm, sigmas = _line(bank, *(sigma or SIGMA_CM))
    else:
        torques_nm, sigmas = _inverse(bank, calibration)

    def frame_of(grip: FloatArray, shear_torque_nm: FloatArray, diameter_mm: float) -> FloatArray:
        sigma_cm = np.interp(shear_torque_nm, torques_nm, sigmas)
        return synthesiser.line(_k_cm(bank, diameter_mm), sigma_cm[INJECTIONS], grip[INJECTIONS])

    return frame_of


def _k_cm(bank: Bank, diameter_mm: float) -> float:
    slope = (K_CM[1] - K_CM[0]) / (DIAMETER_MM[1] - DIAMETER_MM[0])
    k = K_CM[0] + slope * (diameter_mm - DIAMETER_MM[0])
    return float(min(max(k, bank.k_grid[0]), bank.k_grid[-1]))


def _line(bank: Bank, rest: float, largest: float) -> tuple[FloatArray, FloatArray]:
    """Return ascending torques and their σ: the line over the bank's σ."""
    if largest >= rest:
        raise UserError(f"--sigma {rest:g} {largest:g}: sigma falls as the torque rises; give the larger one first")
    low, high = _sigma_range(bank, rest)
    sigmas = np.array([high, low])
    return (sigmas - rest) * LARGEST_TORQUE_NM / (largest - rest), sigmas


def _inverse(bank: Bank, path: Path) -> tuple[FloatArray, FloatArray]:
    """Return ascending torques and their σ: a calibration's curve as far as it falls, over the bank's σ."""
    calibration = Calibration.load(path)
    calibration.check_bank(bank)
    if calibration.torque is None or not isinstance(calibration.torque.regressor, PolynomialRegressor):
        raise UserError(f"{path} has no curve of torque over sigma; give --sigma instead")
    curve = calibration.torque.regressor.polynomial
    low, high = _sigma_range(bank, (curve.x_low + curve.x_high) / 2)
    sigmas = np.linspace(high, low, N_PLACES)
    torques_nm = np.array([curve(sigma) for sigma in sigmas])
    rising = np.diff(torques_nm) > 0
    inside = np.flatnonzero((sigmas[1:] >= curve.x_low) & (sigmas[:-1] <= curve.x_high))
    first, last = _run(rising, int(inside[0]))
    if last < inside[-1]:
        raise UserError(f"{path}: its torque does not fall with sigma everywhere; give --sigma instead")
    kept = slice(first, last + 2)  # a step has two ends
    return torques_nm[kept], sigmas[kept]


def _sigma_range(bank: Bank, within: float) -> tuple[float, float]:
    """Return the ends of the σ around `within` that have a signal at every k that a tool can have."""
    thick, thin = np.searchsorted(bank.k_grid, [_k_cm(bank, WIDEST_MM), _k_cm(bank, 0.0)])
    valid = bank.valid[max(thick - 1, 0) : thin + 1].min(axis=0)
    at = int(np.searchsorted(bank.sigma_grid, within))
    if within < bank.sigma_grid[0] or at == len(valid) or not valid[at]:
        raise UserError(f"the bank has no signal at sigma = {within:g}; give another --sigma or another bank")
    first, last = _run(valid, at)
    return float(bank.sigma_grid[first]), float(bank.sigma_grid[last])


def _run(flags: BoolArray, at: int) -> tuple[int, int]:
    """Return the first and last index of the true values around an index, itself where it stands alone."""
    missing = np.flatnonzero(~flags)
    first = int(missing[missing < at].max(initial=-1)) + 1
    return first, int(missing[missing > at].min(initial=len(flags))) - 1
