"""A skin's calibration: friction, and one rising curve from tension at the gauges to response.

The curve is a straight line through the origin up to 1.2 N. Beyond, to 5 N and more, it has as many straight pieces as
the recorded data support. Rising straight pieces invert without iteration. The fit reads a table of recorded
resistances and forces: the membrane's two plays turn the forces into the tension at the gauges, friction included, and
leave the coefficient of friction and the curve to be fitted. The daemon loads calibrations, so scipy.optimize is
imported only to fit.
"""

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.special import stdtrit

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.membrane import (
    PAPER_SECTION,
    UNSTRETCHED,
    Direction,
    Membrane,
    ShearInterval,
    measured_response,
)
from shearloop.yaml_files import read_yaml, save_yaml, validated

FORMAT = "shearloop skin calibration 1"
_LISTS = ("tension_n", "response", "rest_ohm")
COLUMNS = ("r1_ohm", "r2_ohm", "shear_n", "normal_n")
# A load cell at rest may read slightly negative; a skin cannot be pulled off its core.
MAX_PULL_N = 0.05
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


@dataclass(frozen=True, slots=True)
class SkinCalibration:
    """Friction, and the curve from net tension at the gauges (N) to response, both rising.

    `response_half_width` is the 95 % prediction interval of one response. `rows` were fitted; `rows_beyond` lie outside
    the curve, too few for a piece of their own. `rest_ohm` are R₁ and R₂ without load, to judge a later zero by.
    """

    friction: float
    gauge_angle_deg: float
    linear_to_n: float
    tension_n: tuple[float, ...]
    response: tuple[float, ...]
    response_half_width: float
    rows: int
    rows_beyond: int
    rest_ohm: tuple[float, float]

    def __post_init__(self) -> None:
        """Refuse a curve that cannot be inverted."""
        if len(self.tension_n) != len(self.response) or len(self.tension_n) < 2:
            raise CalibrationError("The calibration's tension_n and response must be two lists of the same length.")
        for name, values in (("tension_n", self.tension_n), ("response", self.response)):
            if not (np.isfinite(values).all() and (np.diff(values) > 0).all()):
                raise CalibrationError(f"The calibration's {name} must rise from each value to the next.")
        if not (0 <= self.friction <= 1 and self.response_half_width >= 0):
            raise CalibrationError("The calibration's friction must lie in [0, 1], its response_half_width be ≥ 0.")
        if not (np.isfinite(self.rest_ohm).all() and min(self.rest_ohm) > 0):
            raise CalibrationError("The calibration's rest_ohm must be two resistances above 0.")

    @property
    def slope_per_n(self) -> float:
        """Response per N of tension at the gauges, in the middle piece of the curve: F/(EA)."""
        ends = np.clip([-self.linear_to_n, self.linear_to_n], self.tension_n[0], self.tension_n[-1])
        low, high = np.interp(ends, self.tension_n, self.response)
        return float((high - low) / (ends[1] - ends[0]))

    @property
    def prediction_half_width_n(self) -> float:
        """The 95 % prediction interval in N of shear, ±, at small forces."""
        capstan = math.exp(self.friction * math.radians(self.gauge_angle_deg))
        return self.response_half_width / self.slope_per_n * capstan

    def band(self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN) -> ShearInterval:
        """Return the shear forces (N) that friction leaves open for an exact response.

        Beyond the calibrated curve it is the band of the curve's end.
        """
        tension = float(np.interp(response, self.response, self.tension_n))
        return self._membrane.shear_from_tensions(tension, tension, tension, normal_n, direction)

    def shear_from_response(
        self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN, wider: float = 0.0
    ) -> ShearInterval:
        """Return the shear force (N) and its 95 % interval, which includes what friction leaves open.

        A known direction of loading takes the deadband out; an unknown one adds it to the interval. An end beyond the
        calibrated curve is infinite. `wider` is a further uncertainty of the response, either way.
        """
        half = self.response_half_width + wider
        low, high = response - half, response + half
        tension_low, tension, tension_high = np.interp([low, response, high], self.response, self.tension_n).tolist()
        if low < self.response[0]:
            tension_low = -math.inf
        if high > self.response[-1]:
            tension_high = math.inf
        return self._membrane.shear_from_tensions(tension_low, tension, tension_high, normal_n, direction)

    @property
    def _membrane(self) -> Membrane:
        return Membrane(1.0, self.friction, math.radians(self.gauge_angle_deg), 1.0)


