"""A long run with faults of every device: memory and descriptors stay flat, and every recording is complete.

    python -m benchmarks.soak --out run/soak.json [--minutes 10] [--speed 30] [--seed 1]

It runs the real daemon and drivers on the emulated rig, with boards, gel and fingers `--speed` times as fast. Every
experiment turns the tool until a device fails, in the random order of the seed. Then the device works again. The daemon
records all the time. The command writes the memory and the descriptors of the daemon and of the worker before each
fault.
"""

import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.common import parser_of, table_head, table_row, write_figures
from benchmarks.stop_times import CAUSES, DEADLINE_S, RunningRig
from shearloop.tools.recordings.frames import read_recording

# Of the C library: larger buffers than this (bytes) go back to the system when they are freed. Without it the heap
# keeps some of them, and the memory of the process grows in steps although nothing leaks.
RETURNS_BUFFERS = {"MALLOC_MMAP_THRESHOLD_": str(1 << 20)}
# The least of so many samples at this interval counts: the buffers of one frame are no leak.
N_SAMPLES, SAMPLE_INTERVAL_S = 5, 0.02
FAULTS = [cause for cause in CAUSES if cause.command and not cause.straight]


def usage(rig: RunningRig) -> dict[str, float]:
    """Return the least memory in MB and number of descriptors of the daemon and of the worker, of some samples."""
    samples = []
    for _ in range(N_SAMPLES):
        samples.append(usage_at_once(rig))
        time.sleep(SAMPLE_INTERVAL_S)
    return least(samples)


def least(samples: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the least of each value."""
    return {name: min(sample[name] for sample in samples) for name in samples[0]}


def usage_at_once(rig: RunningRig) -> dict[str, float]:
    """Return the memory in MB and the number of descriptors of the daemon and of the worker."""
    found = {}
    for name, pid in (("daemon", rig.daemon.pid), ("worker", rig.worker_pid())):
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        found[f"{name}_mb"] = next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) / 1024
        found[f"{name}_descriptors"] = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    return found


def soak(speed: int, seed: int, goes_on: Callable[[int], bool]) -> dict[str, Any]:
    """Cause faults while `goes_on(number)`; return their counts, the usage before each, and the recordings."""
    chosen, counts = random.Random(seed), Counter[str]()
    used: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        rig = RunningRig(folder, stack, speed, RETURNS_BUFFERS, recording={"folder": str(folder / "recordings")})
        while goes_on(len(used)):
            cause = chosen.choice(FAULTS)
            rig.turn()
            used.append(usage(rig))
            rig.stood_ns(rig.cause(cause))
            rig.recover(cause)
            counts[cause.name] += 1
        # While the fingers hold a tool, a command `stop` does not end the daemon, but the signal of a service's end
        # does.
        rig.daemon.terminate()
        rig.daemon.wait(DEADLINE_S)
        recordings = sorted((folder / "recordings").iterdir())
        torques = sum(len(read_recording(path).torque_nm) for path in recordings if path.suffix == ".mcap")
    quarter = max(1, len(used) // 4)
    return {
        "faults": dict(sorted(counts.items())),
        "first_quarter": least(used[:quarter]),
        "last_quarter": least(used[-quarter:]),
        "recordings": len(recordings),
        "incomplete_recordings": [path.name for path in recordings if path.suffix != ".mcap"],
        "recorded_torques": torques,
    }


def main() -> None:
    """Soak, print a table and write all figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="duration (default: %(default)s)")
    parser.add_argument("--speed", type=int, default=30, metavar="N", help="times as fast (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the order of faults (default: %(default)s)")
    args = parser.parse_args()
    end_s = time.monotonic() + 60 * args.minutes
    found = soak(args.speed, args.seed, lambda _: time.monotonic() < end_s)
    n_faults, damaged = sum(found["faults"].values()), ", ".join(found["incomplete_recordings"]) or "none"
    print(f"{n_faults} faults, {found['recorded_torques']} recorded torques, incomplete recordings: {damaged}")
    print(table_head("", *found["first_quarter"]))
    for part in ("first_quarter", "last_quarter"):
        print(table_row(part.replace("_", " "), *found[part].values()))
    write_figures(args.out, found)


if __name__ == "__main__":
    main()
