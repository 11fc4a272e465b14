"""Runs the demo many times while other processes are busy: whether it ends done, and how long it takes.

    python -m benchmarks.busy_demo --out run/busy_demo.json [--runs 10] [--busy 8]

The first step makes the demo's bank and calibrations, like a user's first run. It is not measured.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.common import parser_of, table_head, table_row, write_figures
from benchmarks.stop_times import busy_processes

DEMO = (sys.executable, "-m", "shearloop", "demo", "--port", "0", "--folder", ".")
# What the demo's last lines begin with.
HAPPENED = "What happened: "
LONGEST_S = 900.0


def run_demo(folder: Path) -> dict[str, Any]:
    """Run one demo; return its exit status, None without an end, its time in s, and what happened."""
    began_s = time.monotonic()
    try:
        ended = subprocess.run(DEMO, cwd=folder, capture_output=True, text=True, check=False, timeout=LONGEST_S)
    except subprocess.TimeoutExpired:
        return {"status": None, "took_s": LONGEST_S, "happened": "it did not end"}
    took_s = time.monotonic() - began_s
    _, found, summary = ended.stdout.partition(HAPPENED)
    happened = (summary if found else ended.stderr).splitlines()
    return {"status": ended.returncode, "took_s": took_s, "happened": happened[0] if happened else ""}


def main() -> None:
    """Run the demos, print each, and write all."""
    parser = parser_of(__doc__)
    parser.add_argument("--runs", type=int, default=10, metavar="N", help="demos (default: %(default)s)")
    parser.add_argument("--busy", type=int, default=8, metavar="N", help="busy processes (default: %(default)s)")
    args = parser.parse_args()
    runs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        subprocess.run([*DEMO, "--prepare"], cwd=name, check=True, stdout=subprocess.DEVNULL)
        print(table_head("demo", "status", "took, s", "what happened"))
        with busy_processes(args.busy):
            for number in range(args.runs):
                runs.append(run_demo(Path(name)))
                run = runs[-1]
                print(table_row(number + 1, run["status"], run["took_s"], run["happened"]), flush=True)
                write_figures(args.out, {"busy": args.busy, "runs": runs})
    done = sum(run["status"] == 0 for run in runs)
    print(json.dumps({"busy": args.busy, "runs": len(runs), "done": done}))


if __name__ == "__main__":
    main()
