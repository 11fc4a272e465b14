"""Measurements: each script writes its numbers as JSON and draws its chart."""

import os

# As the command line does, before numpy is loaded: what is compared is compared on one thread each.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
