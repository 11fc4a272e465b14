"""Whether what can be compiled of the bank's work was, where there was a C compiler when this was installed.

The compiled code is `search.c`, for matchers (`compiled_search.py`), and `look.c` and `medians.c`, for what estimators
ask of a frame (`compiled_frames.py`); numpy does the same without, and the tests compare the two. Its one purpose is
the time from a frame to its estimate.
"""

from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

from scipy.linalg import cython_blas

_frames: Any = None
_search: Any = None
frames = _frames
search = _search


def is_stale(module: ModuleType, *names: str) -> bool:
    """Return whether a module is compiled from other sources than lie beside it, for they have changed since.

    Where none lie there, as after an installation from a wheel, they have not.
    """
    sources = [Path(__file__).with_name(name) for name in names]
    there = all(source.exists() for source in sources)
    return there and crc32(b"".join(source.read_bytes() for source in sources)) != getattr(module, "SOURCES", None)


# In the order of setup.py.
_SEARCH = ("_search.c", "arrays.c", "candidates.c", "lags.c", "search.c", "arrays.h", "eight.h", "search.h")
_FRAMES = (
    *("_frames.c", "_fingertips.c", "arrays.c", "look.c", "medians.c"),
    *("_fingertips.h", "arrays.h", "look.h", "medians.h"),
)
# BLAS as scipy hands it to compiled code.
SGEMM = getattr(cython_blas, "__pyx_capi__", {}).get("sgemm")
_FRESH = search is not None and not is_stale(search, *_SEARCH) and not is_stale(frames, *_FRAMES)
IS_COMPILED = _FRESH and search.is_sgemm(SGEMM)
