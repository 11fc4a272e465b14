"""A calibration of one estimator, and the tracker that follows one session with it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from bank.bank_file import Bank
from bank.channels import CHANNEL_TABLE_HASH, N_CHANNELS
from bank.errors import CalibrationError
from bank.estimators.archive import read_archive, write_archive
from bank.estimators.cylinders import is_line
from bank.estimators.familiar import FAMILIAR, DifferenceGuard
from bank.estimators.filling import Filling, died
from bank.estimators.guard import SideGuard
from bank.estimators.heads import Ridge
from bank.estimators.memory import Memory
from bank.estimators.motion import Motion
from bank.estimators.physics import BestCell, Locator, NearestCell, Place, Registration
from bank.estimators.reader import Reader
from bank.estimators.values import BoolArray, Estimate, FloatArray, Kind, Measured, TactileFrame
from bank.gaussian import TWO_SIDED_95

Name = Literal["paper", "bank", "regression", "reconstruction", "fused"]
NAMES: tuple[Name, ...] = ("paper", "bank", "regression", "reconstruction", "fused")
NEEDS_BANK: tuple[Name, ...] = ("paper", "bank")
# What may be taken on somebody's word, as a sentence goes on that says so.
Vouched = Literal["all torques", "load times"]
_ON_WORD: dict[Vouched, str] = {
    "all torques": "that no torque will come beyond those of its slices (--all-torques)",
    "load times": "for when its loads were measured (--load-late)",
}
# Two cells of the paper's bank.
_LEAST_MARGIN_K_CM = 0.05


# A tool whose diameter is further off than this share is another one.
LARGEST_TOOL_SHARE = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """How one quantity is read: its reader, and for differences the guard of those it was fitted to.

    ks are the least and the largest k in cm that frames were found at in the bank, none for an estimator without one.
    """

    reader: Reader
    guard: DifferenceGuard | None
    ks: FloatArray

    def refuse_place(self, place: Place | None) -> tuple[str, ...]:
        """Return why a place in the bank is none that torques were calibrated at: the match may have hopped."""
        if place is None or not len(self.ks):
            return ()
        low, high = self.ks.tolist()
        margin = max(high - low, _LEAST_MARGIN_K_CM)
        if low - margin <= place.k <= high + margin:
            return ()
        return (
            f"the bank fits best at k = {place.k:.2f} cm, and the calibration knows {low:.2f} to {high:.2f} cm; "
            "another ridge of the bank fits the frame better, which was not calibrated",
        )


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """All that an estimator knows of its fingertips; `source` says in words what it was fitted to.

    guards and motion are there for raw frames; scale (m, 896) divides differences channel by channel, those that were
    dead by infinity; image (p, 896) turns them into pixels. bank_identity is empty for an estimator without a bank.
    tool_mm is the diameter of the one tool that all was recorded with, NaN where it is not known or not one. filling is
    there for raw frames that are read without memory; calibrations that were made before there was any have none.
    vouched is what was taken on somebody's word, None where the calibration is older than that is told.
    """

    estimator: Name
    kind: Kind
    sides: tuple[str, ...]
    source: str
    bank_identity: str
    tool_mm: float
    registration: Registration
    scale: FloatArray
    guards: tuple[SideGuard, ...]
    motion: Motion | None
    image: FloatArray | None
    torque: Task | None
    diameter: Task | None
    filling: Filling | None = None
    vouched: tuple[Vouched, ...] | None = None

    @property
    def word(self) -> str:
        """What was taken on somebody's word, as "on somebody's word …" goes on; empty for nothing."""
        return " and ".join(_ON_WORD[one] for one in self.vouched or ())

    def save(self, path: str | Path) -> None:
        """Write the calibration's file, the same bytes for the same calibration; CalibrationError where it fails."""
        write_archive(path, {"channel_table": CHANNEL_TABLE_HASH}, self)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration; CalibrationError, naming the file, for one that cannot be used."""
        read = read_archive(path, {"channel_table": CHANNEL_TABLE_HASH}, cls)
        if read.motion is not None and read.diameter is not None and not is_line(read.diameter.reader.head):
            raise CalibrationError(
                f"{path}: the calibration is of an older version, which read diameters far too near to their mean and "
                "called that certain; calibrate again on the same recordings"
            )
        return read

    def locator(self, bank: Bank | None) -> Locator | None:
        """Return what finds places in the bank, None for an estimator that does without.

        Raises CalibrationError when the estimator needs a bank that is not given or is another one.
        """
        if self.estimator not in NEEDS_BANK:
            return None
        if bank is None:
            raise CalibrationError(f"the estimator {self.estimator} needs its bank; name it with --bank")
        if bank.identity != self.bank_identity:
            raise CalibrationError(
                f"the calibration was made with the bank {self.bank_identity[:12]}…, and {bank.path} is "
                f"{bank.identity[:12]}…; name the bank it was made with, or calibrate again"
            )
        return locator_for(self.estimator, bank, self.registration)


def locator_for(name: Name, bank: Bank, registration: Registration) -> Locator:
    """Return the locator of an estimator that has one."""
    return BestCell(bank) if name == "paper" else NearestCell(bank, registration)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The features of one frame, and the place in the bank where there is one."""

    features: FloatArray
    place: Place | None = None


