"""Fitting an estimator to recordings: one function, five estimators, each on raw frames or on slices.

Everything that is chosen is chosen on data later than what it was fitted to; nothing looks at the recordings that the
calibration will be judged on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bank.bank_file import Bank
from bank.channels import N_CHANNELS
from bank.errors import CalibrationError
from bank.estimators.alignment import check_alignment, telling, torque_within, unchecked_s
from bank.estimators.calibrated import (
    NEEDS_BANK,
    Calibration,
    Name,
    Task,
    columns_for,
    features_of,
    locator_for,
)
from bank.estimators.cylinders import LEAST_LEFT, Gripped, fit_cylinders
from bank.estimators.familiar import DifferenceGuard
from bank.estimators.gripped import gripped_part
from bank.estimators.guard import SideGuard
from bank.estimators.heads import Censored, Curve, Ridge, later_origins
from bank.estimators.memory import Memory, Motion
from bank.estimators.mixtures import Mixtures
from bank.estimators.physics import NOT_TURNED, Locator, Registration, image_matrix, register, settle_half_turn
from bank.estimators.reader import (
    STRENGTHS,
    Head,
    Reader,
    error_on_later,
    fit_reader,
    one_sided,
)
from bank.estimators.values import FloatArray, FrameSeries, Measured, TactileFrame, distinct

if TYPE_CHECKING:
    from bank.mesh import Mesh

# Directions of motion per fingertip, and frames back: 13 frames are 7 s, about twice the gel's creep.
N_DIRECTIONS, N_LAGS = 4, 12
# The curve of frames over torque and over diameter: degree, directions of drift, and whether there is a trend. Of the
# torque's the mean error over six origins (19 to 44 of 49 slices, judged on all that follow) was least for these
# (docs/decisions/0042).
TORQUE_CURVE, DIAMETER_CURVE = (3, 3, True), (1, 1, False)
# With a block left out, as many are left as it takes to know what is familiar.
_LEAST_TORQUE_SLICES = 10
# A hundred features of a few directions need little holding back.
_MOTION_STRENGTHS = (1e-6, 1e-5, 1e-4)
# A full heatmap over all lags takes a good part of a second: more frames than this are thinned out to calibrate on.
_LARGEST_MATCHED = 120
# A place drifts from recording to recording as motion does not: motion alone is preferred unless it leaves more than
# this share of the torque's variance unexplained on later frames, and the place takes this share off the error.
_MOTION_MAY_LEAVE, _PLACE_MUST_GAIN = 0.5, 0.5
# Where more than this is left on a tool of another diameter, none of the torque is common to the tools.
_TOOLS_MAY_LEAVE = 0.75
# A diameter stays the same within a recording: more frames than this tell no more, and take long.
_MOST_FOR_DIAMETER = 240
# Fewer different diameters than this do not determine a line and whether it is one.
_LEAST_DIAMETERS = 3


@dataclass(frozen=True, slots=True)
class Physics:
    """What was known beforehand: the bank, and the mesh that an image is reconstructed on."""

    bank: Bank | None = None
    mesh: "Mesh | None" = None


def fit(
    name: Name,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    trust_times: bool = False,
    timed_by: Sequence[FrameSeries] = (),
) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` says in words what they are.

    Slices with torque give a torque, those with diameters a diameter. `timed_by` may be what was recorded beside by
    other fingertips, by which the torques' times are checked where these hardly move with the load. Raises
    CalibrationError for recordings that do not determine the calibration, for torques that are clearly stamped at other
    times than the frames unless `trust_times` is set, and for physics that the estimator needs and did not get.
    """
    physics = physics or Physics()
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    _check_values(recordings)
    kinds = {one.kind for one in recordings}
    if len(kinds) > 1:
        raise CalibrationError("raw frames and slices of differences do not go into one calibration; make two")
    sides = tuple(side for side in recordings[0].sides if all(side in one.sides for one in recordings))
    if not sides:
        raise CalibrationError("the recordings have no side in common; name the side of each when importing")
    if name in NEEDS_BANK and physics.bank is None:
        raise CalibrationError(f"the estimator {name} needs a bank; name it with --bank")
    if name == "reconstruction" and physics.mesh is None:
        raise CalibrationError("the estimator reconstruction needs a mesh; name it with --mesh")
    blank = Calibration(
        estimator=name,
        kind=recordings[0].kind,
        sides=sides,
        source=source,
        bank_identity=physics.bank.identity if physics.bank is not None and name in NEEDS_BANK else "",
        tool_mm=tools[0].value if len(tools := _tools(recordings)) == 1 else np.nan,
        registration=NOT_TURNED,
        scale=np.ones((len(sides), N_CHANNELS)),
        guards=(),
        motion=None,
        image=image_matrix(physics.mesh) if name == "reconstruction" and physics.mesh is not None else None,
        torque=None,
        diameter=None,
    )
    chosen = [one.of_sides(sides) for one in recordings]
    if blank.kind != "raw":
        return _fit_slices(blank, chosen, physics)
    if trust_times:
        return _fit_raw(blank, chosen, physics, 0.0)
    timed = telling(recordings, timed_by)
    check_alignment(timed)
    return _fit_raw(blank, chosen, physics, unchecked_s(timed))


