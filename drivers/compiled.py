"""What is compiled of the EIT-kit's reading, where there was a C compiler when this was installed.

The compiled code is `_cells.c`; numpy does the same without, and the tests compare the two.
"""

try:
    from drivers import _cells as cells
except ImportError:
    # No compiler, or none that could build it; docs/speed.md tells what that costs.
    cells = None  # type: ignore[assignment]

__all__ = ["cells"]