def read_table(path: Path) -> CalibrationTable:
    """Return the rows of a CSV file with the columns r1_ohm, r2_ohm, shear_n, normal_n, in the order of recording.

    Raises CalibrationError with the file, and the line and column at fault.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if sorted(reader.fieldnames or ()) != sorted(COLUMNS):
                raise CalibrationError(
                    f"{path}: the first line is {','.join(reader.fieldnames or ())!r}; "
                    f"the columns must be {', '.join(COLUMNS)}."
                )
            rows = [_numbers(path, reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: the table cannot be read: {error}.") from error
    if not rows:
        raise CalibrationError(f"{path}: the table has no rows.")
    return CalibrationTable(*np.array(rows).T)


def _numbers(path: Path, line: int, row: dict[str | None, str]) -> list[float]:
    if None in row:
        raise CalibrationError(f"{path}, line {line}: there are more values than columns.")
    numbers = []
    for column in COLUMNS:
        try:
            number = float(row[column] or "")
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or (column.endswith("_ohm") and number <= 0):
            raise CalibrationError(f"{path}, line {line}: {column} is {row[column]!r}, not a usable number.")
        if column == "normal_n" and number < -MAX_PULL_N:
            raise CalibrationError(
                f"{path}, line {line}: normal_n is {row[column]}; a force that presses on the skin is positive."
            )
        numbers.append(number)
    return numbers


class _CalibrationFile(BaseModel):
    """The content of a calibration file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    format: str = Field(pattern=f"^{FORMAT}$")
    friction: float = Field(ge=0, le=1)
    gauge_angle_deg: float = Field(gt=0, lt=90)
    linear_to_n: float = Field(gt=0)
    tension_n: list[float] = Field(min_length=2)
    response: list[float] = Field(min_length=2)
    response_half_width: float = Field(ge=0)
    rows: int = Field(ge=1)
    rows_beyond: int = Field(ge=0)
    rest_ohm: list[float] = Field(min_length=2, max_length=2)


def save_calibration(calibration: SkinCalibration, path: Path) -> None:
    """Write a calibration as YAML, replacing the file at once."""
    lists = {name: list(getattr(calibration, name)) for name in _LISTS}
    save_yaml(path, {"format": FORMAT, **asdict(calibration), **lists}, CalibrationError)


def load_calibration(path: Path) -> SkinCalibration:
    """Return the calibration in a YAML file; raises CalibrationError naming the file and every wrong key."""
    document = read_yaml(path, CalibrationError, "calibration", "; make it with `shearloop skin calibrate`.")
    if not (isinstance(document, dict) and "format" in document):
        raise CalibrationError(
            f"{path} is not a calibration as `shearloop skin calibrate` writes it: it has no `format: {FORMAT}`."
        )
    values = validated(document, _CalibrationFile, str(path), CalibrationError).model_dump(exclude={"format"})
    try:
        return SkinCalibration(**values | {name: tuple(values[name]) for name in _LISTS})
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def responses_of_table(
    table: CalibrationTable, unloaded_below_n: float = UNLOADED_BELOW_N
) -> tuple[FloatArray, IntArray]:
    """Return the (rows,) responses and each row's loading, counted from 1; 0 for rows without load.

    Each loading begins with rows without load; their mean resistances normalise it, as in the paper.
    """
    idle = (abs(table.shear_n) <= unloaded_below_n) & (abs(table.normal_n) <= unloaded_below_n)
    if not idle.size or not idle[0]:
        raise CalibrationError(
            f"The table must begin with a row without load (both forces below {unloaded_below_n} N): "
            "it gives the resistances at rest."
        )
    loading = np.cumsum(idle & ~np.concatenate([[False], idle[:-1]]))
    response = np.empty(len(idle))
    for number in range(1, loading[-1] + 1):
        rows = loading == number
        at_rest = rows & idle
        r1_at_rest, r2_at_rest = float(table.r1_ohm[at_rest].mean()), float(table.r2_ohm[at_rest].mean())
        response[rows] = measured_response(table.r1_ohm[rows], table.r2_ohm[rows], r1_at_rest, r2_at_rest)
    return response, np.where(idle, 0, loading)


