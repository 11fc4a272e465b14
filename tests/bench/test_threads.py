import os
import subprocess
import sys


def test_a_bench_is_measured_on_one_thread_of_blas_whoever_begins_it() -> None:
    """Else every product spreads over all cores, and a match at all lags takes four times as long on two."""
    asked = "import bench, os, sys; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in sys.modules)"
    alone = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    for environment, threads in ((alone, "1"), ({**alone, "OPENBLAS_NUM_THREADS": "2"}, "2")):
        told = subprocess.run(
            [sys.executable, "-c", asked], env=environment, capture_output=True, text=True, check=True
        )
        assert told.stdout.split() == [threads, "False"]
