"""Measurements: scripts that write their numbers as JSON and draw their charts; without a `main`, parts of those."""

import os

# As the command line does, before numpy is loaded: what is compared is compared on one thread each.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