def _check_values(recordings: Sequence[FrameSeries]) -> None:
    """Raise CalibrationError for a recording without frames, or with values that are no numbers."""
    for number, one in enumerate(recordings, 1):
        which = f"recording {number} of {len(recordings)}"
        if not len(one.t_s):
            raise CalibrationError(f"{which} has no frames to calibrate on; leave it out, or use a longer part of it")
        # A slice without a torque of its own may be of a cylinder.
        torque = one.torque_nm if one.kind == "raw" else np.zeros(0)
        wrong = sum(int(np.count_nonzero(~np.isfinite(values))) for values in (one.t_s, one.channels, torque))
        if wrong:
            raise CalibrationError(f"{which} holds {wrong} values that are not finite numbers; leave those frames out")


def _fit_slices(blank: Calibration, recordings: list[FrameSeries], physics: Physics) -> Calibration:
    if len(blank.sides) > 1:
        raise CalibrationError(
            f"slices of {len(blank.sides)} fingertips ({', '.join(blank.sides)}) do not go into one calibration; make "
            "one for each"
        )
    frames = np.concatenate([one.channels for one in recordings])
    times = _consecutive([one.t_s for one in recordings])
    torque = np.concatenate([one.torque_at_frames() for one in recordings])
    diameter = np.concatenate([one.diameter_mm for one in recordings])
    registered = _locator(blank, physics)
    tasks = {}
    for name, values in (("torque", torque), ("diameter", diameter)):
        # Cylinders were twisted too, at one torque each: that does not determine a torque.
        known = np.isfinite(values) & (np.isfinite(diameter) if name == "diameter" else ~np.isfinite(diameter))
        if not known.any():
            continue
        if name == "torque" and known.sum() < _LEAST_TORQUE_SLICES:
            raise CalibrationError(
                f"{known.sum()} slices with a torque are too few to calibrate on; record {_LEAST_TORQUE_SLICES} or more"
            )
        differences = np.abs(frames[known])
        features = np.array(
            [
                features_of(blank, registered, one, None, t).features
                for one, t in zip(differences, times[known].tolist(), strict=True)
            ]
        )
        columns = columns_for(blank.estimator, name, features)
        later = _mixtures(blank, registered, differences[:, 0], times[known]) if name == "torque" else None
        curve = TORQUE_CURVE if name == "torque" else DIAMETER_CURVE
        reader = fit_reader(
            columns,
            values[known],
            _curve(curve) if blank.estimator == "fused" else _ridge(blank.estimator),
            strengths=_strengths(blank.estimator),
            left_out=later_origins(int(known.sum())) if name == "torque" else (),
            difficulty=later.difficulty if later is not None else None,
            mixed=later.passing if later is not None else None,
        )
        tasks[name] = Task(reader, DifferenceGuard.fit(differences[:, 0]), _ks(blank.estimator, features))
    if not tasks:
        raise CalibrationError("the slices come with neither torque nor diameter")
    return replace(blank, torque=tasks.get("torque"), diameter=tasks.get("diameter"))


def _mixtures(blank: Calibration, locator: Locator | None, differences: FloatArray, t_s: FloatArray) -> Mixtures:
    """Return (n, 896) differences at (n,) times with what may be hidden in them, as the torque is read from it."""

    def features(difference: FloatArray, row: int) -> FloatArray:
        seen = features_of(blank, locator, difference[None], None, float(t_s[row]))
        return columns_for(blank.estimator, "torque", seen.features)

    return Mixtures(differences, features)


def _ks(name: Name, features: FloatArray) -> FloatArray:
    """Return the least and the largest k of (n, d) features, none for an estimator without a bank."""
    return np.array([features[:, 0].min(), features[:, 0].max()]) if name in NEEDS_BANK else np.zeros(0)


def _ridge(name: Name) -> Callable[[FloatArray, FloatArray, float], Head]:
    return Ridge.fit_scaled if name in NEEDS_BANK else Ridge.fit


def _strengths(name: Name) -> tuple[float, ...]:
    """Return the strengths to choose from: none for the paper's polynomials, nor for curves."""
    return {"paper": (1e-9,), "fused": (0.0,)}.get(name, STRENGTHS)


