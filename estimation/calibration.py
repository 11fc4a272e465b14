"""Calibration of one estimator: its fingertips, its outputs, and its file.

The file is a zip of a YAML header and NumPy arrays; the zip holds their checksums. It keeps any tree of frozen
dataclasses of numbers, texts, tuples and arrays. Equal calibrations are equal bytes: no dates, fixed order, no
compression.
"""

import io
import math
import os
import types
import zipfile
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from numpy.typing import NDArray

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.bank_match import BankMatcher
from shearloop.estimation.estimator import Estimator, OutputModel, PaperEstimator, Quantity
from shearloop.estimation.estimator_names import estimator_class
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.gain import GainCorrection, ToolLaw
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.estimation.values import INLINE, Kind, Measured
from shearloop.files import open_file, refusing_damage, replace_file
from shearloop.yaml_files import parse_yaml, shown

FORMAT_VERSION = 10
# First bytes of a zip that is not empty.
ARCHIVE_MAGIC = b"PK\x03\x04"
_FILE_KIND = "shearloop estimator calibration"
_HEADER = "calibration.yaml"
# Calibrations take some MB.
_LARGEST_BYTES = 64 << 20

# What the user guarantees, with the end of a sentence that says so.
Assumption = Literal["full range", "load timing"]
_ASSUMPTION_TEXTS: dict[Assumption, str] = {
    "full range": "no torque exceeds its slices (--assume-full-range)",
    "load timing": "the load cell's delay is as given (--load-cell-delay-s)",
}
# Tools differ if their diameters differ by a larger share.
LARGEST_TOOL_SHARE = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """An estimator with its fingertips and the models of its outputs; `source` describes the data in words.

    sides is empty where nothing is known of the fingertip (`uncalibrated`). validators are for raw frames.
    bank_identity is empty for an estimator without a bank. tool_mm is the diameter of the only tool in the recordings,
    else NaN. With `tools` the torque is in units of their gain (`for_tool`). `profile` is the torque without a sensor.
    """

    estimator: Estimator = field(metadata=INLINE)
    kind: Kind
    sides: tuple[str, ...]
    source: str
    bank_identity: str
    tool_mm: float = np.nan
    validators: tuple[FingertipValidator, ...] = ()
    torque: OutputModel | None = None
    diameter: OutputModel | None = None
    assumptions: tuple[Assumption, ...] = ()
    tools: ToolLaw | None = None
    profile: TorqueProfile | None = None

    def for_tool(self, tool: Measured | None) -> Self:
        """Return the calibration for a tool, itself where it is made for that tool; else raises CalibrationError.

        On a tool of another diameter the same motion of the gel is another torque: four times as much on one of 10 mm
        as on one of 20 mm.
        """
        law, own_mm = self.tools, self.tool_mm
        if law is None or self.torque is None:
            if tool is None or not abs(tool.value - own_mm) > LARGEST_TOOL_SHARE * own_mm + tool.half_width:
                return self
            raise CalibrationError(
                f"the tool has {tool.value:.3g} mm, and the calibration was made with a tool of {own_mm:g} mm; its "
                "torque differs: calibrate with this tool"
            )
        tools = f"tools of {law.low_mm:g} to {law.high_mm:g} mm, whose torques differ"
        if tool is None:
            raise CalibrationError(
                f"there is no torque without the tool's diameter, because the calibration is of {tools}: name the "
                "tool's diameter, or let a calibrated gripper measure it"
            )
        if (gain := law.gain(tool.value)) is None:
            raise CalibrationError(
                f"the tool has {tool.value:.3g} mm, too far from the calibration's {tools}: calibrate with this tool"
            )
        regressor = self.torque.regressor.scaled(gain, law.spread)
        return replace(self, torque=replace(self.torque, regressor=regressor), tools=None, tool_mm=tool.value)

    def gain_regressor(self) -> IntervalRegressor:
        """Return the torque's regressor, for a correction of its gain; raises CalibrationError without one."""
        if self.kind == "raw" and self.torque is not None:
            return self.torque.regressor
        raise CalibrationError("only the torque of raw frames has a gain to correct; calibrate on raw recordings")

    def correct_gain(
        self, features: FloatArray, torque_nm: FloatArray, first: BoolArray | None = None
    ) -> tuple[Self, GainCorrection]:
        """Return the calibration with the gain of each side corrected by (n, d) features of known torques (n,).

        `first` (n,) marks frames of the first twist after a grip. Raises CalibrationError as `gain_regressor` does,
        without a load that is large enough to show the gain, and for twists that do not narrow it.
        """
        torque, regressor = self.torque, self.gain_regressor()
        sides = self.estimator.side_of_features(len(regressor.mean_feature))
        adapted, correction = regressor.adapt(features, torque_nm, sides, first)
        return replace(self, torque=torque and replace(torque, regressor=adapted)), correction

    @classmethod
    def uncalibrated(cls, bank_identity: str, table: ChannelTable = PAPER_TABLE) -> Self:
        """Return the paper's estimator on a bank without any fit: it gives k and sigma alone."""
        return cls(PaperEstimator(np.ones((1, table.n_channels)), table), "raw", (), "", bank_identity)

    @property
    def table(self) -> ChannelTable:
        """The fingertip's channels."""
        return self.estimator.table

    @property
    def measures_torque(self) -> bool:
        """Whether it gives torques, and not only diameters or positions in a bank."""
        return self.torque is not None

    @property
    def outputs(self) -> dict[Quantity, OutputModel]:
        """The model of each quantity that the estimator gives."""
        models: dict[Quantity, OutputModel | None] = {"torque": self.torque, "diameter": self.diameter}
        return {quantity: model for quantity, model in models.items() if model is not None}

    @property
    def assumption_text(self) -> str:
        """The user's guarantees as part of a sentence, empty without any."""
        return " and ".join(_ASSUMPTION_TEXTS[one] for one in self.assumptions)

    def save(self, path: str | Path) -> None:
        """Write the file, the same bytes for the same calibration; CalibrationError where that fails."""
        path = Path(path)
        arrays: dict[str, NDArray[Any]] = {}
        header = {
            "kind": _FILE_KIND,
            "format_version": FORMAT_VERSION,
            "channel_table": self.estimator.table.digest,
            "content": _to_plain(self, "", arrays),
        }
        try:
            with replace_file(path) as file, zipfile.ZipFile(file, "w") as archive:
                text = yaml.safe_dump(header, sort_keys=False, allow_unicode=True, width=120)
                archive.writestr(zipfile.ZipInfo(_HEADER), text)
                for name, array in sorted(arrays.items()):
                    with archive.open(f"{name}.npy", "w") as member:
                        np.save(member, np.ascontiguousarray(array), allow_pickle=False)
        except OSError as error:
            raise CalibrationError(
                f"{path}: the calibration cannot be written: {error.strerror}; choose another --out"
            ) from error

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration.

        Raises CalibrationError, naming the file, where it is missing, truncated, damaged, foreign, of another format
        version, or made with another channel table.
        """
        path = Path(path)
        damage = "this is not a calibration, or it is truncated or damaged ({}); calibrate again"
        missing = f"; make one with `shearloop calibrate REC… --out {path}`"
        with refusing_damage(path, CalibrationError, "the calibration", damage, missing):
            header, arrays = _read_members(path)
        if not isinstance(header, dict) or header.get("kind") != _FILE_KIND:
            raise CalibrationError(f"{path} is not an estimator's calibration: make one with `shearloop calibrate`")
        version = header.get("format_version")
        if version != FORMAT_VERSION:
            raise CalibrationError(
                f"{path}: the calibration has format version {shown(version)}, expected {FORMAT_VERSION}; "
                "calibrate again"
            )
        damage = (
            "the file does not describe a calibration of this version ({}); use the version that wrote it, or "
            "calibrate again"
        )
        with refusing_damage(path, CalibrationError, "the calibration", damage):
            restored: Self = _from_plain(cls, header["content"], "", arrays)
            restored.check_shapes()
        table, expected = str(header.get("channel_table")), restored.estimator.table.digest
        if table != expected:
            raise CalibrationError(
                f"{path}: the calibration was made with the channel table {table[:12]}…, expected {expected[:12]}…; "
                "calibrate again"
            )
        return restored

    def check_shapes(self) -> None:
        """Raise ValueError where arrays do not fit together, as in a file that another program wrote."""
        c, m = self.estimator.table.n_channels, max(len(self.sides), 1)
        rows = [a for one in self.validators for a in (one.idle, one.gripped, one.noise, one.grip_weights)]
        whole = self.estimator.scale.shape == (m, c) and all(row.shape == (c,) for row in rows)
        if not whole or len(self.validators) not in (0, len(self.sides)):
            raise ValueError(f"it is of {len(self.sides)} sides of {c} channels, and its arrays have other shapes")
        if self.estimator.imputer is not None:
            self.estimator.imputer.check_shapes(m, c)
        for quantity, model in self.outputs.items():
            width, found = self.estimator.feature_width(quantity), len(model.regressor.mean_feature)
            if width not in (None, found):
                raise ValueError(f"the regressor of the {quantity} has {found} inputs, expected {width}")
            if model.k_range.shape not in ((0,), (2,)):
                raise ValueError(f"k_range has the shape {model.k_range.shape}, expected two values")
            if model.novelty is not None:
                model.novelty.reasons(np.ones(c), np.ones(c, dtype=np.bool_))
            regressor = model.regressor
            value, below, above = regressor.predict(regressor.mean_feature)
            regressor.range_reasons(value, regressor.mean_feature, "torque", "")
            if not math.isfinite(value) or math.isnan(below + above):
                raise ValueError("its coefficients give no finite value")

    def check_bank(self, bank: Bank | None) -> Bank:
        """Return the bank; raises CalibrationError where it is missing or not the calibration's."""
        if bank is None:
            raise CalibrationError(f"the estimator {self.estimator.name} needs its bank; name it with --bank")
        if bank.identity != self.bank_identity:
            raise CalibrationError(
                f"the calibration was made with the bank {self.bank_identity[:12]}…, and {bank.path} is "
                f"{bank.identity[:12]}…; name the bank it was made with, or calibrate again"
            )
        return bank

    def matcher(self, bank: Bank | None) -> BankMatcher | None:
        """Return the matcher of an estimator that needs a bank, None for others; raises as `check_bank` does."""
        return self.estimator.matcher(self.check_bank(bank)) if self.estimator.needs == "bank" else None