def fit_calibration(
    table: CalibrationTable,
    *,
    friction: float | None = None,
    gauge_angle_deg: float = math.degrees(PAPER_SECTION.gauge_angle_rad),
    linear_to_n: float = LINEAR_TO_N,
    unloaded_below_n: float = UNLOADED_BELOW_N,
) -> SkinCalibration:
    """Return the least-squares calibration of a table; friction is fitted too unless given.

    Raises CalibrationError where the table has too few rows, no row at rest or does not determine friction, and where
    the response does not rise with the force.
    """
    response, loading = responses_of_table(table, unloaded_below_n)
    loaded, gauge_angle_rad = loading > 0, math.radians(gauge_angle_deg)
    columns = loading[loaded], table.shear_n[loaded], table.normal_n[loaded]
    forces = list(zip(*(column.tolist() for column in columns), strict=True))
    start = PAPER_SECTION.friction if friction is None else friction
    nominal = _tensions(forces, gauge_angle_rad, start)
    upper, lower = _knots(nominal, linear_to_n), _knots(-nominal, linear_to_n)
    kept = (len(upper) > 0) | (nominal <= linear_to_n)
    kept &= (len(lower) > 0) | (-nominal <= linear_to_n)
    curve = _CurveFit(
        lambda mu: _tensions(forces, gauge_angle_rad, mu)[kept], response[loaded][kept], linear_to_n, upper, lower
    )
    if curve.rows < curve.pieces + 3:
        raise CalibrationError(
            f"{curve.rows} rows under load cannot carry {curve.pieces} pieces of curve and an interval; record more."
        )
    # The response must go with the tension, not against it.
    if float(nominal[kept] @ curve.response) <= 0.0:
        raise CalibrationError(NOT_RISING)
    if friction is None:
        friction = _fit_friction(curve)
    knots, responses, half_width = curve.fit(friction)
    idle = loading == 0
    return SkinCalibration(
        friction=friction,
        gauge_angle_deg=math.degrees(gauge_angle_rad),
        linear_to_n=linear_to_n,
        tension_n=tuple(knots.tolist()),
        response=tuple(responses.tolist()),
        response_half_width=half_width,
        rows=curve.rows,
        rows_beyond=int((~kept).sum()),
        rest_ohm=(float(table.r1_ohm[idle].mean()), float(table.r2_ohm[idle].mean())),
    )


def _tensions(forces: Sequence[tuple[int, float, float]], gauge_angle_rad: float, friction: float) -> FloatArray:
    """Return the net tension (rows,) at the gauges, in N, for rows of (loading, shear, normal force).

    Each loading starts from the unstretched skin.
    """
    membrane = Membrane(1.0, friction, gauge_angle_rad, 1.0)
    state, current, found = UNSTRETCHED, 0, []
    for loading, shear_n, normal_n in forces:
        if loading != current:
            state, current = UNSTRETCHED, loading
        state = membrane.step(state, shear_n, normal_n)
        found.append(state.gauge_tension_1_n - state.gauge_tension_2_n)
    return np.array(found)


