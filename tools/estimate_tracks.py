"""Sends every frame of a series through a session, as live: an estimate for each frame, and the time that it took."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.estimation import Calibration, Estimate, FrameSeries, Session

UNITS: Final = {"torque": "nm", "diameter": "mm"}
# Of the names of an estimate and of the ends of its interval.
ENDS: Final = ("", "_low", "_high")


@dataclass(frozen=True, slots=True, eq=False)
class EstimateTrack:
    """One series with an estimate per frame, and the time that each took."""

    series: FrameSeries
    estimates: tuple[Estimate, ...]
    latency_ms: FloatArray
    # The torque (n,) by the calibration's mean twist at the same phase, without a sensor.
    profile_nm: FloatArray | None = None
    # Why the held tool leaves no torque, though frames may have a diameter and be valid; empty where it does not.
    why_no_torque: str = ""

    def since(self, first_frame: int) -> "EstimateTrack":
        """Return the part from a frame of the recording on."""
        return self.between(first_frame - self.series.first_frame, len(self.estimates))

    def between(self, first: int, stop: int) -> "EstimateTrack":
        """Return rows `first` to `stop`."""
        profile_nm = None if self.profile_nm is None else self.profile_nm[first:stop]
        return replace(
            self,
            series=self.series.between(first, stop),
            estimates=self.estimates[first:stop],
            latency_ms=self.latency_ms[first:stop],
            profile_nm=profile_nm,
        )

    @property
    def without_torque(self) -> int:
        """The number of valid frames without a torque because of the held tool."""
        return (
            sum(estimate.valid and estimate.torque_nm is None for estimate in self.estimates)
            if self.why_no_torque
            else 0
        )


def estimate_series(calibration: Calibration, series: FrameSeries, bank: Bank | None = None) -> EstimateTrack:
    """Estimate every frame of a series in order, as live; raises CalibrationError for a series of other sides."""
    chosen = series.select_sides(calibration.sides)
    session = Session(calibration, bank, period_s=chosen.period_s)
    session.set_tool(chosen.tool_mm)
    estimates, latency = [], []
    for frame in chosen.frames():
        begun = time.perf_counter()
        estimates.append(session.estimate(frame))
        latency.append(1e3 * (time.perf_counter() - begun))
    profile_nm = None if calibration.profile is None else calibration.profile.predict(chosen)
    return EstimateTrack(chosen, tuple(estimates), np.array(latency), profile_nm, session.why_no_torque)


def estimate_in_worker(shared: tuple[Calibration, str | None], series: FrameSeries) -> EstimateTrack:
    """Return `estimate_series` for a calibration and the bank's path, which the worker opens."""
    calibration, path = shared
    return estimate_series(calibration, series, None if path is None else Bank.open(path))


def values_of(estimates: Sequence[Estimate], quantity: str = "torque") -> FloatArray:
    """Return estimate and the interval's ends (3, n) in N·m or mm, NaN without an estimate."""
    names = [f"{quantity}{end}_{UNITS[quantity]}" for end in ENDS]
    # None becomes NaN.
    return np.array([[getattr(estimate, name) for estimate in estimates] for name in names], dtype=np.float64)
