"""Fits a skin's calibration to a table of recorded resistances and forces.

The belt's two plays turn the forces into the tension at the gauges, friction included, and leave the coefficient of
friction and the curve to be fitted. The load turns with the skin: the stretched gauge gives its angle.
"""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.optimize import minimize_scalar, nnls
from scipy.special import stdtrit

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.skin.calibration import Resistance, SkinCalibration, slack_at, turned_rad
from shearloop.estimation.skin.membrane import PAPER_SECTION, UNSTRETCHED, Belt
from shearloop.estimation.skin.plane_strain import gauge_depth_mm
from shearloop.files import open_file
from shearloop.models import validated
from shearloop.words import counted

# The paper's response is straight up to here and rises faster beyond.
LINEAR_TO_N = 1.2
UNLOADED_BELOW_N = 0.02
MAX_FRICTION = 0.5
# A table that leaves the friction coefficient less certain than this does not determine it.
FRICTION_STD = 0.02
MIN_ROWS_PER_PIECE, MAX_PIECES = 8, 6
NOT_RISING = (
    "The response does not rise with the shear force everywhere; check that R1 is the gauge stretched by a positive "
    "shear force, and that no gauge is broken."
)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationTable:
    """Recorded rows in the order of recording: resistances in Ω, forces in N, each (rows,)."""

    r1_ohm: FloatArray
    r2_ohm: FloatArray
    shear_n: FloatArray
    normal_n: FloatArray


