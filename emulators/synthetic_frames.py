"""Synthetic frames of an EIT-kit on a twisted fingertip, from a bank's signals and the measured noise. No I/O."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import ChannelTable
from shearloop.drivers.eit_kit import ADC_STEP_V
from shearloop.errors import UserError

# Mean and frame-to-frame standard deviation of the recorded frames.
MEAN_V = 0.13
NOISE_V = 0.002
# With this fraction of the modelled conductivity change, difference frames have an RMS of 5 mV, as the 49 torque slices
# (Gaussian derivative, k = 3.25 cm, σ from 1.25 to 1.85 cm).
AMPLITUDE = 0.17
# σ at rest and at the largest torque of the slices, in N·m; k of the thinnest and thickest recorded cylinder.
SIGMA_CM, LARGEST_TORQUE_NM = (1.85, 1.25), 0.14
K_CM, DIAMETER_MM = (3.78, 3.47), (10.0, 40.0)
MAX_WIDTH_MM = 140.0


@dataclass(frozen=True, slots=True)
class TwistProgramme:
    """An endless programme: idle, grip, `cycles` twists, release.

    A cycle turns up to `torque_nm` in `turn_s`, holds for `hold_s`, turns back in `turn_s` and rests for `hold_s`.
    """

    torque_nm: float = 0.12
    idle_s: float = 15.0
    grip_s: float = 3.0
    turn_s: float = 5.0
    hold_s: float = 5.0
    cycles: int = 8

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the grip (0…1) and the torque in N·m at a time after the start."""
        cycle_s = 2 * (self.turn_s + self.hold_s)
        gripped_s = self.idle_s + self.grip_s
        released_s = gripped_s + self.cycles * cycle_s
        t_s %= released_s + self.grip_s
        grip = float(np.interp(t_s, [self.idle_s, gripped_s, released_s, released_s + self.grip_s], [0, 1, 1, 0]))
        if not gripped_s <= t_s < released_s:
            return grip, 0.0
        moments = np.cumsum([0.0, self.turn_s, self.hold_s, self.turn_s])
        twist = np.interp((t_s - gripped_s) % cycle_s, moments, [0.0, 1.0, 1.0, 0.0])
        return grip, self.torque_nm * float(twist)


class Synthesiser:
    """Makes lines of RMS magnitudes, as the board's ADC reads them, at and between a bank's cells."""

    def __init__(self, bank: Bank, *, seed: int = 0, noise_v: float = NOISE_V) -> None:
        self._bank = bank
        # (n,) the injection, in order of time, of each channel.
        self.injections: NDArray[np.int64] = bank.table.electrodes[:, 0]
        self._gain = MEAN_V / float(np.abs(bank.homogeneous).mean())
        self._noise_v = noise_v
        self._random = np.random.default_rng(seed)

    def line(self, k: float, sigma: float | FloatArray, grip: float | FloatArray = 1.0) -> FloatArray:
        """Return the (v,) values of one frame; `grip` from 0 (untouched) to 1 scales the change.

        σ and grip may be (n,), with a value per channel. Raises UserError outside the bank's valid cells.
        """
        volts = self._bank.homogeneous + grip * AMPLITUDE * self.signal(k, sigma)
        volts = self._gain * np.abs(volts) + self._random.normal(0.0, self._noise_v, volts.shape)
        # The board rounds its RMS down to a whole step; no live channel reads 0.
        steps = np.maximum(np.floor(np.abs(volts) / ADC_STEP_V), 1.0)
        return self._bank.table.line_of_channels(steps * ADC_STEP_V)

    def signal(self, k: float, sigma: float | FloatArray) -> FloatArray:
        """Return the (n,) difference signal, interpolated between the bank's cells; σ is a number or (n,)."""
        bank, mixed = self._bank, np.zeros(self._bank.homogeneous.shape)
        sigmas = np.broadcast_to(sigma, mixed.shape)
        channels = np.arange(mixed.size)
        for i, share_k in _neighbours(bank.k_grid, np.array(k), "k"):
            for j, share_sigma in _neighbours(bank.sigma_grid, sigmas, "sigma"):
                share = share_k * share_sigma
                missing = (share > 0) & ~bank.valid[i, j]
                if missing.any():
                    where = f"k = {k:g}, sigma = {sigmas[missing][0]:g}"
                    raise UserError(f"the bank has no signal at {where}; choose others")
                mixed += share * bank.signals[i, j, channels]
        return mixed


