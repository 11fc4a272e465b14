"""Frames as an EIT-kit on a twisted fingertip would send them, from a bank's signals and the measured noise. No I/O."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import BankDefinition
from shearloop.bank.eit.build import RowSolver
from shearloop.bank.eit.channels import LINE_SLOTS, N_ELECTRODES, line_of_channels
from shearloop.bank.eit.mesh import Mesh
from shearloop.daemon.errors import UserError
from shearloop.drivers.eit_kit import ADC_STEP_V

# Of the recorded frames: their mean, and the standard deviation of a channel from frame to frame.
MEAN_V = 0.13
NOISE_V = 0.002
# With this share of the modelled change of conductivity the difference frames have an RMS of 5 mV, as the 49 torque
# slices have (Gaussian derivative, k = 3.25 cm, σ from 1.25 to 1.85 cm).
AMPLITUDE = 0.17
# Interpolated linearly, σ from 1.25 to 1.85 cm in so many values errs by less than a hundredth of the noise.
N_SIGMAS = 13
# (896,) the injection, 0…31 in order of time, during which each channel is measured.
INJECTIONS: NDArray[np.int64] = LINE_SLOTS // N_ELECTRODES


class Signals(Protocol):
    """What is needed of a bank: `shearloop.bank.eit.bank_file.Bank` has it."""

    @property
    def k_grid(self) -> NDArray[np.float64]:
        """(K,) ascending."""

    @property
    def sigma_grid(self) -> NDArray[np.float64]:
        """(S,) ascending."""

    @property
    def homogeneous(self) -> NDArray[np.float64]:
        """(896,) voltages of the untouched fingertip."""

    @property
    def signals(self) -> NDArray[np.float32]:
        """(K, S, 896) differences to them."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(K, S) cells that have a signal."""


@dataclass(frozen=True, slots=True, eq=False)
class SolvedSignals:
    """Signals of one k over some σ, in memory; the arrays are those of `Signals`."""

    k_grid: NDArray[np.float64]
    sigma_grid: NDArray[np.float64]
    homogeneous: NDArray[np.float64]
    signals: NDArray[np.float32]
    valid: NDArray[np.bool_]


def solved_signals(mesh: Mesh, k: float, sigma_low: float, sigma_high: float) -> SolvedSignals:
    """Solve the Gaussian derivative at one k and N_SIGMAS σ: what frames of a twist need where there is no bank.

    Raises ModelError for a k or σ that the model does not have.
    """
    k_grid, sigma_grid = np.array([k]), np.linspace(sigma_low, sigma_high, N_SIGMAS)
    solver = RowSolver(mesh, BankDefinition(mesh.digest, "gaussian_derivative", k_grid, sigma_grid))
    row = solver.solve(0)
    return SolvedSignals(k_grid, sigma_grid, solver.homogeneous, row.signals[None], row.valid[None])


@dataclass(frozen=True, slots=True)
class TwistProgramme:
    """What is done with a tool: nothing, grip it, twist and release it so many times, let go; then again.

    A cycle turns up to `torque_nm` in `turn_s`, holds for `hold_s`, turns back in `turn_s` and rests for `hold_s`.
    """

    torque_nm: float = 0.12
    idle_s: float = 15.0
    grip_s: float = 3.0
    turn_s: float = 5.0
    hold_s: float = 5.0
    cycles: int = 8

    def at(self, t_s: float) -> tuple[float, float]:
        """Return how firmly the tool is gripped (0…1) and the torque in N·m at a time after the start."""
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


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticFrame:
    """One line, (1024,) in volts, and the truth behind it at the middle of its acquisition."""

    line: NDArray[np.float64]
    t_s: float
    torque_nm: float
    grip: float
    k: float
    sigma: float


class Synthesiser:
    """Makes lines of RMS magnitudes, as the board's ADC would read them, for any cell of a bank and between cells."""

    def __init__(self, bank: Signals, *, seed: int = 0, amplitude: float = AMPLITUDE, noise_v: float = NOISE_V) -> None:
        self._bank = bank
        self._gain = MEAN_V / float(np.abs(bank.homogeneous).mean())
        self._amplitude = amplitude
        self._noise_v = noise_v
        self._random = np.random.default_rng(seed)

    def line(
        self, k: float, sigma: float | NDArray[np.float64], grip: float | NDArray[np.float64] = 1.0
    ) -> NDArray[np.float64]:
        """Return the (1024,) values of one frame; `grip` from 0 (untouched) to 1 scales the change.

        σ and grip may change while a frame is acquired: `[INJECTIONS]` makes (896,) values for the channels out of 32
        for the injections. Raises UserError for a k or σ outside the bank's valid cells.
        """
        volts = self._bank.homogeneous + grip * self._amplitude * self.signal(k, sigma)
        volts = self._gain * np.abs(volts) + self._random.normal(0.0, self._noise_v, volts.shape)
        # The board rounds its RMS down to a whole step; no live channel reads 0.
        steps = np.maximum(np.floor(np.abs(volts) / ADC_STEP_V), 1.0)
        return line_of_channels(steps * ADC_STEP_V)

    def signal(self, k: float, sigma: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (896,) difference signal, interpolated between the bank's cells; σ is one or (896,)."""
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


def twist_frames(
    synthesiser: Synthesiser,
    programme: TwistProgramme,
    *,
    k: float,
    sigma_of_torque: Callable[[float], float],
    period_s: float,
) -> Iterator[SyntheticFrame]:
    """Yield the frames of a programme for ever, one every `period_s`.

    `sigma_of_torque` is the inverse of a calibration: the σ that a torque in N·m makes. Raises UserError as
    Synthesiser.line does.
    """
    number = 0
    while True:
        t_s = (number + 0.5) * period_s
        grip, torque_nm = programme.at(t_s)
        sigma = sigma_of_torque(torque_nm)
        yield SyntheticFrame(synthesiser.line(k, sigma, grip), t_s, torque_nm, grip, k, sigma)
        number += 1


def _neighbours(
    grid: NDArray[np.float64], values: NDArray[np.float64], name: str
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield the indices of the grid values below and above `values`, with their shares, which may be nothing."""
    outside = values[~((values >= grid[0]) & (values <= grid[-1]))]
    if outside.size:
        raise UserError(f"the bank has {name} from {grid[0]:g} to {grid[-1]:g}, and not {outside[0]:g}; choose another")
    places = np.interp(values, grid, np.arange(len(grid)))
    below = np.floor(places).astype(np.int64)
    yield below, 1.0 - (places - below)
    yield np.minimum(below + 1, len(grid) - 1), places - below