def _curve(shape: tuple[int, int, bool]) -> Callable[[FloatArray, FloatArray, float], Head]:
    degree, n_drift, trend = shape
    return lambda features, values, _: Curve.fit(features, values, degree, n_drift, trend=trend)


def _consecutive(times: list[FloatArray]) -> FloatArray:
    """Return the times of several series one after another, each beginning one later than the one before has ended."""
    shifted: list[FloatArray] = []
    for one in times:
        begins_early = bool(shifted) and one[0] <= shifted[-1][-1]
        shifted.append(one - one[0] + shifted[-1][-1] + 1.0 if begins_early else one)
    return np.concatenate(shifted)


def _fit_raw(blank: Calibration, recordings: list[FrameSeries], physics: Physics, times_unsure_s: float) -> Calibration:
    parts = [gripped_part(one) for one in recordings]
    guards = tuple(
        SideGuard.fit(side, *(_frames_of(one, part, layer) for one, part in zip(recordings, parts, strict=True)))
        for layer, side in enumerate(blank.sides)
    )
    calibration = replace(blank, guards=guards, scale=_finite(np.array([guard.noise for guard in guards])))
    if blank.estimator == "fused":
        gripped = [one.channels[part[1]] for one, part in zip(recordings, parts, strict=True)]
        motion = replace(Motion.fit(gripped, guards, N_DIRECTIONS, N_LAGS), placed=True)
        calibration = replace(calibration, motion=motion)
    if physics.bank is not None:
        # Whatever reads the torque, the place in the bank is shown beside it.
        found = register(guards[0].idle, physics.bank.homogeneous)
        touch = guards[0].gripped - guards[0].idle
        calibration = replace(calibration, registration=settle_half_turn(found, touch, physics.bank))
    locator = _locator(calibration, physics)
    every = _thinning(calibration, recordings)
    rows = [row for i, one in enumerate(recordings) for row in _replayed(calibration, locator, i, one, every)]
    if not rows:
        raise CalibrationError("no frame of the recordings is gripped and undisturbed for long enough to calibrate on")
    features = np.array([row.features for row in rows])
    torque_nm = np.array([row.torque_nm for row in rows])
    calibration, reader, unexplained = _torque_reader(
        calibration, features, torque_nm, _within(recordings, rows, times_unsure_s)
    )
    torque, diameter = Task(reader, None, _ks(calibration.estimator, features)), _diameter_task(calibration, rows)
    if _undetermined(recordings, unexplained):
        if diameter is None:
            tools = " and ".join(f"{one.value:.3g}" for one in _tools(recordings))
            raise CalibrationError(
                f"the tools of {tools} mm turn so differently that no torque is common to them; calibrate on each alone"
            )
        return replace(calibration, diameter=diameter)
    return replace(calibration, torque=torque, diameter=diameter)


