"""Estimators that were fitted to recordings, live: frames in, readings out. A plain object without I/O or clock.

A `EstimatorSession` of `shearloop.bank.estimation` does the work; around it stand the board's flags, the operator's
zero, and, where a
bank is configured, the place in the bank that the paper's method would name.
"""

from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.matching import Match
from shearloop.bank.eit.polynomial import Interval
from shearloop.bank.estimation import Calibration, Estimate, EstimatorSession, Measured, TactileFrame
from shearloop.daemon.sensing.estimator import Matcher, Reading
from shearloop.drivers.eit_kit import Frame

# These take a millisecond, always the same few products; the others search a bank or reconstruct.
QUICK = ("regression", "fused")


@dataclass(frozen=True, slots=True)
class Scoring:
    """What scores differences against a bank, for heatmaps and for k and sigma."""

    matcher: Matcher
    model: str


class TrackedEstimator:
    """Turns the frames of one fingertip, or of both together, into readings, one for each frame or pair, in order."""

    def __init__(
        self,
        calibration: Calibration,
        bank: Bank | None,
        scoring: Scoring | None,
        *,
        baseline_frames: int,
        period_s: float = np.inf,
    ) -> None:
        """Begin a session; raises CalibrationError for a bank that is needed and missing, or another one.

        Of a board whose frame period in s is known, frames that are missing are seen from the first one on.
        """
        self.sides = calibration.sides
        self.name = calibration.estimator
        # One of diameters alone does not.
        self.measures_torque = calibration.torque is not None
        self.word = calibration.word
        self.model = scoring.model if scoring is not None else ""
        self._tracker = EstimatorSession(calibration, bank, period_s=period_s)
        self._scoring = scoring
        self._baseline_frames = baseline_frames
        self._is_quick = calibration.estimator in QUICK
        self._all_usable = np.ones((len(self.sides), N_CHANNELS), dtype=np.bool_)
        # Frames that the tracker has taken in, with what it made of them, while their match is left to a thread.
        self._unmatched: tuple[tuple[Frame, ...], Estimate, FloatArray | None] | None = None

    @property
    def grids(self) -> tuple[FloatArray, FloatArray] | None:
        """The k and the sigma of the cells that are scored, None without a bank."""
        return (self._scoring.matcher.k_grid, self._scoring.matcher.sigma_grid) if self._scoring is not None else None

    @property
    def baseline_complete(self) -> bool:
        """Whether no more frames are wanted for the homogeneous one."""
        return not self._tracker.taking_idle

    def tare(self) -> None:
        """Take a new homogeneous frame from the frames to come, which are of an untouched fingertip."""
        self._tracker.take_idle(self._baseline_frames)

    def hold(self, tool: Measured | None) -> None:
        """Take note of the diameter of the tool that is held from now on: on another one the torque is another."""
        self._tracker.hold(tool)

    def quickly(self, *frames: Frame) -> Reading | None:
        """Return what `update` returns, or None where that takes more than some milliseconds: then call `update`."""
        return self._read(frames, at_once=True) if self._is_quick else None

    def update(self, *frames: Frame) -> Reading:
        """Return what the frames of one moment say, one a side; those that say nothing come back with the reasons."""
        reading = self._read(frames, at_once=False)
        if reading is None:
            raise AssertionError("only what has to be done at once may be left undone")
        return reading

    def _read(self, frames: tuple[Frame, ...], *, at_once: bool) -> Reading | None:
        if any(frame.repeated for frame in frames):
            return Reading(why=("the board sent the same frame again",))
        estimate, first = self._estimate(frames)
        if not estimate.valid:
            return Reading(why=estimate.why, difference=first)
        match: Match | None = None
        if estimate.k is not None and estimate.sigma is not None and estimate.score is not None:
            match = Match(estimate.k, estimate.sigma, (0, 0), estimate.score, estimate.runner_up, None)
        elif self._scoring is not None and first is not None and first.any():
            matcher = self._scoring.matcher
            match = None if at_once else matcher.match(first)
            if match is None:
                # The session has moved on by this frame already.
                self._unmatched = frames, estimate, first
                return None
        return Reading(
            match,
            torque_nm=_interval(estimate.torque_nm, estimate.torque_low_nm, estimate.torque_high_nm),
            diameter_mm=_interval(estimate.diameter_mm, estimate.diameter_low_mm, estimate.diameter_high_mm),
            difference=first,
        )

    def _estimate(self, frames: tuple[Frame, ...]) -> tuple[Estimate, FloatArray | None]:
        """Return the tracker's estimate, and the first side's difference; the same again of frames seen last."""
        if self._unmatched is not None:
            seen, estimate, first = self._unmatched
            self._unmatched = None
            if all(one is other for one, other in zip(seen, frames, strict=True)):
                return estimate, first
        usable = self._all_usable
        if any(frame.unusable for frame in frames):
            usable = np.array([~(frame.saturated | frame.dead) for frame in frames])
        t_s = sum(frame.t_mid_ns for frame in frames) / len(frames) / 1e9
        estimate = self._tracker.estimate(TactileFrame.of(t_s, np.array([frame.channels for frame in frames]), usable))
        difference = self._tracker.difference
        return estimate, None if difference is None else difference[0]

    def heatmap(self, reading: Reading) -> FloatArray | None:
        """Return the (K, S) scores of the first side's difference; None without a bank, or where there is none."""
        if self._scoring is None or reading.difference is None or not reading.difference.any():
            return None
        return self._scoring.matcher.heatmap(reading.difference)


def _interval(value: float | None, low: float | None, high: float | None) -> Interval | None:
    return None if value is None or low is None or high is None else Interval(value, low, high)