def features_of(
    calibration: Calibration, locator: Locator | None, difference: FloatArray, moved: FloatArray | None, t_s: float
) -> Seen:
    """Return the features of (m, 896) differences at t_s, or those of the last frames' motion where that is read.

    A slice is followed by its time: how it is read drifts with it.
    """
    if calibration.motion is not None:
        if moved is None:
            raise ValueError("features of motion need the last frames")
        return Seen(moved)
    if locator is not None:
        cells = [locator.locate(layer) for layer in difference]
        if calibration.estimator == "paper":
            # The paper considers one fingertip, and reads torque from sigma and diameter from k.
            return Seen(np.array([cells[0].k, cells[0].sigma, cells[0].sigma ** 2]), cells[0])
        return Seen(np.concatenate([cell.features for cell in cells]), cells[0])
    if calibration.image is not None:
        return Seen((difference @ calibration.image.T).ravel())
    features = (difference / calibration.scale).ravel()
    return Seen(np.append(features, t_s) if calibration.estimator == "fused" else features)


# In which what stands for unusable channels may be off, where nothing stands for any.
_NO_WAYS: FloatArray = np.zeros((0, 1, N_CHANNELS))

# The features that each quantity is read from, where that is not all of them: the paper's sigma and its square, and k.
PAPER_COLUMNS = {"torque": slice(1, 3), "diameter": slice(0, 1)}


