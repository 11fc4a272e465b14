"""What a recording was made with: software, configuration, and every file that the configuration names."""

import hashlib
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from pydantic_core import PydanticSerializationError

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.config_file import ConfigModel
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.schema import CONFIGURATION, DIAMETER_NOTE, FORMAT_VERSION

_PACKAGES = ("bank", "drivers", "daemon")
# Keys of the configuration whose files are attached. Never a secret key; and a bank is named by its hash.
_ATTACHED = ("calibration", "robot", "experiment")
# Calibrations and settings are far smaller.
_LARGEST_ATTACHED_BYTES = 32 << 20


@dataclass(frozen=True, slots=True)
class Attached:
    """A file that goes into the recording whole."""

    name: str
    media_type: str
    data: bytes

    @classmethod
    def if_there(cls, path: Path) -> tuple["Attached", ...]:
        """Read a file; nothing where it cannot be read, is no file or too large."""
        try:
            if not path.is_file() or path.stat().st_size > _LARGEST_ATTACHED_BYTES:
                return ()
            media_type = "application/yaml" if path.suffix in (".yaml", ".yml") else "application/octet-stream"
            return (cls(str(path), media_type, path.read_bytes()),)
        except OSError:
            return ()


@dataclass(frozen=True, slots=True)
class Identity:
    """The metadata of a recording, and what is attached to it."""

    metadata: Mapping[str, str]
    attached: tuple[Attached, ...] = ()


def basic_identity(source: str) -> dict[str, str]:
    """Return the metadata that every recording has; `source` says in words where the data is from."""
    return {
        "format_version": FORMAT_VERSION,
        "channel_table_hash": CHANNEL_TABLE_HASH,
        "source": source,
        "software": software_version(),
        "code_sha256": code_digest(),
    }


def identity_of(config: DaemonConfig) -> Identity:
    """Return the identity of a daemon's recordings.

    Raises BankError for a bank that cannot be opened, and UserError for a path that is no text in UTF-8.
    """
    metadata = basic_identity(f"a daemon on {platform.node()}")
    metadata["python"] = f"{platform.python_version()}, numpy {np.__version__}, {platform.machine()}"
    for name, fingertip in config.fingertips.items():
        if fingertip.bank is not None:
            metadata[f"bank_{name}"] = Bank.open(fingertip.bank).identity
    attached = [Attached(CONFIGURATION, "application/json", _as_json(config))]
    for path in dict.fromkeys(_files(config)):
        for one in Attached.if_there(path):
            attached.append(one)
            metadata[f"sha256 {path}"] = hashlib.sha256(one.data).hexdigest()
    return Identity(metadata, tuple(attached))


def _as_json(config: DaemonConfig) -> bytes:
    """Return the configuration as JSON, which is UTF-8; raises UserError where it names a path that is not."""
    try:
        return config.model_dump_json(indent=1).encode()
    except PydanticSerializationError as error:
        folder = config.recording.folder if config.recording is not None else Path()
        raise UserError(
            "a recording keeps the configuration with the paths in it, and one of them is no text in UTF-8 (it records "
            f"into {str(folder)!r}); choose another name"
        ) from error


def notes_of(experiment: ExperimentFile) -> dict[str, str]:
    """Return what an experiment tells beside its steps that whoever reads its recording should know."""
    return {} if experiment.tool_mm is None else {DIAMETER_NOTE: f"{experiment.tool_mm:g}"}


def software_version() -> str:
    """Return the version of this program, as it was installed."""
    try:
        return version("shearloop")
    except PackageNotFoundError:
        return "not installed"


@cache
def code_digest() -> str:
    """Return a hash of the program's own sources: what made two recordings is the same only where it is the same."""
    root = Path(str(resources.files("shearloop")))
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _files(section: ConfigModel) -> Iterator[Path]:
    """Yield the files named in a configuration that go into a recording."""
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Path) and name in _ATTACHED:
            yield value
        elif isinstance(value, ConfigModel):
            yield from _files(value)
        elif isinstance(value, dict):
            for one in value.values():
                if isinstance(one, ConfigModel):
                    yield from _files(one)
