"""Whether what is compiled is of the sources that lie beside it: of the bank's, and of the drivers'."""

from pathlib import Path
from types import ModuleType
from zlib import crc32


def is_stale(module: ModuleType, folder: Path, *names: str) -> bool:
    """Return whether a module is compiled from other sources than lie in a folder, for they have changed since.

    The names are in the order of setup.py. Where none lie there, as after an installation from a wheel, they have not.
    """
    sources = [folder / name for name in names]
    there = all(source.exists() for source in sources)
    return there and crc32(b"".join(source.read_bytes() for source in sources)) != getattr(module, "SOURCES", None)
