import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_benchmarks_use_one_blas_thread():
    """With more threads a match at all lags takes four times as long on two cores."""
    asked = "import benchmarks, os, sys; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"
    alone = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    for environment, threads in ((alone, "1"), ({**alone, "OPENBLAS_NUM_THREADS": "2"}, "2")):
        printed = subprocess.run(
            [sys.executable, "-c", asked], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        assert printed.stdout.split() == [threads, "False"]
