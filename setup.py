"""The compiled parts, which are left out where there is no C compiler; pyproject.toml has everything else."""

from setuptools import Extension, setup

HOW = {"extra_compile_args": ["-O3", "-std=c11", "-Wall", "-Wextra"], "optional": True, "py_limited_api": True}

setup(
    ext_modules=[
        Extension("bank._search", ["bank/_search.c", "bank/search.c"], depends=["bank/search.h"], **HOW),
        Extension("drivers._cells", ["drivers/_cells.c"], **HOW),
    ]
)