def _neighbours(grid: FloatArray, values: FloatArray, name: str) -> Iterator[tuple[NDArray[np.int64], FloatArray]]:
    """Yield the indices of the grid values below and above `values`, with their weights."""
    outside = values[~((values >= grid[0]) & (values <= grid[-1]))]
    if outside.size:
        raise UserError(f"the bank has {name} from {grid[0]:g} to {grid[-1]:g}, and not {outside[0]:g}; choose another")
    places = np.interp(values, grid, np.arange(len(grid)))
    below = np.floor(places).astype(np.int64)
    yield below, 1.0 - (places - below)
    yield np.minimum(below + 1, len(grid) - 1), places - below


class RigFrames:
    """The frames of the emulated rig's fingertips, from a bank.

    σ falls linearly with the torque, from `sigma_cm[0]` at none to `sigma_cm[1]` at 0.14 N·m, and rises for negative
    torques. k falls with the diameter. Beyond the bank σ and k stay at its edge.
    """

    def __init__(self, bank_path: Path, seed: int, sigma_cm: tuple[float, float] = SIGMA_CM) -> None:
        """Open the bank; raises UserError for a σ at rest outside of it, BankError for an unreadable file."""
        rest, largest = sigma_cm
        if largest >= rest:
            raise UserError(f"--sigma {rest:g} {largest:g}: sigma falls as the torque rises; give the larger one first")
        self._bank = Bank.open(bank_path)
        self._synthesiser = Synthesiser(self._bank, seed=seed)
        low, high = self._sigma_range(rest)
        # (2,) the ascending ends of the line, in N·m and cm.
        self._sigmas_cm = np.array([high, low])
        self._torques_nm = (self._sigmas_cm - rest) * LARGEST_TORQUE_NM / (largest - rest)

    @property
    def table(self) -> ChannelTable:
        """The fingertips' channels."""
        return self._bank.table

    def line(self, grip: FloatArray, shear_torque_nm: FloatArray, diameter_mm: float) -> FloatArray:
        """Return the board's line, (v,) in volts, for grip (0…1) and shear at each injection, (L,) each."""
        sigma_cm = np.interp(shear_torque_nm, self._torques_nm, self._sigmas_cm)
        # The scene has the values of 32 injections.
        injections = self._synthesiser.injections * len(grip) // self._bank.table.n_electrodes
        return self._synthesiser.line(self._k_cm(diameter_mm), sigma_cm[injections], grip[injections])

    def _k_cm(self, diameter_mm: float) -> float:
        slope = (K_CM[1] - K_CM[0]) / (DIAMETER_MM[1] - DIAMETER_MM[0])
        k = K_CM[0] + slope * (diameter_mm - DIAMETER_MM[0])
        return float(np.clip(k, self._bank.k_grid[0], self._bank.k_grid[-1]))

    def _sigma_range(self, rest: float) -> tuple[float, float]:
        """Return the ends of the σ around `rest` with a signal at every k of a tool."""
        bank = self._bank
        thick, thin = np.searchsorted(bank.k_grid, [self._k_cm(MAX_WIDTH_MM), self._k_cm(0.0)])
        valid = bank.valid[max(thick - 1, 0) : thin + 1].min(axis=0)
        at = int(np.searchsorted(bank.sigma_grid, rest))
        if rest < bank.sigma_grid[0] or at == len(valid) or not valid[at]:
            raise UserError(f"the bank has no signal at sigma = {rest:g}; give another --sigma or another bank")
        missing = np.flatnonzero(~valid)
        first = int(missing[missing < at].max(initial=-1)) + 1
        last = int(missing[missing > at].min(initial=len(valid))) - 1
        return float(bank.sigma_grid[first]), float(bank.sigma_grid[last])