class _Row(BaseModel):
    """A row of a recorded table."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    # Larger numbers have another unit: mΩ, or mN. No source of ours feeds such a gauge, and no skin bears such a force.
    r1_ohm: Resistance = Field(le=10_000)
    r2_ohm: Resistance = Field(le=10_000)
    shear_n: float = Field(ge=-100, le=100)
    # A load cell at rest may read slightly negative; a skin cannot be pulled off its core.
    normal_n: float = Field(ge=-0.05, le=100)


def read_table(path: Path) -> CalibrationTable:
    """Return the rows of a CSV file with these columns; raises CalibrationError with the line and column at fault."""
    try:
        # Spreadsheets begin a file with a mark of its encoding.
        with open_file(path) as raw, io.TextIOWrapper(raw, newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, restkey="a value without a column")
            names = reader.fieldnames or ()
            for name in {name for name in names if names.count(name) > 1}:
                raise CalibrationError(f"{path}: {names.count(name)} columns are called {name!r}; keep the right one.")
            if any(";" in name for name in names):
                raise CalibrationError(
                    f"{path}: semicolons separate the columns; write commas, and points in the numbers."
                )
            rows = [validated(row, _Row, f"{path}, line {reader.line_num}", CalibrationError) for row in reader]
    except OSError as error:
        raise CalibrationError(f"{path}: the table cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: the table cannot be read: {error}.") from error
    if not rows:
        raise CalibrationError(f"{path}: the table has no rows; its columns are {', '.join(_Row.model_fields)}.")
    return CalibrationTable(*np.array([list(row.model_dump().values()) for row in rows]).T)


def fit_calibration(table: CalibrationTable, *, friction: float | None = None) -> SkinCalibration:
    """Return the least-squares calibration of a table; friction is fitted too unless given.

    Raises CalibrationError where the table has too few rows, no row at rest or does not determine friction, and where
    the response does not rise with the force.
    """
    changes, loading = _changes(table)
    response = changes[:, 0] - changes[:, 1]
    loaded, idle = loading > 0, loading == 0
    turned = np.sign(response) * turned_rad(changes.max(axis=1))
    forces = np.column_stack([loading, table.shear_n, table.normal_n, turned])[loaded]
    nominal = _tensions(forces, PAPER_SECTION.friction if friction is None else friction)
    upper, lower = _knots(nominal), _knots(-nominal)
    kept = (len(upper) > 0) | (nominal <= LINEAR_TO_N)
    kept &= (len(lower) > 0) | (-nominal <= LINEAR_TO_N)
    curve = _CurveFit(forces, kept, response[loaded][kept], upper, lower)
    if curve.freedom < 3:
        raise CalibrationError(
            f"{counted(len(curve.response), 'row')} under load cannot carry "
            f"{counted(1 + len(upper) + len(lower), 'piece')} of curve and an "
            "interval; record more."
        )
    # The response must go with the tension, not against it.
    if float(nominal[kept] @ curve.response) <= 0.0:
        raise CalibrationError(NOT_RISING)
    if friction is None:
        friction = curve.best_friction()
    knots, responses, half_width = curve.fit(friction)
    slack, slack_half_width = _fit_slack(changes[loaded][kept], responses)
    found = SkinCalibration(
        friction=friction,
        gauge_angle_deg=math.degrees(PAPER_SECTION.gauge_angle_rad),
        linear_to_n=LINEAR_TO_N,
        tension_n=tuple(knots.tolist()),
        response=tuple(responses.tolist()),
        response_half_width=half_width,
        slack=tuple(slack.tolist()),
        slack_half_width=slack_half_width,
        rows=len(curve.response),
        rows_beyond=int((~kept).sum()),
        rest_ohm=(float(table.r1_ohm[idle].mean()), float(table.r2_ohm[idle].mean())),
        gauge_depth_mm=None,
    )
    return found.model_copy(update={"gauge_depth_mm": gauge_depth_mm(PAPER_SECTION, found.slack_ratio)})


def _fit_slack(changes: FloatArray, knots: FloatArray) -> tuple[FloatArray, float]:
    """Return the slack gauge's change at the curve's responses (knots,), and ± its 95 % interval.

    `changes` (rows, 2) has a column for each gauge.
    """
    response, slack = changes[:, 0] - changes[:, 1], changes.min(axis=1)
    hats = np.eye(len(knots))
    design = np.array([[slack_at(at, knots.tolist(), hat) for hat in hats.tolist()] for at in response.tolist()])
    values = np.linalg.lstsq(design, slack)[0]
    left, freedom = slack - design @ values, len(slack) - len(knots)
    return values, float(stdtrit(freedom, 0.975)) * math.sqrt(float(left @ left) / freedom)


def _changes(table: CalibrationTable) -> tuple[FloatArray, IntArray]:
    """Return both gauges' ΔR/R₀ (rows, 2) and each row's loading, counted from 1; 0 for rows without load.

    Each loading begins with rows without load; their mean resistances normalise it, as in the paper.
    """
    idle = (abs(table.shear_n) <= UNLOADED_BELOW_N) & (abs(table.normal_n) <= UNLOADED_BELOW_N)
    if not idle.size or not idle[0]:
        raise CalibrationError(
            f"The table must begin with a row without load (both forces below {UNLOADED_BELOW_N} N): "
            "it gives the resistances at rest."
        )
    loading = np.cumsum(idle & ~np.concatenate([[False], idle[:-1]]))
    changes = np.empty((len(idle), 2))
    for number in range(1, loading[-1] + 1):
        rows = loading == number
        for gauge, ohm in enumerate((table.r1_ohm, table.r2_ohm)):
            changes[rows, gauge] = ohm[rows] / ohm[rows & idle].mean() - 1.0
    return changes, np.where(idle, 0, loading)


def _tensions(forces: FloatArray, friction: float) -> FloatArray:
    """Return the net tension (rows,) at the gauges, in N, for rows (loading, shear force, normal force, load's angle).

    Each loading starts from the unstretched skin.
    """
    belt = Belt(friction, PAPER_SECTION.gauge_angle_rad)
    state, current, found = UNSTRETCHED, 0.0, []
    for loading, *load in forces.tolist():
        state = belt.step(state if loading == current else UNSTRETCHED, *load)
        current = loading
        found.append(state.gauge_tension_1_n - state.gauge_tension_2_n)
    return np.array(found)


@dataclass(frozen=True, slots=True, eq=False)
class _CurveFit:
    """Response against tension in straight pieces: one through the origin, others beyond its ends.

    forces are rows as `_tensions` takes them; response (m,) belongs to the rows kept; upper and lower are the tensions
    where the pieces beyond begin.
    """

    forces: FloatArray
    kept: BoolArray
    response: FloatArray
    upper: FloatArray
    lower: FloatArray

    @property
    def freedom(self) -> int:
        """The degrees of freedom of the residuals."""
        return len(self.response) - 1 - len(self.upper) - len(self.lower)

    def squares(self, friction: float) -> float:
        """Return the sum of squared residuals with the best curve for this friction."""
        return self._best_curve(friction)[3] ** 2

    def fit(self, friction: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the best curve's knots (N) and responses there, and the half width of its prediction interval."""
        tension, design, slopes, distance = self._best_curve(friction)
        ends = min(float(tension.min()), 0.0), max(float(tension.max()), 0.0)
        knots = np.concatenate([[ends[0]], -self.lower[::-1], self.upper, [ends[1]]])
        if not (slopes > 0).all() or not (np.diff(knots) > 0).all():
            raise CalibrationError(NOT_RISING)
        leverage = (np.linalg.qr(design).Q ** 2).sum(axis=1).max()
        scatter = distance / math.sqrt(self.freedom)
        half_width = float(stdtrit(self.freedom, 0.975)) * scatter * math.sqrt(1 + leverage)
        return knots, self._design(knots) @ slopes, half_width

    def best_friction(self) -> float:
        """Return the friction of the least squares; raises CalibrationError where another one is about as good."""
        coarse = np.linspace(0.0, MAX_FRICTION, 26)
        best = coarse[int(np.argmin([self.squares(mu) for mu in coarse]))]
        bounds = max(best - coarse[1], 0.0), min(best + coarse[1], MAX_FRICTION)
        friction = float(minimize_scalar(self.squares, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)
        # A wrong friction must make the fit visibly worse.
        least = self.squares(friction)
        neighbours = [mu for mu in (friction - FRICTION_STD, friction + FRICTION_STD) if mu >= 0]
        worse = min(map(self.squares, neighbours)) - least
        if worse <= max(least / max(self.freedom, 1), 1e-9 * float(self.response @ self.response)):
            raise CalibrationError(
                "The table does not determine the friction of the skin; load it under more normal force, load and "
                "unload it, or give the coefficient (--friction)."
            )
        return friction

    def _best_curve(self, friction: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Return the rows' tensions and pieces, the pieces' slopes, and the norm of the residuals."""
        tension = _tensions(self.forces, friction)[self.kept]
        design = self._design(tension)
        slopes, distance = nnls(design, self.response)
        return tension, design, slopes, float(distance)

    def _design(self, tension: FloatArray) -> FloatArray:
        """Return the part of each tension within each piece; the last pieces are open."""
        columns = [np.clip(tension, -LINEAR_TO_N, LINEAR_TO_N)]
        for sign, knots in ((1.0, self.upper), (-1.0, self.lower)):
            widths = np.append(np.diff(knots), math.inf)
            columns += [sign * np.clip(sign * tension - at, 0.0, w) for at, w in zip(knots, widths, strict=False)]
        return np.column_stack(columns)


def _knots(tension: FloatArray) -> FloatArray:
    """Return where the pieces beyond the straight one begin: as many as the rows support, with equal fractions."""
    beyond = np.sort(tension[tension > LINEAR_TO_N])
    pieces = min(MAX_PIECES, len(beyond) // MIN_ROWS_PER_PIECE)
    if not pieces:
        return np.empty(0)
    begins = beyond[np.arange(1, pieces) * len(beyond) // pieces]
    return np.unique(np.append(LINEAR_TO_N, begins))
