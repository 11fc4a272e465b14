"""The bank file: the signals of a basis model over a grid of k and σ, mapped read-only and shared by processes.

Layout, all numbers little-endian:

    0     8 bytes   magic
    8     u64       format version
    16    32 bytes  sha256 of the header
    48    header    JSON, padded with blanks to the end of the first page: the definition, and a table of the arrays
                    (type, shape, offset in the file, sha256)
    4096  arrays    the small ones at multiples of 64, and last the signals at a multiple of the page size:
                    float32 (k × σ × channels), C order

Opening a bank checks the header and the small arrays; the signals are checked on request.
"""

import hashlib
import json
import math
import os
import shlex
import struct
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray
from shearloop.bank.channels import PAPER_TABLE, STIMULATION_CURRENT, ChannelTable
from shearloop.bank.errors import BankFileError, ModelError
from shearloop.bank.models import MODELS, model_named
from shearloop.files import open_file, refusing_damage, replace_file

FORMAT_VERSION = 1
# A signal with a smaller norm (the homogeneous voltages have about 20) has no shape: its correlation is 0/0.
MIN_SIGNAL_NORM = 1e-3

BANK_MAGIC = b"\x8eSHLBANK"
_PREAMBLE = struct.Struct("<8sQ32s")
_ALIGNMENT = 64
_PAGE = 4096
_TYPES = {
    "k_grid": "<f8",
    "sigma_grid": "<f8",
    "homogeneous": "<f8",
    "min_conductivity": "<f8",
    "valid": "|b1",
    "signals": "<f4",
}


