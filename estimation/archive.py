"""The file of a calibration: a zip of a YAML header and NumPy arrays, which keeps a tree of frozen dataclasses.

The zip holds the arrays' checksums. Values are numbers, texts, tuples and arrays. Equal calibrations are equal bytes:
no dates, fixed order, no compression.
"""

import io
import math
import os
import shlex
import types
import zipfile
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from numpy.typing import NDArray

from shearloop.bank.errors import CalibrationError
from shearloop.estimation.estimator import Estimator
from shearloop.estimation.values import INLINE
from shearloop.files import open_file, refusing_damage, replace_file
from shearloop.words import shown
from shearloop.yaml_loader import parse_yaml

# First bytes of a zip that is not empty.
ARCHIVE_MAGIC = b"PK\x03\x04"
_HEADER = "calibration.yaml"
# Calibrations take some MB.
_LARGEST_BYTES = 64 << 20
_PREFIX = "shearloop "

Content = TypeVar("Content")
EstimatorClass = Callable[[str], type[Estimator]]


@dataclass(frozen=True, slots=True)
class Format:
    """A kind of file with its version, and the class of each estimator that it may name."""

    kind: str
    version: int
    estimator_class: EstimatorClass

    def save(self, path: Path, content: object, channel_table: str) -> None:
        """Write a dataclass, the same bytes for the same content; CalibrationError where that fails."""
        arrays: dict[str, NDArray[Any]] = {}
        header = {
            "kind": _PREFIX + self.kind,
            "format_version": self.version,
            "channel_table": channel_table,
            "content": _to_plain(content, "", arrays),
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
                f"{path}: the calibration cannot be written: {error.strerror}; choose another path"
            ) from error

    def load(
        self, path: Path, kind: type[Content], check: Callable[[Content], None], table_of: Callable[[Content], str]
    ) -> Content:
        """Return the dataclass of a file; `check` raises ValueError for arrays that do not fit together.

        Raises CalibrationError, naming the file, where it is missing, truncated, damaged, foreign, of another format
        version, or made with another channel table than `table_of` the content.
        """
        header, arrays = _read(path)
        found = header.get("kind")
        if found != _PREFIX + self.kind:
            other = str(found).removeprefix(_PREFIX)
            raise CalibrationError(
                f"{path} is of the kind {shown(other)}, not {self.kind!r}; make one with `shearloop calibrate`"
            )
        version = header.get("format_version")
        if version != self.version:
            raise CalibrationError(
                f"{path}: the calibration has format version {shown(version)}, expected {self.version}; calibrate again"
            )
        damage = (
            "the file does not describe a calibration of this version ({}); use the version that wrote it, or "
            "calibrate again"
        )
        with refusing_damage(path, CalibrationError, "the calibration", damage):
            restored: Content = _Plain(arrays, self.estimator_class).value(kind, header["content"], "")
            check(restored)
        table, expected = str(header.get("channel_table")), table_of(restored)
        if table != expected:
            raise CalibrationError(
                f"{path}: the calibration was made with the channel table {table[:12]}…, expected {expected[:12]}…; "
                "calibrate again"
            )
        return restored


def kind_of(path: Path) -> str:
    """Return the kind of a calibration's file; raises CalibrationError for a file that cannot be read as one."""
    return str(_read(path)[0].get("kind")).removeprefix(_PREFIX)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return header and arrays; raises CalibrationError for a file that is missing, truncated or no calibration."""
    damage = "this is not a calibration, or it is truncated or damaged ({}); calibrate again"
    missing = f"; make one with `shearloop calibrate REC… --out {shlex.quote(str(path))}`"
    with refusing_damage(path, CalibrationError, "the calibration", damage, missing):
        header, arrays = _read_members(path)
    if not isinstance(header, dict) or not str(header.get("kind")).startswith(_PREFIX):
        raise CalibrationError(f"{path} is not an estimator's calibration: make one with `shearloop calibrate`")
    return header, arrays


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
        for field in fields(value):
            part = getattr(value, field.name)
            if field.metadata == INLINE:
                plain |= _to_plain(part, path, arrays)
            else:
                plain[field.name] = _to_plain(part, f"{path}/{field.name}", arrays)
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


@dataclass(frozen=True, slots=True)
class _Plain:
    """Turns YAML's view of values back into values, with the arrays and the classes of estimators."""

    arrays: dict[str, NDArray[Any]]
    estimator_class: EstimatorClass

    def value(self, kind: Any, plain: Any, path: str) -> Any:
        """Return the value of type `kind` that `_to_plain` made plain."""
        origin, name = get_origin(kind), path.strip("/")
        if origin in (Union, types.UnionType):
            choices = [choice for choice in get_args(kind) if choice is not type(None)]
            if plain is None:
                return None
            if len(choices) > 1:  # several dataclasses: the one with these fields
                choices = [choice for choice in choices if _names(choice) == set(plain)]
            return self.value(choices[0], plain, path)
        if origin is Literal and plain not in get_args(kind):
            raise ValueError(f"{name} is {shown(plain)}, which this version does not know")
        if origin is tuple:
            if not isinstance(plain, list):
                raise TypeError(f"{name} is not a list")
            return tuple(self.value(get_args(kind)[0], item, f"{path}/{i}") for i, item in enumerate(plain))
        if isinstance(plain, dict) and set(plain) == {"array"}:
            return _checked(self.arrays[plain["array"]], kind, name)
        if is_dataclass(kind):
            return self._dataclass(kind, plain, path)
        if kind is float and type(plain) in (int, float) and not math.isnan(plain):
            return float(plain)
        if origin is not Literal and (kind is float or kind is not type(plain)):
            raise TypeError(f"{name} is {shown(plain)}, expected a value of type {kind.__name__}")
        return plain

    def _dataclass(self, kind: Any, plain: Any, path: str) -> Any:
        kind = self.estimator_class(plain["estimator"]) if kind is Estimator else kind
        hints, values = get_type_hints(kind), {}
        for field in fields(kind):
            if field.metadata == INLINE:
                values[field.name] = self.value(hints[field.name], plain, path)
            elif isinstance(field.default, float) and math.isnan(field.default):
                values[field.name] = float(plain.get(field.name, field.default))  # may be unknown
            elif field.name in plain or field.default is MISSING:
                values[field.name] = self.value(hints[field.name], plain[field.name], f"{path}/{field.name}")
        return kind(**values)


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
    found = [_names(field.type) if field.metadata == INLINE else {field.name} for field in fields(kind)]
    return set().union(*found)
