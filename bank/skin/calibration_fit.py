"""Fitting a skin's calibration to a recorded table of resistances and forces.

The membrane's two plays take the recorded forces to the tension at the gauges, friction included, whichever way the
load went; what is left to learn is the coefficient of friction and one rising curve from tension to response.
"""

import math

import numpy as np
from scipy.optimize import minimize_scalar, nnls
from scipy.stats import t as student

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin import gauge
from shearloop.bank.skin.calibration import CalibrationTable, SkinCalibration
from shearloop.bank.skin.closed_form import gauge_angle_rad
from shearloop.bank.skin.membrane import UNSTRETCHED, Membrane
from shearloop.bank.skin.section import PAPER_SECTION

# The paper's response is straight up to here and rises faster beyond.
LINEAR_TO_N = 1.2
UNLOADED_BELOW_N = 0.02
MOST_FRICTION = 0.5
# A table that leaves the friction coefficient less certain than this says nothing about it.
FRICTION_STD = 0.02
NOT_RISING = (
    "The response does not rise with the shear force everywhere; check that R1 is the gauge stretched by a positive "
    "shear force, and that no gauge is broken."
)
FEWEST_PER_PIECE, MOST_PIECES = 8, 6


def responses_of_table(
    table: CalibrationTable, unloaded_below_n: float = UNLOADED_BELOW_N
) -> tuple[FloatArray, IntArray]:
    """Return the (rows,) responses and, per row, the number of its loading, counted from 1; 0 for rows without load.

    Each loading begins with rows without load, whose mean resistances normalise it, as in the paper.
    """
    idle = (abs(table.shear_n) <= unloaded_below_n) & (abs(table.normal_n) <= unloaded_below_n)
    if not idle.size or not idle[0]:
        raise CalibrationError(
            f"The table must begin with a row without load (both forces below {unloaded_below_n} N): "
            "it gives the resistances at rest."
        )
    begins = idle & ~np.concatenate([[False], idle[:-1]])
    loading = np.cumsum(begins)
    response = np.empty(len(idle))
    for number in range(1, loading[-1] + 1):
        rows = loading == number
        at_rest = rows & idle
        r1_at_rest, r2_at_rest = float(table.r1_ohm[at_rest].mean()), float(table.r2_ohm[at_rest].mean())
        response[rows] = gauge.response(table.r1_ohm[rows], table.r2_ohm[rows], r1_at_rest, r2_at_rest)
    return response, np.where(idle, 0, loading)


def fit_calibration(
    table: CalibrationTable,
    *,
    friction: float | None = None,
    gauge_angle_deg: float = math.degrees(gauge_angle_rad(PAPER_SECTION)),
    linear_to_n: float = LINEAR_TO_N,
    unloaded_below_n: float = UNLOADED_BELOW_N,
) -> SkinCalibration:
    """Return the calibration that fits a table best in least squares; friction is fitted too unless given.

    Raises CalibrationError where the table has too few rows, no row at rest, says nothing about friction, or where
    the response does not rise with the force.
    """
    response, loading = responses_of_table(table, unloaded_below_n)
    rows = _Rows(table, response, loading, math.radians(gauge_angle_deg))
    nominal = rows.tensions(PAPER_SECTION.friction if friction is None else friction)
    upper, lower = _knots(nominal, linear_to_n), _knots(-nominal, linear_to_n)
    kept = (len(upper) > 0) | (nominal <= linear_to_n)
    kept &= (len(lower) > 0) | (-nominal <= linear_to_n)
    curve = _Curve(rows, kept, linear_to_n, upper, lower)
    if curve.rows < curve.pieces + 3:
        raise CalibrationError(
            f"{curve.rows} rows under load cannot carry {curve.pieces} pieces of curve and an interval; record more."
        )
    if not curve.rises(PAPER_SECTION.friction if friction is None else friction):
        raise CalibrationError(NOT_RISING)
    if friction is None:
        friction = _fit_friction(curve)
    idle = loading == 0
    rest_ohm = float(table.r1_ohm[idle].mean()), float(table.r2_ohm[idle].mean())
    return curve.calibration(friction, int((~kept).sum()), rest_ohm)


class _Rows:
    """The rows under load, and the tension that the membrane gives each of them."""

    def __init__(
        self, table: CalibrationTable, response: FloatArray, loading: IntArray, gauge_angle_rad: float
    ) -> None:
        used = loading > 0
        self.response = response[used]
        self.gauge_angle_rad = gauge_angle_rad
        self._forces = list(
            zip(loading[used].tolist(), table.shear_n[used].tolist(), table.normal_n[used].tolist(), strict=True)
        )

    def tensions(self, friction: float) -> FloatArray:
        """Net tension (rows,) at the gauges, in N; each loading starts from the unstretched skin."""
        membrane = Membrane(1.0, friction, self.gauge_angle_rad, 1.0)
        state, current, found = UNSTRETCHED, 0, []
        for loading, shear_n, normal_n in self._forces:
            if loading != current:
                state, current = UNSTRETCHED, loading
            state = membrane.step(state, shear_n, normal_n)
            found.append(state.gauge_tension_1_n - state.gauge_tension_2_n)
        return np.array(found)