def _frames_of(
    series: FrameSeries, part: tuple[slice, slice, slice], layer: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return one side's frames before the grip, in it, and after it."""
    before, during, after = (series.channels[one, layer] for one in part)
    return before, during, after


def _torque_reader(
    calibration: Calibration, features: FloatArray, torque: FloatArray, within: tuple[FloatArray, FloatArray] | None
) -> tuple[Calibration, Reader, float]:
    """Return the torque's reader, and the calibration with the features that do better on later frames.

    Third comes the share of the torque's variance that motion leaves unexplained there, 0 where none is read.
    """
    motion = calibration.motion
    if motion is None:
        columns, head = columns_for(calibration.estimator, "torque", features), _ridge(calibration.estimator)
        strengths = _strengths(calibration.estimator)
        # Places in the bank are within its grid; all else would follow a drift to wherever it leads. Without memory
        # the gel's drift goes into the torque: what is left out must come later, as the future will.
        limit_reach = calibration.estimator not in NEEDS_BANK
        later = later_origins(len(torque))
        reader = fit_reader(
            columns, torque, head, strengths=strengths, limit_reach=limit_reach, left_out=later, within=within
        )
        return calibration, reader, 0.0
    head = Censored.fit if one_sided(torque) else Ridge.fit_scaled
    # Whether the gel's place tells more than its motion is for the recordings to say.
    n_motion = motion.n_lags * motion.directions.shape[0] * motion.directions.shape[1]
    choices = {False: features[:, :n_motion], True: features}
    errors = {placed: error_on_later(one, torque, head, _MOTION_STRENGTHS) for placed, one in choices.items()}
    unexplained = errors[False] / float(torque.var())
    placed = unexplained > _MOTION_MAY_LEAVE and errors[True] < _PLACE_MUST_GAIN * errors[False]
    reader = fit_reader(choices[placed], torque, head, strengths=_MOTION_STRENGTHS, limit_reach=True, within=within)
    calibration = replace(calibration, motion=replace(motion, placed=placed))
    return calibration, reader, errors[placed] / float(torque.var())


def _within(recordings: list[FrameSeries], rows: list["_Row"], unsure_s: float) -> tuple[FloatArray, FloatArray] | None:
    """Return the least and the largest torque that each row may be of, None where times are known."""
    if unsure_s == 0:
        return None
    found = [torque_within(one, unsure_s) for one in recordings]
    least_nm, largest_nm = (np.array([found[row.recording][end][row.frame] for row in rows]) for end in (0, 1))
    return least_nm, largest_nm


def _diameter_task(calibration: Calibration, rows: list["_Row"]) -> Task | None:
    """Return how diameters are read, None where the recordings do not know of different ones."""
    # Each recording has one tool: in the order of time within them, every part has all.
    known = sorted((row for row in rows if np.isfinite(row.diameter_mm)), key=lambda row: row.since_s)
    if len({row.diameter_mm for row in known}) < _LEAST_DIAMETERS:
        return None
    if calibration.motion is not None:
        return Task(fit_cylinders(_grips(known)), None, np.zeros(0))
    known = known[:: 1 + len(known) // _MOST_FOR_DIAMETER]
    diameters = np.array([row.diameter_mm for row in known])
    features = np.array([columns_for(calibration.estimator, "diameter", row.features) for row in known])
    # Whoever grips a tool again sees another recording, not a later part of this one.
    number = np.array([row.recording for row in known])
    each = [(np.flatnonzero(number != one), np.flatnonzero(number == one)) for one in np.unique(number)]
    left_out = [pair for pair in each if len(np.unique(diameters[pair[0]])) >= LEAST_LEFT]
    head, strengths = _ridge(calibration.estimator), _strengths(calibration.estimator)
    reader = fit_reader(features, diameters, head, strengths=strengths, left_out=left_out)
    return Task(reader, None, _ks(calibration.estimator, np.array([row.features for row in known])))


def _grips(rows: list["_Row"]) -> list[Gripped]:
    """Return what each recording's frames say of its tool."""
    grips = []
    for number in sorted({row.recording for row in rows}):
        own = [row for row in rows if row.recording == number]
        frames, held = (np.array([getattr(row, name) for row in own]) for name in ("place", "held"))
        grips.append(Gripped(own[0].diameter_mm, frames, held))
    return grips


def _undetermined(recordings: list[FrameSeries], unexplained: float) -> bool:
    """Return whether tools of different diameters turn so differently that no torque is common to them."""
    return len(_tools(recordings)) > 1 and unexplained > _TOOLS_MAY_LEAVE


def _tools(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the diameters of raw recordings' different tools in mm, as far as they are known."""
    return distinct([tool for one in recordings if (tool := one.tool_mm) is not None])


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """One frame that is calibrated on: of which recording, its number and age there, what is seen and what is true.

    place and held (d,) are the difference to the idle frame and its mean over the grip, in units of noise.
    """

    recording: int
    frame: int
    since_s: float
    features: FloatArray
    place: FloatArray
    held: FloatArray
    torque_nm: float
    diameter_mm: float


def _replayed(
    calibration: Calibration, locator: Locator | None, recording: int, series: FrameSeries, every: int
) -> list[_Row]:
    """Return the frames that an estimate would be made of, by the way that makes it."""
    memory = Memory(calibration.guards, calibration.motion)
    rows = []
    for i, (t_s, channels, torque, diameter) in enumerate(
        zip(series.t_s, series.channels, series.torque_at_frames(), series.diameter_mm, strict=True)
    ):
        moment = memory.see(TactileFrame.of(float(t_s), channels))
        if not moment.why and np.isfinite(torque) and i % every == 0:
            features = features_of(calibration, locator, moment.difference, memory.moved, float(t_s)).features
            since_s = float(t_s - series.t_s[0])
            place, held = ((one / calibration.scale).ravel() for one in (moment.difference, memory.held))
            rows.append(_Row(recording, i, since_s, features, place, held, float(torque), float(diameter)))
    return rows


def _thinning(calibration: Calibration, recordings: list[FrameSeries]) -> int:
    if calibration.estimator != "paper":
        return 1
    return max(1, sum(len(one.t_s) for one in recordings) // _LARGEST_MATCHED)


def _locator(calibration: Calibration, physics: Physics) -> Locator | None:
    if calibration.estimator not in NEEDS_BANK or physics.bank is None:
        return None
    return locator_for(calibration.estimator, physics.bank, calibration.registration)


def _finite(noise: FloatArray) -> FloatArray:
    """Return the noise with that of dead channels so large that they say nothing."""
    return np.where(np.isfinite(noise), noise, 1e9)


__all__ = ["N_DIRECTIONS", "N_LAGS", "Physics", "Registration", "fit"]