@dataclass(frozen=True, slots=True, eq=False)
class BankDefinition:
    """The definition of a bank: the geometry's digest, the basis model, the grids of k (K,) and σ (S,) in its units.

    Raises ModelError for an unknown model, and for a grid that is empty, does not ascend or holds a σ ≤ 0.
    """

    geometry_hash: str
    model: str
    k_grid: FloatArray
    sigma_grid: FloatArray
    table: ChannelTable = PAPER_TABLE

    def __post_init__(self) -> None:
        """Take read-only copies of the grids and check all."""
        model = model_named(self.model)
        for name in ("k_grid", "sigma_grid"):
            grid = np.array(getattr(self, name), dtype=np.float64)
            if grid.ndim != 1 or grid.size == 0 or not np.isfinite(grid).all() or (np.diff(grid) <= 0).any():
                raise ModelError(f"the {name.replace('_', ' ')} must be finite numbers that ascend")
            grid.setflags(write=False)
            object.__setattr__(self, name, grid)
        if self.sigma_grid[0] <= 0 and model.uses_sigma:
            raise ModelError(f"sigma must be above 0 for the model {self.model}, not {self.sigma_grid[0]:g}")

    @property
    def identity(self) -> str:
        """The hash of everything that defines a bank, the same on all machines."""
        defining = {
            "format": FORMAT_VERSION,
            "channel_table": self.table.digest,
            "stimulation_current": STIMULATION_CURRENT,
            "geometry": self.geometry_hash,
            "model": self.model,
            # Twelve digits: the last of a grid's sixteen may differ between machines.
            "k": [f"{k:.11e}" for k in self.k_grid.tolist()],
            "sigma": [f"{sigma:.11e}" for sigma in self.sigma_grid.tolist()],
        }
        return hashlib.sha256(json.dumps(defining, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Bank(BankDefinition):
    """A bank of difference signals v(k, σ) − v_homogeneous; its arrays are read-only.

    signals (K, S, n) float32, zeros in cells that are not valid; homogeneous (n,); min_conductivity (K, S), the
    smallest of each cell's conductivities; valid (K, S), where that is positive and the signal's norm at least
    MIN_SIGNAL_NORM.
    """

    path: Path
    homogeneous: FloatArray
    min_conductivity: FloatArray
    valid: BoolArray
    signals: Float32Array
    signals_sha256: str

    @classmethod
    def open(cls, path: str | Path) -> "Bank":
        """Map a bank file read-only, and compare its checksums.

        Raises BankFileError for a file that is missing, not a bank, truncated, damaged, or made under another format
        or channel table.
        """
        path = Path(path)
        damage = f"its header does not describe a bank ({{}}); {how_to_build(path)}"
        # One descriptor: a bank that replaces this one meanwhile does not mix with it.
        with (
            refusing_damage(path, BankFileError, "the bank", damage, missing=f"; {how_to_build(path)}"),
            open_file(path) as file,
        ):
            header = _read_header(path, file)
            arrays = {name: _read_array(path, file, name, header["arrays"][name]) for name in _TYPES}
            checksums = {name: str(header["arrays"][name]["sha256"]) for name in _TYPES}
            identity = str(header["identity"])
            bank = cls(
                geometry_hash=header["geometry"],
                model=header["model"],
                table=ChannelTable(**header.get("channels", {})),
                path=path,
                signals_sha256=checksums["signals"],
                **arrays,
            )
        for name, array in arrays.items():
            if _sha256(array) != checksums[name]:
                raise _unusable(path, f"the file is damaged: the checksum of {name} is not {checksums[name][:12]}…")
        if header.get("channel_table") != bank.table.digest:
            raise _unusable(
                path,
                f"the bank was made under the channel table {str(header.get('channel_table'))[:12]}…, expected "
                f"{bank.table.digest[:12]}…",
            )
        if bank.identity != identity:
            raise _unusable(path, f"its grids, model and geometry do not give its identity {identity[:12]}…")
        cells, channels = (bank.k_grid.size, bank.sigma_grid.size), (bank.table.n_channels,)
        shapes = {"homogeneous": channels, "min_conductivity": cells, "valid": cells, "signals": cells + channels}
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise _unusable(path, f"{name} has the shape {arrays[name].shape}, expected {shape}")
            if not np.isfinite(arrays[name]).all():
                raise _unusable(path, f"{name} has values that are not finite numbers")
        return bank


def write_bank(
    path: Path,
    definition: BankDefinition,
    homogeneous: FloatArray,
    min_conductivity: FloatArray,
    valid: BoolArray,
    signals: Float32Array,
) -> None:
    """Write a bank file, replacing an earlier one at once. Raises BankFileError where it cannot be written."""
    arrays = definition.k_grid, definition.sigma_grid, homogeneous, min_conductivity, valid, signals
    stored = {
        name: np.ascontiguousarray(array, dtype=kind)
        for (name, kind), array in zip(_TYPES.items(), arrays, strict=True)
    }
    header, offsets = _layout(definition, stored)
    preamble = _PREAMBLE.pack(BANK_MAGIC, FORMAT_VERSION, hashlib.sha256(header).digest())
    try:
        with replace_file(path) as file:
            file.write(preamble + header)
            for key, array in stored.items():
                file.write(b"\0" * (offsets[key] - file.tell()))
                file.write(array.data)
    except OSError as error:
        raise BankFileError(f"{path}: the bank cannot be written: {error.strerror}; choose another --out") from error


def _layout(definition: BankDefinition, stored: dict[str, NDArray[Any]]) -> tuple[bytes, dict[str, int]]:
    offsets, end = {}, _PAGE
    for name, array in stored.items():
        alignment = _PAGE if name == "signals" else _ALIGNMENT
        offsets[name] = -(-end // alignment) * alignment
        end = offsets[name] + array.nbytes
    header = {
        "identity": definition.identity,
        "channels": asdict(definition.table),
        "channel_table": definition.table.digest,
        "geometry": definition.geometry_hash,
        "model": definition.model,
        "k_unit": MODELS[definition.model].k_unit,
        "sigma_unit": MODELS[definition.model].sigma_unit,
        "arrays": {
            name: {"type": _TYPES[name], "shape": array.shape, "offset": offsets[name], "sha256": _sha256(array)}
            for name, array in stored.items()
        },
    }
    # About 1.4 kB for every bank: nothing in it has a length that the user chooses.
    return json.dumps(header).encode().ljust(_PAGE - _PREAMBLE.size), offsets


def _read_header(path: Path, file: BinaryIO) -> dict[str, Any]:
    page = file.read(_PAGE)
    if not page.startswith(BANK_MAGIC):
        # The cure must not overwrite a foreign file.
        raise BankFileError(
            f"{path}: this is not a bank: expected a file that starts with shearloop's mark of one; name a bank, or "
            "make one with `shearloop bank build --config FILE --out NAME.bank`"
        )
    if len(page) < _PAGE:
        raise _unusable(path, f"the file is truncated: expected a header of {_PAGE} bytes, found {len(page)}")
    _, version, checksum = _PREAMBLE.unpack_from(page)
    if version != FORMAT_VERSION:
        raise _unusable(path, f"the bank has format version {version}, expected {FORMAT_VERSION}")
    text = page[_PREAMBLE.size :]
    if hashlib.sha256(text).digest() != checksum:
        raise _unusable(path, "the file is damaged: its header does not have the expected checksum")
    header: dict[str, Any] = json.loads(text)
    return header


def _read_array(path: Path, file: BinaryIO, name: str, entry: dict[str, Any]) -> NDArray[Any]:
    """Return one array of the file: the signals mapped, the small ones read."""
    kind, shape, offset = np.dtype(_TYPES[name]), tuple(entry["shape"]), entry["offset"]
    if offset < 0:
        raise ValueError(f"{name} begins at {offset}")
    expected, size = offset + kind.itemsize * math.prod(shape), os.fstat(file.fileno()).st_size
    if size < expected or (name == "signals" and size != expected):
        raise _unusable(path, f"the file is truncated or has grown: expected {expected} bytes, found {size}")
    if name == "signals":
        return np.memmap(file, dtype=kind, mode="r", offset=offset, shape=shape)
    file.seek(offset)
    array: NDArray[Any] = np.frombuffer(file.read(expected - offset), dtype=kind).reshape(shape)
    return array


def _sha256(array: NDArray[Any]) -> str:
    return hashlib.sha256(array.data).hexdigest()


def how_to_build(path: Path) -> str:
    """Return a sentence with the command that builds a bank, from the definition with its name where there is one."""
    folders = path.parent / "banks", path.parent, path.parent.parent / "config" / "banks"
    definitions = [folder / f"{path.stem}.yaml" for folder in folders]
    named = next((definition for definition in definitions if definition.is_file()), None)
    example = ", from a FILE such as banks/paper.yaml" if named is None else ""
    definition = "FILE" if named is None else shlex.quote(str(named))
    return f"build it with `shearloop bank build --config {definition} --out {shlex.quote(str(path))}`{example}"


def _unusable(path: Path, why: str) -> BankFileError:
    return BankFileError(f"{path}: {why}; {how_to_build(path)}")
