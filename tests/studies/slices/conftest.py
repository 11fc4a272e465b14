"""Slices by formulas: a pattern, a curve over the torque, a drift."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.channels import PAPER_TABLE
from shearloop.estimation import Estimate, TactileFrame
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.reader import SliceReader
from shearloop.studies.slices.series import SliceSeries


def sliced(n_repeats: int = 5, seed: int = 0, noise_v: float = 0.0008) -> SliceSeries:
    """Return |differences| of ten rising torques, repeated, with a drift that grows from repeat to repeat."""
    rng = np.random.default_rng(seed)
    shape = np.random.default_rng(77)
    base, slope, bend, drift = (
        np.abs(shape.normal(0, scale, PAPER_TABLE.n_channels)) for scale in (6e-3, 1e-3, 2e-4, 6e-4)
    )
    torque = np.tile(np.linspace(0.01, 0.14, 10), n_repeats) + rng.normal(0, 0.002, 10 * n_repeats)
    z = (torque - 0.075) / 0.04
    wandering = np.linspace(0, 1, len(torque)) + rng.normal(0, 0.1, len(torque))
    frames = base + z[:, None] * slope + (z**2)[:, None] * bend + wandering[:, None] * drift
    return slices_of(frames + rng.normal(0, noise_v, frames.shape), torque)


def slices_of(frames: FloatArray, torque: FloatArray) -> SliceSeries:
    """Return the magnitudes of (n, 896) differences as slices of one fingertip, one a second."""
    t = np.arange(len(torque), dtype=float)
    return SliceSeries(("right",), t, np.abs(frames)[:, None], t, torque, np.full(len(t), np.nan))


def mixed(own: SliceSeries, share: float) -> SliceSeries:
    """Return slices mixed with a share of a foreign one."""
    foreign = own.channels.mean(axis=0)[:, np.random.default_rng(7).permutation(PAPER_TABLE.n_channels)]
    return replace(own, channels=(1 - share) * own.channels + share * foreign)


def read(calibration: SliceCalibration, played: SliceSeries, usable: BoolArray | bool = True) -> list[Estimate]:
    """Return the estimates of slices; `usable` is of each (1, 896) slice, or of all (n, 1, 896)."""
    reader = SliceReader(calibration)
    masks = np.broadcast_to(usable, played.channels.shape)
    slices = zip(played.t_s, played.channels, masks, strict=True)
    return [reader.estimate(TactileFrame.of(float(t), *each)) for t, *each in slices]


@pytest.fixture(scope="session")
def sliced_calibration() -> SliceCalibration:
    """An estimator calibrated on fifty slices."""
    return fit_slices("motion_regression", [sliced()], "all")