def _read_members(path: Path) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return header and arrays; the zip compares their checksums."""
    with open_file(path) as file, zipfile.ZipFile(file) as archive:
        members, size = archive.infolist(), os.fstat(file.fileno()).st_size
        # Stored members are no larger than the file; compressed or overlapping ones may fill the memory.
        if sum(member.file_size for member in members) > size or any(member.compress_type for member in members):
            raise ValueError("its members are larger than the file, or compressed")
        if size > _LARGEST_BYTES:
            raise ValueError(f"it is larger than {_LARGEST_BYTES >> 20} MB")
        arrays: dict[str, NDArray[Any]] = {
            name.removesuffix(".npy"): np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
            for name in archive.namelist()
            if name != _HEADER
        }
        return parse_yaml(archive.read(_HEADER)), arrays


def _to_plain(value: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return YAML's view of a value; its arrays go into `arrays` by their path."""
    if is_dataclass(value):
        plain = {"estimator": value.name} if isinstance(value, Estimator) else {}
        for one in fields(value):
            part = getattr(value, one.name)
            if one.metadata == INLINE:
                plain |= _to_plain(part, path, arrays)
            else:
                plain[one.name] = _to_plain(part, f"{path}/{one.name}", arrays)
        return plain
    if isinstance(value, np.ndarray):
        name = path.strip("/").replace("/", ".")
        arrays[name] = value
        return {"array": name}
    if isinstance(value, tuple):
        return [_to_plain(item, f"{path}/{i}", arrays) for i, item in enumerate(value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"{path}: a {type(value).__name__} cannot be kept in a calibration")


def _from_plain(kind: Any, plain: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return the value of type `kind` that `_to_plain` made plain."""
    origin, name = get_origin(kind), path.strip("/")
    if origin in (Union, types.UnionType):
        choices = [choice for choice in get_args(kind) if choice is not type(None)]
        if plain is None:
            return None
        if len(choices) > 1:  # several dataclasses: the one with these fields
            choices = [choice for choice in choices if _names(choice) == set(plain)]
        return _from_plain(choices[0], plain, path, arrays)
    if origin is Literal and plain not in get_args(kind):
        raise ValueError(f"{name} is {shown(plain)}, which this version does not know")
    if origin is tuple:
        if not isinstance(plain, list):
            raise TypeError(f"{name} is not a list")
        return tuple(_from_plain(get_args(kind)[0], item, f"{path}/{i}", arrays) for i, item in enumerate(plain))
    if isinstance(plain, dict) and set(plain) == {"array"}:
        return _checked(arrays[plain["array"]], kind, name)
    if is_dataclass(kind):
        kind = estimator_class(plain["estimator"]) if kind is Estimator else kind
        hints, values = get_type_hints(kind), {}
        for one in fields(kind):
            if one.metadata == INLINE:
                values[one.name] = _from_plain(hints[one.name], plain, path, arrays)
            elif isinstance(one.default, float) and math.isnan(one.default):
                values[one.name] = float(plain.get(one.name, one.default))  # may be unknown
            elif one.name in plain or one.default is MISSING:
                values[one.name] = _from_plain(hints[one.name], plain[one.name], f"{path}/{one.name}", arrays)
        return kind(**values)
    if kind is float and type(plain) in (int, float) and not math.isnan(plain):
        return float(plain)
    if origin is not Literal and (kind is float or kind is not type(plain)):
        raise TypeError(f"{name} is {shown(plain)}, expected a value of type {kind.__name__}")
    return plain


def _checked(array: NDArray[Any], kind: Any, name: str) -> NDArray[Any]:
    """Return the array, read-only; raises ValueError where its numbers do not have the type `kind`."""
    expected = kind
    while arguments := get_args(expected):  # NDArray, and its dtype before NumPy 2.5
        expected = arguments[-1]
    if array.dtype != expected or np.isnan(array).any():
        raise ValueError(f"{name} holds {array.dtype}, expected {expected.__name__} without NaN")
    array.setflags(write=False)
    return array


def _names(kind: Any) -> set[str]:
    """Return the names of a dataclass's values in the file."""
    found = [_names(one.type) if one.metadata == INLINE else {one.name} for one in fields(kind)]
    return set().union(*found)
