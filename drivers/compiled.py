"""What is compiled of the EIT-kit's reading, where there was a C compiler when this was installed.

The compiled code is `_cells.c`; numpy does the same without, and the tests compare the two.
"""

from pathlib import Path

from bank.stale import is_stale

try:
    from drivers import _cells as cells
except ImportError:
    # No compiler, or none that could build it; docs/speed.md tells what that costs.
    cells = None  # type: ignore[assignment]

if cells is not None and is_stale(cells, Path(__file__).parent, "_cells.c"):
    cells = None  # type: ignore[assignment]

__all__ = ["cells"]