class _Curve:
    """Response against tension in straight pieces: one through the origin, others beyond its ends."""

    def __init__(self, rows: _Rows, kept: BoolArray, linear_to_n: float, upper: FloatArray, lower: FloatArray) -> None:
        self._rows, self._kept = rows, kept
        self._linear_to_n, self._upper, self._lower = linear_to_n, upper, lower
        self.rows = int(kept.sum())
        self.pieces = 1 + len(upper) + len(lower)

    def squares(self, friction: float) -> float:
        """The sum of squared residuals with the best curve for this friction."""
        return float(nnls(self._design(self._tensions(friction)), self._response)[1] ** 2)

    def rises(self, friction: float) -> bool:
        """Whether the response goes with the tension at all, and not against it."""
        return float(self._tensions(friction) @ self._response) > 0.0

    @property
    def total_squares(self) -> float:
        return float(self._response @ self._response)

    def calibration(self, friction: float, rows_beyond: int, rest_ohm: tuple[float, float]) -> SkinCalibration:
        tension = self._tensions(friction)
        design = self._design(tension)
        slopes, distance = nnls(design, self._response)
        ends = min(float(tension.min()), 0.0), max(float(tension.max()), 0.0)
        knots = np.concatenate([[ends[0]], -self._lower[::-1], self._upper, [ends[1]]])
        if not (slopes > 0).all() or not (np.diff(knots) > 0).all():
            raise CalibrationError(NOT_RISING)
        leverage = (np.linalg.qr(design).Q ** 2).sum(axis=1).max()
        freedom = self.rows - self.pieces
        scatter = distance / math.sqrt(freedom)
        return SkinCalibration(
            friction=friction,
            gauge_angle_deg=math.degrees(self._rows.gauge_angle_rad),
            linear_to_n=self._linear_to_n,
            tension_n=tuple(knots.tolist()),
            response=tuple((self._design(knots) @ slopes).tolist()),
            response_half_width=float(student.ppf(0.975, freedom)) * scatter * math.sqrt(1 + leverage),
            rows=self.rows,
            rows_beyond=rows_beyond,
            rest_ohm=rest_ohm,
        )

    @property
    def _response(self) -> FloatArray:
        return self._rows.response[self._kept]

    def _tensions(self, friction: float) -> FloatArray:
        return self._rows.tensions(friction)[self._kept]

    def _design(self, tension: FloatArray) -> FloatArray:
        columns = [np.clip(tension, -self._linear_to_n, self._linear_to_n)]
        columns += _hinges(tension, self._upper) + [-column for column in _hinges(-tension, self._lower)]
        return np.column_stack(columns)


def _hinges(tension: FloatArray, knots: FloatArray) -> list[FloatArray]:
    """What of the tension lies within each piece; the last one is open."""
    widths = np.append(np.diff(knots), math.inf)
    return [np.clip(tension - knot, 0.0, width) for knot, width in zip(knots, widths, strict=False)]


def _knots(tension: FloatArray, linear_to_n: float) -> FloatArray:
    """Where the pieces beyond the straight one begin: as many as the rows there can carry, each with equal shares."""
    beyond = np.sort(tension[tension > linear_to_n])
    pieces = min(MOST_PIECES, len(beyond) // FEWEST_PER_PIECE)
    if not pieces:
        return np.empty(0)
    begins = beyond[np.arange(1, pieces) * len(beyond) // pieces]
    return np.unique(np.append(linear_to_n, begins))


def _fit_friction(curve: _Curve) -> float:
    coarse = np.linspace(0.0, MOST_FRICTION, 26)
    best = coarse[int(np.argmin([curve.squares(mu) for mu in coarse]))]
    bounds = max(best - coarse[1], 0.0), min(best + coarse[1], MOST_FRICTION)
    friction = float(minimize_scalar(curve.squares, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)
    # Were friction wrong by FRICTION_STD, would the fit be visibly worse?
    least = curve.squares(friction)
    neighbours = [mu for mu in (friction - FRICTION_STD, friction + FRICTION_STD) if mu >= 0]
    worse = min(map(curve.squares, neighbours)) - least
    if worse <= max(least / max(curve.rows - curve.pieces, 1), 1e-9 * curve.total_squares):
        raise CalibrationError(
            "The table says nothing about the friction of the skin; load it under more normal force, load and "
            "unload it, or give the coefficient (--friction)."
        )
    return friction
