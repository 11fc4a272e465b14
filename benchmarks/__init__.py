"""Benchmarks: scripts that print their figures and write them as JSON."""

import os

# Before numpy is loaded, as on the command line: all methods run on one thread.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
