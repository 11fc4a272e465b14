"""The compiled parts, which are left out where there is no C compiler; pyproject.toml has everything else."""

from setuptools import Extension, setup

# The order of additions may change, as the bounds and the tests allow for, but nothing else that the standard says.
FLAGS = ["-O3", "-std=c11", "-Wall", "-Wextra"]

setup(
    ext_modules=[
        Extension("bank._search", ["bank/_search.c"], extra_compile_args=FLAGS, optional=True, py_limited_api=True),
        Extension("drivers._cells", ["drivers/_cells.c"], extra_compile_args=FLAGS, optional=True, py_limited_api=True),
    ]
)