class _CurveFit:
    """Response against tension in straight pieces: one through the origin, others beyond its ends.

    `tensions` returns the tension (rows,) for a friction.
    """

    def __init__(
        self,
        tensions: Callable[[float], FloatArray],
        response: FloatArray,
        linear_to_n: float,
        upper: FloatArray,
        lower: FloatArray,
    ) -> None:
        self._tensions, self.response = tensions, response
        self._linear_to_n, self._upper, self._lower = linear_to_n, upper, lower
        self.rows = len(response)
        self.pieces = 1 + len(upper) + len(lower)

    def squares(self, friction: float) -> float:
        """Return the sum of squared residuals with the best curve for this friction."""
        from scipy.optimize import nnls

        return float(nnls(self._design(self._tensions(friction)), self.response)[1] ** 2)

    def fit(self, friction: float) -> tuple[FloatArray, FloatArray, float]:
        """Return the best curve's knots (N) and responses there, and the half width of its prediction interval."""
        from scipy.optimize import nnls

        tension = self._tensions(friction)
        design = self._design(tension)
        slopes, distance = nnls(design, self.response)
        ends = min(float(tension.min()), 0.0), max(float(tension.max()), 0.0)
        knots = np.concatenate([[ends[0]], -self._lower[::-1], self._upper, [ends[1]]])
        if not (slopes > 0).all() or not (np.diff(knots) > 0).all():
            raise CalibrationError(NOT_RISING)
        leverage = (np.linalg.qr(design).Q ** 2).sum(axis=1).max()
        freedom = self.rows - self.pieces
        scatter = distance / math.sqrt(freedom)
        half_width = float(stdtrit(freedom, 0.975)) * scatter * math.sqrt(1 + leverage)
        return knots, self._design(knots) @ slopes, half_width

    def _design(self, tension: FloatArray) -> FloatArray:
        columns = [np.clip(tension, -self._linear_to_n, self._linear_to_n)]
        columns += _hinges(tension, self._upper) + [-column for column in _hinges(-tension, self._lower)]
        return np.column_stack(columns)


def _hinges(tension: FloatArray, knots: FloatArray) -> list[FloatArray]:
    """Return the part of the tension within each piece; the last piece is open."""
    widths = np.append(np.diff(knots), math.inf)
    return [np.clip(tension - knot, 0.0, width) for knot, width in zip(knots, widths, strict=False)]


def _knots(tension: FloatArray, linear_to_n: float) -> FloatArray:
    """Return where the pieces beyond the straight one begin: as many as the rows support, with equal shares."""
    beyond = np.sort(tension[tension > linear_to_n])
    pieces = min(MAX_PIECES, len(beyond) // MIN_ROWS_PER_PIECE)
    if not pieces:
        return np.empty(0)
    begins = beyond[np.arange(1, pieces) * len(beyond) // pieces]
    return np.unique(np.append(linear_to_n, begins))


def _fit_friction(curve: _CurveFit) -> float:
    from scipy.optimize import minimize_scalar

    coarse = np.linspace(0.0, MAX_FRICTION, 26)
    best = coarse[int(np.argmin([curve.squares(mu) for mu in coarse]))]
    bounds = max(best - coarse[1], 0.0), min(best + coarse[1], MAX_FRICTION)
    friction = float(minimize_scalar(curve.squares, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x)
    # A wrong friction must make the fit visibly worse.
    least = curve.squares(friction)
    neighbours = [mu for mu in (friction - FRICTION_STD, friction + FRICTION_STD) if mu >= 0]
    worse = min(map(curve.squares, neighbours)) - least
    if worse <= max(least / max(curve.rows - curve.pieces, 1), 1e-9 * float(curve.response @ curve.response)):
        raise CalibrationError(
            "The table does not determine the friction of the skin; load it under more normal force, load and "
            "unload it, or give the coefficient (--friction)."
        )
    return friction