class Tracker:
    """Follows one session: `estimate` takes every frame in order and keeps what must be remembered, causally."""

    def __init__(
        self,
        calibration: Calibration,
        bank: Bank | None = None,
        tool_mm: float = np.nan,
        period_s: float = np.inf,
    ) -> None:
        """Begin a session; raises CalibrationError for a bank that is missing or another one.

        Where the tool's diameter is known already, it is `tool_mm`; where the board's frame period is, `period_s`.
        """
        self.calibration = calibration
        self._period_s = period_s
        self.hold(None if np.isnan(tool_mm) else Measured(tool_mm, 0.0))
        self._locator = calibration.locator(bank)
        self._place_noise_mm = _noise_of_a_place(calibration)
        self.tare()

    def hold(self, tool: Measured | None) -> None:
        """Take note of the diameter in mm of the tool that is held from now on, None where nobody knows it.

        It is compared with the calibration's: the same motion of the gel is another torque on another tool, four times
        as much on one of 10 mm as on one of 20 mm.
        """
        own_mm = self.calibration.tool_mm
        self._other_tool: tuple[str, ...] = ()
        if tool is not None and abs(tool.value - own_mm) > LARGEST_TOOL_SHARE * own_mm + tool.half_width:
            self._other_tool = (
                f"the tool is of {tool.value:.3g} mm and the calibration of one of {own_mm:g} mm, and its torque does "
                "not carry over; calibrate on this tool",
            )

    def tare(self) -> None:
        """Forget the session: the next frame is its first."""
        self._begin()

    def take_idle(self, frames: int) -> None:
        """Forget the session, and take the next `frames` usable frames for those of an untouched fingertip.

        Raises CalibrationError for a calibration of slices, which have no idle frame.
        """
        if self.calibration.kind != "raw":
            raise CalibrationError("slices are differences already: they have no zero to take")
        self._begin(frames)

    def _begin(self, idle_frames: int = 0) -> None:
        calibration = self.calibration
        self._memory: Memory | None = None
        if calibration.kind == "raw":
            self._memory = Memory(calibration.guards, calibration.motion, self._period_s, idle_frames)
        self._difference: FloatArray | None = None

    @property
    def taking_idle(self) -> bool:
        """Whether frames are still being taken for idle ones."""
        return self._memory is not None and self._memory.taking_idle

    @property
    def difference(self) -> FloatArray | None:
        """The (m, 896) difference to the idle frame that the last estimate was made from, None where it was not."""
        return self._difference

    def estimate(self, frame: TactileFrame) -> Estimate:
        """Return what a frame of the calibration's sides says.

        Raises CalibrationError for a frame of another number of sides.
        """
        if frame.channels.shape != self.calibration.scale.shape:
            raise CalibrationError(
                f"the calibration is of {len(self.calibration.sides)} sides ({', '.join(self.calibration.sides)}), "
                f"and the frame has the shape {frame.channels.shape}"
            )
        self._difference = None
        if self._memory is None:
            difference = np.abs(frame.channels)
            return self._read(difference, None, frame.usable, frame.t_s)
        moment = self._memory.see(frame)
        if moment.why:
            return Estimate(valid=False, why=moment.why)
        self._difference = moment.difference
        return self._read(moment.difference, self._memory.moved, moment.usable, frame.t_s)

    def _read(self, difference: FloatArray, moved: FloatArray | None, usable: BoolArray, t_s: float) -> Estimate:
        calibration = self.calibration
        refused: list[str] = []
        tasks = {"torque": (calibration.torque, "N·m"), "diameter": (calibration.diameter, "mm")}
        wanted = {}
        for name, (task, _) in tasks.items():
            if task is None:
                continue
            judged = task.guard.judge(difference[0], usable[0]) if task.guard is not None else FAMILIAR
            why = judged.why
            if name == "torque":
                why = (*why, *self._other_tool)
            if name == "diameter" and self._memory is not None and not self._memory.own_baseline:
                # Where the gel stands means nothing without knowing where it stood.
                if calibration.torque is None:
                    refused.append("the fingertip was gripped from the first frame on: its idle frame is not known")
                continue
            refused += [reason for reason in why if reason not in refused]
            if not why:
                wanted[name] = task, judged
        if not wanted:
            return Estimate(valid=False, why=tuple(refused))
        guard = next((task.guard for task, _ in wanted.values() if task.guard is not None), None)
        usable_share, ways = np.count_nonzero(usable) / usable.size, _NO_WAYS
        if usable_share < 1.0 and calibration.motion is None:
            older = calibration.kind == "raw" and calibration.filling is None
            missing = died(calibration.guards, usable) if older else ()
            if missing:
                return Estimate(valid=False, why=missing)
            difference, ways = self._without(usable, difference, guard)
            if self._difference is not None:
                self._difference = difference
        seen = features_of(calibration, self._locator, difference, moved, t_s)
        held = self._memory.held if self._memory is not None else difference
        if seen.place is not None and seen.place.ambiguous:
            return _with_place(
                Estimate(valid=False, why=("two places of the bank far apart fit the frame equally well",)), seen.place
            )
        values: dict[str, tuple[float, float, float]] = {}
        for name, (task, judged) in wanted.items():
            features = read_from(calibration, name, seen.features, held)
            whole = None
            # The paper's place in the bank is that of any multiple of a frame.
            if name == "torque" and judged.missing and calibration.estimator != "paper":
                grown = features_of(calibration, self._locator, difference / (1.0 - judged.missing), moved, t_s)
                whole = read_from(calibration, name, grown.features, held)
            read = task.reader.read(features, usable_share, judged.widening, judged.nearness, whole)
            unread: tuple[str, ...] = ()
            if len(ways):
                off = [features_of(calibration, self._locator, difference + way, moved, t_s).features for way in ways]
                values_off = [task.reader.read(read_from(calibration, name, one, held))[0] for one in off]
                unsure = TWO_SIDED_95 * math.hypot(*(one - read[0] for one in values_off))
                if 2 * unsure > read[1] + read[2]:
                    # They told of it, and what the others say of them is a guess.
                    unread = died(calibration.guards, usable)
                read = _widened(read, unsure)
            if name == "diameter" and self._memory is not None:
                read = _widened(read, self._place_noise_mm / math.sqrt(self._memory.held_frames))
            why = unread or task.refuse_place(seen.place) or task.reader.refuse(read[0], features, name, tasks[name][1])
            refused += [reason for reason in why if reason not in refused]
            if not why:
                values[name] = read
        if calibration.kind == "raw" and calibration.torque is not None and "torque" not in values:
            # What a frame beyond the calibrated torques says of the tool was not calibrated either.
            values.clear()
        return _with_place(_estimate(values, tuple(refused)), seen.place)

    def _without(
        self, usable: BoolArray, difference: FloatArray, guard: DifferenceGuard | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return a (m, 896) difference in which channels that are not usable have what the others say of them.

        And the (k, m, 896) ways in which that may be off, each by a standard deviation.
        """
        if self.calibration.filling is not None:
            return self.calibration.filling.filled(difference, usable)
        if guard is None:
            # All of them were dead at calibration too.
            return difference, _NO_WAYS
        # A curve does without dead channels; all else has to be told what they would have said.
        curve = self.calibration.estimator == "fused"
        said = np.full(N_CHANNELS, np.nan) if curve else guard.filled(difference[0], usable[0])
        return np.where(usable, difference, said), _NO_WAYS


def columns_for(estimator: Name, quantity: str, features: FloatArray) -> FloatArray:
    """Return those (…, d) features that a quantity is read from."""
    return features[..., PAPER_COLUMNS[quantity]] if estimator == "paper" else features


def read_from(calibration: Calibration, quantity: str, features: FloatArray, held: FloatArray) -> FloatArray:
    """Return the (d,) features that a quantity is read from, given a frame's and the (m, 896) mean place of its grip.

    A diameter is read from where the gel has stood in this grip, whatever the torque is read from.
    """
    if calibration.motion is not None and quantity == "diameter":
        return np.asarray((held / calibration.scale).ravel())
    return columns_for(calibration.estimator, quantity, features)


def _noise_of_a_place(calibration: Calibration) -> float:
    """Return by how much the place of one frame, each feature with a noise of 1, puts a diameter wrong at 95 %.

    A mean of n frames does by a root of n less. That much its interval has to be widened: how far grips go astray was
    seen on means of all their frames, nearly all of which have little noise left. 0 where none is read of places.
    """
    task = calibration.diameter
    if task is None or calibration.motion is None or not isinstance(task.reader.head, Ridge):
        return 0.0
    weights = task.reader.head.weights
    return TWO_SIDED_95 * math.sqrt(weights @ weights)


def _widened(read: tuple[float, float, float], noise: float) -> tuple[float, float, float]:
    """Return a value with an interval that holds so much independent noise beside its own."""
    return read[0], math.hypot(read[1], noise), math.hypot(read[2], noise)


def _estimate(values: dict[str, tuple[float, float, float]], refused: Sequence[str]) -> Estimate:
    if not values:
        return Estimate(valid=False, why=tuple(refused))
    torque, diameter = values.get("torque"), values.get("diameter")
    return Estimate(
        valid=True,
        why=(),
        torque_nm=torque[0] if torque else None,
        torque_low_nm=torque[0] - torque[1] if torque else None,
        torque_high_nm=torque[0] + torque[2] if torque else None,
        diameter_mm=diameter[0] if diameter else None,
        diameter_low_mm=diameter[0] - diameter[1] if diameter else None,
        diameter_high_mm=diameter[0] + diameter[2] if diameter else None,
    )


def _with_place(estimate: Estimate, place: Place | None) -> Estimate:
    if place is None:
        return estimate
    values = {name: getattr(estimate, name) for name in Estimate.__slots__}
    return Estimate(**values | {"k": place.k, "sigma": place.sigma, "score": place.score, "runner_up": place.runner_up})
