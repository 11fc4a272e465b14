"""The compiled parts, which are left out where there is no C compiler; pyproject.toml has everything else."""

from pathlib import Path
from zlib import crc32

from setuptools import Extension, setup


def compiled(name: str, sources: list[str], headers: list[str]) -> Extension:
    """Return an extension that knows its sources: where others lie beside it, it is not used (`compiled.py`)."""
    content = b"".join(Path(file).read_bytes() for file in [*sources, *headers])
    return Extension(
        name,
        sources,
        depends=headers,
        define_macros=[("SOURCES", f"{crc32(content)}L")],
        extra_compile_args=["-O3", "-std=c11", "-Wall", "-Wextra"],
        optional=True,
        py_limited_api=True,
    )


setup(
    ext_modules=[
        compiled(
            "bank._search",
            ["bank/_search.c", "bank/arrays.c", "bank/candidates.c", "bank/lags.c", "bank/search.c"],
            ["bank/arrays.h", "bank/eight.h", "bank/search.h"],
        ),
        compiled(
            "bank._frames",
            ["bank/_frames.c", "bank/_fingertips.c", "bank/arrays.c", "bank/look.c", "bank/medians.c"],
            ["bank/_fingertips.h", "bank/arrays.h", "bank/look.h", "bank/medians.h"],
        ),
        compiled("drivers._cells", ["drivers/_cells.c"], []),
    ]
)
