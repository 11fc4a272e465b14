"""The identity of a recording: software, configuration, and every file that the configuration names."""

import hashlib
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from pydantic_core import PydanticSerializationError

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.schema import CONFIGURATION, DIAMETER_NOTE, FORMAT_VERSION

# Configuration keys of files to attach. Secret keys are never attached, and a bank is identified by its hash.
_ATTACHED = ("calibration", "robot", "experiment")
# Calibrations and settings are far smaller.
_LARGEST_ATTACHED_BYTES = 32 << 20


@dataclass(frozen=True, slots=True)
class AttachedFile:
    """A file that is attached to the recording."""

    name: str
    media_type: str
    data: bytes

    @classmethod
    def read(cls, path: Path) -> tuple["AttachedFile", ...]:
        """Return the file, or nothing if it is missing, unreadable or too large."""
        try:
            if not path.is_file() or path.stat().st_size > _LARGEST_ATTACHED_BYTES:
                return ()
            media_type = "application/yaml" if path.suffix in (".yaml", ".yml") else "application/octet-stream"
            return (cls(str(path), media_type, path.read_bytes()),)
        except OSError:
            return ()


@dataclass(frozen=True, slots=True)
class Identity:
    """The metadata and the attachments of a recording."""

    metadata: Mapping[str, str]
    attached: tuple[AttachedFile, ...] = ()


def basic_identity(source: str) -> dict[str, str]:
    """Return the metadata of every recording; `source` describes the origin of the data."""
    return {
        "format_version": FORMAT_VERSION,
        "channel_table_hash": CHANNEL_TABLE_HASH,
        "source": source,
        "software": software_version(),
        "code_sha256": code_digest(),
    }


def daemon_identity(config: DaemonConfig) -> Identity:
    """Return the identity of a daemon's recordings.

    Raises BankError for a bank that cannot be opened, and UserError for a path that is not UTF-8.
    """
    metadata = basic_identity(f"a daemon on {platform.node()}")
    metadata["python"] = f"{platform.python_version()}, numpy {np.__version__}, {platform.machine()}"
    for name, fingertip in config.fingertips.items():
        if fingertip.bank is not None:
            metadata[f"bank_{name}"] = Bank.open(fingertip.bank).identity
    attached = {CONFIGURATION: AttachedFile(CONFIGURATION, "application/json", _as_json(config))}

    for key, path in config.walk():
        if isinstance(path, Path) and key.rpartition(".")[2] in _ATTACHED:
            for file in AttachedFile.read(path):
                attached[file.name] = file
                metadata[f"sha256 {path}"] = hashlib.sha256(file.data).hexdigest()
    return Identity(metadata, tuple(attached.values()))


def experiment_notes(experiment: ExperimentFile) -> dict[str, str]:
    """Return the metadata of an experiment: its tool's diameter, if it names one."""
    return {} if experiment.tool_mm is None else {DIAMETER_NOTE: f"{experiment.tool_mm:g}"}


def software_version() -> str:
    """Return the installed version of shearloop."""
    try:
        return version("shearloop")
    except PackageNotFoundError:
        return "not installed"


@cache
def code_digest() -> str:
    """Return a hash of shearloop's own sources; equal code must give equal replays."""
    root = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for package in ("bank", "drivers", "daemon"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _as_json(config: DaemonConfig) -> bytes:
    try:
        return config.model_dump_json(indent=1).encode()
    except PydanticSerializationError as error:
        folder = config.recording.folder if config.recording is not None else Path()
        raise UserError(
            "a recording keeps the configuration and its paths, and one of them is not UTF-8 (the folder of the "
            f"recordings is {str(folder)!r}); choose another name"
        ) from error
