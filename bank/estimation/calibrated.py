"""A calibration of one estimator: what it knows of its fingertips, and what it makes of a frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.archive import read_archive, write_archive
from shearloop.bank.estimation.bank_match import BankMatch, BankMatcher, BestCell, NearestCell, Registration
from shearloop.bank.estimation.cylinders import is_line
from shearloop.bank.estimation.fingertip_validator import FingertipValidator
from shearloop.bank.estimation.imputation import ChannelImputer
from shearloop.bank.estimation.interval_regressor import IntervalRegressor
from shearloop.bank.estimation.novelty import NoveltyDetector
from shearloop.bank.estimation.temporal_features import TemporalFeatures
from shearloop.bank.estimation.values import Kind

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
class OutputModel:
    """How one quantity is read: its reader, and for differences the guard of those it was fitted to.

    ks are the least and the largest k in cm that frames were found at in the bank, none for an estimator without one.
    """

    reader: IntervalRegressor
    guard: NoveltyDetector | None
    ks: FloatArray

    def refuse_place(self, place: BankMatch | None) -> tuple[str, ...]:
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
    guards: tuple[FingertipValidator, ...]
    motion: TemporalFeatures | None
    image: FloatArray | None
    torque: OutputModel | None
    diameter: OutputModel | None
    filling: ChannelImputer | None = None
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

    def locator(self, bank: Bank | None) -> BankMatcher | None:
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


def locator_for(name: Name, bank: Bank, registration: Registration) -> BankMatcher:
    """Return the locator of an estimator that has one."""
    return BestCell(bank) if name == "paper" else NearestCell(bank, registration)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The features of one frame, and the place in the bank where there is one."""

    features: FloatArray
    place: BankMatch | None = None


def features_of(
    calibration: Calibration, locator: BankMatcher | None, difference: FloatArray, moved: FloatArray | None, t_s: float
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


# The features that each quantity is read from, where that is not all of them: the paper's sigma and its square, and k.
PAPER_COLUMNS = {"torque": slice(1, 3), "diameter": slice(0, 1)}


def columns_for(estimator: Name, quantity: str, features: FloatArray) -> FloatArray:
    """Return those (…, d) features that a quantity is read from."""
    return features[..., PAPER_COLUMNS[quantity]] if estimator == "paper" else features
