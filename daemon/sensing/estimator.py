"""From frames to readings: baseline, average, match, calibrate. A plain object without I/O.

This is the paper's way (Trehan et al. 2025, section 2): the difference to the homogeneous frame is matched against
the bank, and the best cell's sigma and k become torque and diameter through the calibration.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.calibration import Calibration
from shearloop.bank.eit.matching import Match, signal_above_noise
from shearloop.bank.eit.polynomial import Interval
from shearloop.bank.estimation import Measured
from shearloop.bank.estimation.fingertip_validator import LEAST_NOISE_V
from shearloop.drivers.eit_kit import Frame

# Above this share of unusable channels the match would be made of what is left over.
LARGEST_UNUSABLE_SHARE = 0.10
# After a longer gap than this between usable frames the mean begins anew: what was before it is not the present.
LONGEST_GAP_NS = 3_000_000_000
# Degrees of freedom with which the mean variance of all channels enters that of each.
POOLED_FREEDOM = 30


class Matcher(Protocol):
    """Anything that scores a difference signal against every cell of a bank."""

    @property
    def k_grid(self) -> FloatArray:
        """Centres of the bank's rows."""

    @property
    def sigma_grid(self) -> FloatArray:
        """Widths of the bank's columns."""

    def match(self, difference: FloatArray) -> Match:
        """Return the best cell of a (896,) difference, and its runner-up."""

    def heatmap(self, difference: FloatArray) -> FloatArray:
        """Return the (k, sigma) scores of a (896,) difference, NaN at cells that are not valid."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What one frame said: the match, torque and diameter, and what speaks against them."""

    match: Match | None = None
    # The scores of all cells, where they were computed on the way.
    heatmap: FloatArray | None = None
    torque_nm: Interval | None = None
    diameter_mm: Interval | None = None
    why: tuple[str, ...] = ()
    # By how much the torque's own time lies before the frame's, because frames were averaged.
    lag_ns: int = 0
    # The (896,) difference that was matched.
    difference: FloatArray | None = None

    @property
    def valid(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.why


class Baseline:
    """The homogeneous frame and the noise of each channel, from the first frames after a tare."""

    def __init__(self, frames: int) -> None:
        self.wanted = frames
        self.taken = 0
        self._sum = np.zeros(0)
        self._sum_of_squares = np.zeros(0)
        self._noise_of: dict[int, FloatArray] = {}

    @property
    def complete(self) -> bool:
        """Whether enough frames have been taken."""
        return self.taken >= self.wanted

    def add(self, channels: FloatArray) -> None:
        """Take one more frame into the average."""
        if self.taken == 0:
            # Sums are of deviations from the first frame: squares of volts would lose the microvolts.
            self._first = channels
            self._sum = np.zeros_like(channels)
            self._sum_of_squares = np.zeros_like(channels)
        deviation = channels - self._first
        self._sum += deviation
        self._sum_of_squares += deviation**2
        self.taken += 1
        # Asked for with every frame from now on.
        self.__dict__.pop("homogeneous", None)
        self.__dict__.pop("noise", None)
        self._noise_of.clear()

    @cached_property
    def homogeneous(self) -> FloatArray:
        """The mean of the frames taken, (896,) in volts."""
        return self._first + self._sum / self.taken

    @cached_property
    def noise(self) -> FloatArray:
        """The standard deviation of one frame, (896,) in volts, at least that of the converter's rounding.

        A few frames know the variance of one channel badly, and dividing by what is too small by chance would see
        signals in noise: each channel's variance is drawn towards the mean of all (Smyth 2004), whose converter is one.
        """
        mean = self._sum / self.taken
        freedom = self.taken - 1
        own = (self._sum_of_squares - self.taken * mean**2) / freedom
        variance = (freedom * own + POOLED_FREEDOM * own.mean()) / (freedom + POOLED_FREEDOM)
        return np.asarray(np.sqrt(np.maximum(variance, LEAST_NOISE_V**2)))

    def noise_of_difference(self, frames: int) -> FloatArray:
        """Return the standard deviation of the mean of so many frames to the homogeneous one, (896,) in volts."""
        noise = self._noise_of.get(frames)
        if noise is None:
            noise = self._noise_of[frames] = self.noise * math.sqrt(1.0 / frames + 1.0 / self.taken)
        return noise


@dataclass(frozen=True, slots=True, eq=False)
class _Difference:
    """The (896,) difference that is to be matched, and the frames that it is the mean of."""

    difference: FloatArray
    latest: tuple[Frame, ...]


class Estimator:
    """Turns the frames of one fingertip into readings, one for each frame, in order."""

    def __init__(
        self,
        matcher: Matcher,
        calibration: Calibration | None,
        *,
        baseline_frames: int,
        average_frames: int,
        longest_gap_ns: int = LONGEST_GAP_NS,
        model: str = "",
    ) -> None:
        self.model = model
        self._matcher = matcher
        self._calibration = calibration
        self._baseline_frames = baseline_frames
        self._longest_gap_ns = longest_gap_ns
        self._latest: tuple[Frame, ...] = ()
        self._average_frames = average_frames
        self.tare()

    @property
    def grids(self) -> tuple[FloatArray, FloatArray]:
        """The k and the sigma of the cells that are scored."""
        return self._matcher.k_grid, self._matcher.sigma_grid

    @property
    def measures_torque(self) -> bool:
        """Whether a torque can be read from its frames at all."""
        return self._calibration is not None and self._calibration.torque_fit is not None

    @property
    def baseline_complete(self) -> bool:
        """Whether the homogeneous frame has been taken."""
        return self._baseline.complete

    def tare(self) -> None:
        """Take a new homogeneous frame from the frames to come."""
        self._baseline = Baseline(self._baseline_frames)
        self._latest = ()

    def hold(self, tool: Measured | None) -> None:
        """Take note of the tool that is held: its diameter changes nothing, for the paper's torque knows of none."""

    def update(self, frame: Frame) -> Reading:
        """Return what the frame says; a frame that says nothing comes back with the reasons."""
        found = self._difference(frame)
        return found if isinstance(found, Reading) else self._read(found, self._matcher.match(found.difference))

    def quickly(self, frame: Frame) -> Reading | None:
        """Return what `update` returns, or None where that takes more than some milliseconds: then call `update`."""
        found = self._difference(frame)
        if isinstance(found, Reading):
            return found
        return None

    def _difference(self, frame: Frame) -> "_Difference | Reading":
        """Return what is to be matched, or why there is nothing; only then the frame has been taken in."""
        trouble = _unusable(frame)
        if trouble:
            return Reading(why=trouble)
        if not self._baseline.complete:
            self._baseline.add(frame.channels)
            return Reading(why=(f"taking the homogeneous frame, {self._baseline.taken} of {self._baseline.wanted}",))
        before = self._latest
        if before and frame.t_mid_ns - before[-1].t_mid_ns > self._longest_gap_ns:
            before = ()
        latest = (*before, frame)[-self._average_frames :]
        mean = frame.channels if len(latest) == 1 else np.mean([each.channels for each in latest], axis=0)
        difference = mean - self._baseline.homogeneous
        silent = signal_above_noise(difference, self._baseline.noise_of_difference(len(latest)))
        if silent is not None:
            self._latest = latest
            return Reading(why=(silent.why,))
        return _Difference(difference, latest)

    def _read(self, found: "_Difference", match: Match) -> Reading:
        self._latest = latest = found.latest
        middle_ns = sum(each.t_mid_ns for each in latest) // len(latest)
        torque_nm, diameter_mm, why = self._calibrated(match)
        return Reading(
            match=match,
            torque_nm=torque_nm,
            diameter_mm=diameter_mm,
            why=why,
            lag_ns=latest[-1].t_mid_ns - middle_ns,
            difference=found.difference,
        )

    def heatmap(self, reading: Reading) -> FloatArray | None:
        """Return the (K, S) scores of what a reading was made from, None where nothing was matched.

        It may take many milliseconds, which are spent only where somebody looks at it.
        """
        if reading.heatmap is not None or reading.difference is None:
            return reading.heatmap
        return self._matcher.heatmap(reading.difference)

    def _calibrated(self, match: Match) -> tuple[Interval | None, Interval | None, tuple[str, ...]]:
        """Return torque and diameter of a match, or what speaks against them."""
        calibration = self._calibration
        if calibration is None:
            return None, None, ("no calibration is configured: k and sigma have no torque",)
        if calibration.torque_fit is None:
            return None, None, ("the calibration was made without torques: sigma has no torque",)
        why = calibration.out_of_range(match.k, match.sigma)
        if why:
            return None, None, why
        diameter = None if calibration.diameter_fit is None else calibration.diameter(match.k)
        return calibration.torque(match.sigma), diameter, ()


def _unusable(frame: Frame) -> tuple[str, ...]:
    if frame.repeated:
        return ("the board sent the same frame again",)
    if frame.unusable > LARGEST_UNUSABLE_SHARE * frame.channels.size:
        return (
            f"{frame.unusable} of {frame.channels.size} channels are saturated or dead; "
            "look at the ribbon cable and the gel's contact with the electrodes",
        )
    return ()
