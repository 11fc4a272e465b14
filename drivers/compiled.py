"""What is compiled of the EIT-kit's reading, where there was a C compiler when this was installed.

The compiled code is `_cells.c`; numpy does the same without, and the tests compare the two.
"""

from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

cells: Any = None


def is_stale(module: ModuleType) -> bool:
    """Return whether a module is compiled from another source than lies beside it, for that has changed since.

    As `shearloop.bank.eit.compiled` asks of its own: neither package imports the other.
    """
    source = Path(__file__).with_name("_cells.c")
    return source.exists() and crc32(source.read_bytes()) != getattr(module, "SOURCES", None)


if cells is not None and is_stale(cells):
    cells = None

__all__ = ["cells", "is_stale"]
