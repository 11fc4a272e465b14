"""The tracker that follows one session with a calibration: frames in, estimates out, causally."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatch
from shearloop.bank.estimation.calibrated import (
    LARGEST_TOOL_SHARE,
    Calibration,
    OutputModel,
    Seen,
    columns_for,
    features_of,
)
from shearloop.bank.estimation.imputation import died
from shearloop.bank.estimation.novelty import FAMILIAR, Judgement, NoveltyDetector
from shearloop.bank.estimation.regressors import Ridge
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.values import Estimate, Measured, TactileFrame

_UNITS = {"torque": "N·m", "diameter": "mm"}
_REPEATED = ("the board sent the same frame again",)
_AMBIGUOUS = ("two places of the bank far apart fit the frame equally well",)
# In which what stands for unusable channels may be off, where nothing stands for any.
_NO_WAYS: FloatArray = np.zeros((0, 1, N_CHANNELS))


@dataclass(slots=True)
class _Frame:
    """What quantities are read from: a (m, 896) difference at t_s, what the last frames' motion and its place say.

    held is the (m, 896) mean place of the grip. usable_share of all channels are usable, the others have what these say
    of them, which may be off in the (k, m, 896) ways, each by a standard deviation.
    """

    difference: FloatArray
    moved: FloatArray | None
    usable: BoolArray
    t_s: float
    held: FloatArray
    usable_share: float
    ways: FloatArray
    seen: Seen


class EstimatorSession:
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
        self._memory: SessionState | None = None
        if calibration.kind == "raw":
            self._memory = SessionState(calibration.guards, calibration.motion, self._period_s, idle_frames)
        self._difference: FloatArray | None = None
        self._latest: list[bytes] = []

    def _repeats(self, channels: FloatArray) -> bool:
        """Return whether a side of a (m, 896) frame is that of the frame before to the last digit, and so no new one.

        Noise rules that out in a new one.
        """
        # Bytes that differ are told from each other at the first that does; arrays are compared to their ends.
        before, self._latest = self._latest, [side.tobytes() for side in channels]
        return any(map(operator.eq, self._latest, before))

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
        if self._repeats(frame.channels):
            return Estimate(valid=False, why=_REPEATED)
        moment = self._memory.see(frame)
        if moment.why:
            return Estimate(valid=False, why=moment.why)
        self._difference = moment.difference
        return self._read(moment.difference, self._memory.moved, moment.usable, frame.t_s)

    def _read(self, difference: FloatArray, moved: FloatArray | None, usable: BoolArray, t_s: float) -> Estimate:
        calibration = self.calibration
        wanted, refused = self._wanted(difference, usable)
        if not wanted:
            return Estimate(valid=False, why=tuple(refused))
        usable_share, ways = np.count_nonzero(usable) / usable.size, _NO_WAYS
        if usable_share < 1.0 and calibration.motion is None:
            if missing := self._missed(usable):
                return Estimate(valid=False, why=missing)
            guard = next((task.guard for task, _ in wanted.values() if task.guard is not None), None)
            difference, ways = self._without(usable, difference, guard)
            if self._difference is not None:
                self._difference = difference
        seen = features_of(calibration, self._locator, difference, moved, t_s)
        if seen.place is not None and seen.place.ambiguous:
            return _with_place(Estimate(valid=False, why=_AMBIGUOUS), seen.place)
        held = self._memory.held if self._memory is not None else difference
        frame = _Frame(difference, moved, usable, t_s, held, usable_share, ways, seen)
        values: dict[str, tuple[float, float, float]] = {}
        for name, (task, judged) in wanted.items():
            read, why = self._read_one(name, task, judged, frame)
            refused += [reason for reason in why if reason not in refused]
            if not why:
                values[name] = read
        if calibration.kind == "raw" and calibration.torque is not None and "torque" not in values:
            # What a frame beyond the calibrated torques says of the tool was not calibrated either.
            values.clear()
        return _with_place(_estimate(values, tuple(refused)), seen.place)

    def _wanted(
        self, difference: FloatArray, usable: BoolArray
    ) -> tuple[dict[str, tuple[OutputModel, Judgement]], list[str]]:
        """Return what is to be read of a frame, with how familiar it is, and why all else is not."""
        calibration = self.calibration
        wanted: dict[str, tuple[OutputModel, Judgement]] = {}
        refused: list[str] = []
        for name, task in (("torque", calibration.torque), ("diameter", calibration.diameter)):
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
        return wanted, refused

    def _missed(self, usable: BoolArray) -> tuple[str, ...]:
        """Return why nothing is read where channels have died that an older calibration cannot do without."""
        older = self.calibration.kind == "raw" and self.calibration.filling is None
        return died(self.calibration.guards, usable) if older else ()

    def _read_one(
        self, name: str, task: OutputModel, judged: Judgement, frame: _Frame
    ) -> tuple[tuple[float, float, float], tuple[str, ...]]:
        """Return one quantity with how far its interval reaches below and above, and why it is not to be believed."""
        features = read_from(self.calibration, name, frame.seen.features, frame.held)
        whole = None
        # The paper's place in the bank is that of any multiple of a frame.
        if name == "torque" and judged.missing and self.calibration.estimator != "paper":
            whole = self._features(name, frame.difference / (1.0 - judged.missing), frame)
        read = task.reader.read(features, frame.usable_share, judged.widening, judged.nearness, whole)
        unread: tuple[str, ...] = ()
        if len(frame.ways):
            unsure = self._unsure(name, task, read[0], frame)
            if 2 * unsure > read[1] + read[2]:
                # They told of it, and what the others say of them is a guess.
                unread = died(self.calibration.guards, frame.usable)
            read = _widened(read, unsure)
        if name == "diameter" and self._memory is not None:
            read = _widened(read, self._place_noise_mm / math.sqrt(self._memory.held_frames))
        why = unread or task.refuse_place(frame.seen.place) or task.reader.refuse(read[0], features, name, _UNITS[name])
        return read, why

    def _unsure(self, name: str, task: OutputModel, value: float, frame: _Frame) -> float:
        """Return how far a value may be off at 95 % because of what stands for unusable channels."""
        off = [self._features(name, frame.difference + way, frame) for way in frame.ways]
        return TWO_SIDED_95 * math.hypot(*(task.reader.read(one)[0] - value for one in off))

    def _features(self, name: str, difference: FloatArray, frame: _Frame) -> FloatArray:
        """Return what a quantity would be read from, were this the frame's difference."""
        seen = features_of(self.calibration, self._locator, difference, frame.moved, frame.t_s)
        return read_from(self.calibration, name, seen.features, frame.held)

    def _without(
        self, usable: BoolArray, difference: FloatArray, guard: NoveltyDetector | None
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


def _with_place(estimate: Estimate, place: BankMatch | None) -> Estimate:
    if place is None:
        return estimate
    values = {name: getattr(estimate, name) for name in Estimate.__slots__}
    return Estimate(**values | {"k": place.k, "sigma": place.sigma, "score": place.score, "runner_up": place.runner_up})
