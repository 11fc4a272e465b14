"""One deterministic file for a calibration: a zip of a YAML header and NumPy arrays, checksum included.

Any tree of frozen dataclasses of numbers, texts, tuples and arrays can be kept: arrays become members of the zip, all
else stands in the header. Equal calibrations are equal bytes: fixed dates, fixed order, no compression.
"""

import hashlib
import io
import types
import zipfile
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from numpy.typing import NDArray

from shearloop.bank.eit.stored import check_made_with, check_version
from shearloop.bank.errors import CalibrationError
from shearloop.files import replace_file

FORMAT_VERSION = 3
_KIND = "shearloop estimator calibration"
# How a zip begins that has something in it.
ARCHIVE_MAGIC = b"PK\x03\x04"
_HEADER = "calibration.yaml"
_DATE = (1980, 1, 1, 0, 0, 0)

T = TypeVar("T")


def write_archive(path: str | Path, identities: Mapping[str, str], content: Any) -> None:
    """Write a tree of dataclasses over what was there; CalibrationError where it fails."""
    path = Path(path)
    arrays: dict[str, NDArray[Any]] = {}
    plain = _plain(content, "", arrays)
    members = {f"{name}.npy": _bytes_of(array) for name, array in sorted(arrays.items())}
    header = {
        "kind": _KIND,
        "format_version": FORMAT_VERSION,
        **identities,
        "content": plain,
        "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in members.items()},
    }
    text = yaml.safe_dump(header, sort_keys=False, allow_unicode=True, width=120).encode()
    try:
        with replace_file(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in {_HEADER: text, **members}.items():
                archive.writestr(zipfile.ZipInfo(name, _DATE), data)
    except OSError as error:
        raise CalibrationError(
            f"{path}: the calibration cannot be written: {error.strerror}; choose another --out"
        ) from error


def read_archive(path: str | Path, identities: Mapping[str, str], kind: type[T]) -> T:
    """Return the tree of dataclasses of a file whose identities are these.

    Raises CalibrationError, naming the file, when it is missing, truncated, damaged, foreign, of another format, or
    made with another channel table.
    """
    path = Path(path)
    header, arrays = _members(path)
    if header.get("kind") != _KIND:
        raise CalibrationError(f"{path} is not an estimator's calibration: make one with `shearloop calibrate`")
    check_version(path, header, FORMAT_VERSION)
    check_made_with(path, header, identities)
    try:
        restored: T = _restored(kind, header["content"], "", arrays)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise CalibrationError(
            f"{path}: the file does not describe a calibration of this version ({error}); use the version that "
            "wrote it, or calibrate again"
        ) from error
    return restored


def _members(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return header and arrays, each checked against its checksum."""
    try:
        with zipfile.ZipFile(path) as archive:
            found = {name: archive.read(name) for name in archive.namelist()}
    except OSError as error:
        raise CalibrationError(f"{path}: the calibration cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
        raise CalibrationError(
            f"{path}: this is not a calibration, or it is truncated or damaged ({error}); calibrate again"
        ) from error
    try:
        header = yaml.safe_load(found.pop(_HEADER, b""))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: the header is not YAML; calibrate again") from error
    if not isinstance(header, dict):
        raise CalibrationError(f"{path} is not a calibration: it has no header; make one with `shearloop calibrate`")
    checksums = header.get("sha256")
    if not isinstance(checksums, dict) or set(checksums) != set(found):
        raise CalibrationError(f"{path}: the calibration lacks some of its arrays; calibrate again")
    for name, data in found.items():
        if hashlib.sha256(data).hexdigest() != checksums[name]:
            raise CalibrationError(f"{path}: the calibration is damaged: {name} is not what was written")
    arrays = {name.removesuffix(".npy"): np.load(io.BytesIO(data), allow_pickle=False) for name, data in found.items()}
    return header, arrays


def _bytes_of(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def _plain(value: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    if is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name), f"{path}/{item.name}", arrays) for item in fields(value)}
    if isinstance(value, np.ndarray):
        name = path.strip("/").replace("/", ".")
        arrays[name] = value
        return {"array": name}
    if isinstance(value, tuple):
        return [_plain(item, f"{path}/{i}", arrays) for i, item in enumerate(value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(f"{path}: a {type(value).__name__} cannot be kept in a calibration")


def _restored(kind: Any, plain: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    origin = get_origin(kind)
    if origin in (Union, types.UnionType):
        choices = [choice for choice in get_args(kind) if choice is not type(None)]
        if plain is None:
            return None
        if len(choices) == 1:
            return _restored(choices[0], plain, path, arrays)
        # Of several dataclasses, the one whose fields these are.
        chosen = next(choice for choice in choices if {item.name for item in fields(choice)} == set(plain))
        return _restored(chosen, plain, path, arrays)
    if origin is Literal and plain not in get_args(kind):
        name = path.strip("/")
        raise ValueError(f"{name} is {plain!r}, which this version does not know")
    if origin is tuple:
        if not isinstance(plain, list):
            raise TypeError(f"{path.strip('/')} is no list")
        inner = get_args(kind)[0]
        return tuple(_restored(inner, item, f"{path}/{i}", arrays) for i, item in enumerate(plain))
    if isinstance(plain, dict) and set(plain) == {"array"}:
        array = arrays[plain["array"]]
        array.setflags(write=False)
        return array
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(  # type: ignore[operator]  # a dataclass is its own constructor
            **{
                item.name: _restored(hints[item.name], plain[item.name], f"{path}/{item.name}", arrays)
                for item in fields(kind)
                # What a file lacks that was not there when it was written has its default.
                if item.name in plain or item.default is MISSING
            }
        )
    if kind is float:
        return float(plain)
    if not isinstance(plain, str | bool | int | float | list) and plain is not None:
        raise TypeError(f"{path} is a {type(plain).__name__}")
    return plain
