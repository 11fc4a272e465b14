"""A reader turns the features of a frame into one value with its interval."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from bank.errors import CalibrationError
from bank.estimators.heads import (
    FIRST_ORIGIN,
    Censored,
    Curve,
    Ridge,
    Rows,
    best_strength,
    later_origins,
    later_splits,
    left_out_blocks,
)
from bank.estimators.intervals import Intervals
from bank.estimators.values import FloatArray

Head: TypeAlias = Ridge | Censored | Curve
HeadOf: TypeAlias = Callable[[FloatArray, FloatArray, float], Head]

# Penalties to choose from, in units of the features' sum of squares.
STRENGTHS = tuple(10.0**power for power in range(-6, 1))
# Future data lies further from the past than one part of a recording from the next, unless what was left out was the
# future itself.
_INFLATION = 1.1
_LEAST_FRAMES = 8
# Origins with fewer frames before them tell how bad a calibration of few frames is, not this one.
_LEAST_BEFORE_ORIGIN = 12
# No interval is narrower than this share of the calibrated range: a load cell has noise too.
_LEAST_HALF_WIDTH = 1e-3
# Values this far beyond the calibrated range, in spans of it, are extrapolated and not believed.
_LARGEST_BEYOND = 0.35
# Features this many times larger than any at calibration are of something else.
_LARGEST_REACH = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
    """A head with its intervals, the range of values and the reach of features that it was calibrated on."""

    head: Head
    intervals: Intervals
    low: float
    high: float
    mean_feature: FloatArray
    reach: FloatArray

    def read(self, features: FloatArray, usable_share: float = 1.0) -> tuple[float, float]:
        """Return the value of (d,) features and half the width of its 95 % interval.

        With a share of the channels unusable the rest have to carry the noise of all: the interval grows by the root.
        """
        raw = float(self.head.predict(features[None])[0])
        half = self.intervals.half_width(raw) / float(np.sqrt(max(usable_share, 0.1)))
        return _shown(self.head, raw), half

    def refuse(self, value: float, features: FloatArray, name: str, unit: str) -> tuple[str, ...]:
        """Return the reasons why a value is beyond what was calibrated."""
        beyond = _LARGEST_BEYOND * (self.high - self.low)
        if not self.low - beyond <= value <= self.high + beyond:
            return (
                f"the {name} would be {value:.3g} {unit}, beyond the calibrated {self.low:.3g} to "
                f"{self.high:.3g} {unit}",
            )
        if len(self.reach) and (np.abs(features - self.mean_feature) > _LARGEST_REACH * self.reach).any():
            return ("the frame moves further or faster than any at calibration",)
        return ()


def fit_reader(
    features: FloatArray,
    values: FloatArray,
    head_of: HeadOf,
    *,
    strengths: tuple[float, ...] = STRENGTHS,
    limit_reach: bool = False,
    edges: tuple[float, ...] = (),
    rolling: bool = False,
) -> Reader:
    """Fit a head to (n, d) features and (n,) values in time order, and intervals to the residuals of what was left out.

    Left out are blocks in turn, or with `rolling` all that comes later than each of a row of origins: where values
    drift and there are many repeats, these are what the future will be.
    Raises CalibrationError where the data does not determine them.
    """
    if len(values) < _LEAST_FRAMES or np.ptp(values) == 0:
        raise CalibrationError(
            f"{len(values)} frames with values between {np.min(values, initial=np.inf):.3g} and "
            f"{np.max(values, initial=-np.inf):.3g} determine no calibration; record more, at different loads"
        )

    def judged(strength: float, past: Rows, future: Rows) -> tuple[FloatArray, FloatArray]:
        return _judged(features, values, head_of, strength, past, future)

    # Of the candidates the one that does best on what comes later …
    strength = strengths[0]
    if len(strengths) > 1:
        strength = _best(features, values, head_of, strengths)
    # … and how far it goes astray on what was left out.
    rolling = rolling and FIRST_ORIGIN * len(values) >= _LEAST_BEFORE_ORIGIN
    left_out = later_origins(len(values)) if rolling else left_out_blocks(len(values))
    found = [judged(strength, past, future) for past, future in left_out]
    predicted, residuals = (np.concatenate([pair[i] for pair in found]) for i in (0, 1))
    head = head_of(features, values, strength)
    if isinstance(head, Censored):
        edges = (-head.sigma, 0.0, 0.4 * float(np.abs(values).max()))
    inflation = 1.0 if rolling or isinstance(head, Curve) else _INFLATION
    centre = features.mean(axis=0)
    reach = np.abs(features - centre).max(axis=0) if limit_reach else np.zeros(0)
    return Reader(
        head,
        Intervals.fit(predicted, residuals, edges, inflation, _LEAST_HALF_WIDTH * float(np.ptp(values))),
        float(values.min()),
        float(values.max()),
        centre,
        reach,
    )


def error_on_later(features: FloatArray, values: FloatArray, head_of: HeadOf, strengths: tuple[float, ...]) -> float:
    """Return the mean squared error on parts later than those fitted to, with the strength that makes it least."""
    strength = _best(features, values, head_of, strengths)
    found = [
        float((_judged(features, values, head_of, strength, past, future)[1] ** 2).mean())
        for past, future in _splits(values)
    ]
    return float(np.mean(found))


def _splits(values: FloatArray) -> list[tuple[Rows, Rows]]:
    return [(past, future) for past, future in later_splits(len(values)) if np.ptp(values[past]) > 0]


def _best(features: FloatArray, values: FloatArray, head_of: HeadOf, strengths: tuple[float, ...]) -> float:
    def error(strength: float, past: Rows, future: Rows) -> float:
        return float((_judged(features, values, head_of, strength, past, future)[1] ** 2).mean())

    return best_strength(strengths, error, _splits(values))


def _judged(
    features: FloatArray, values: FloatArray, head_of: HeadOf, strength: float, past: Rows, future: Rows
) -> tuple[FloatArray, FloatArray]:
    """Return what a head fitted to the past says of the future, and how far that is from the truth."""
    head = head_of(features[past], values[past], strength)
    raw = head.predict(features[future])
    return raw, np.array([_shown(head, one) for one in raw]) - values[future]


def one_sided(torque_nm: FloatArray) -> bool:
    """Return whether a load cell was pushed from one side only, and free of load for a good part of the time."""
    largest = float(torque_nm[np.argmax(np.abs(torque_nm))])
    along = torque_nm * np.sign(largest)
    return bool(along.min() > -0.05 * abs(largest) and (along < 0.02 * abs(largest)).mean() > 0.2)


def _shown(head: Head, raw: float) -> float:
    """Return the value that a head's prediction means: no torque where the lever would not touch."""
    return head.sign * max(raw, 0.0) if isinstance(head, Censored) else raw
