"""How late a loop of 8 ms is woken on a busy computer, and what the service's real-time options do about it.

    sudo python -m benchmarks.jitter --out run/jitter

Each way is a process of its own with an asyncio loop that is to wake 125 times a second and then works for half a
millisecond, as the daemon's loop does, while two endless computations per processor run beside it. The ways take
turns, and each lateness counts: median, 99 %, 99.9 %, worst, and wakings later than a whole period.
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shearloop.daemon.service.realtime import NICENESS, lock_memory

PERIOD_S = 0.008
WORK_S = 0.0005
PRIORITY = 40
ROUNDS = 3


def ordinary() -> None:
    """Leave everything as the system has it."""


def real_time() -> None:
    """CPUSchedulingPolicy=fifo, CPUSchedulingPriority=40."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def niced() -> None:
    """Nice=-10, and what `shearloop run` asks of the system by itself; counts among those of one session or group."""
    os.setpriority(os.PRIO_PROCESS, 0, NICENESS)


def one_core() -> None:
    """CPUAffinity= with one core; whether the others may run on it too is for whoever starts those."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def locked() -> None:
    """LimitMEMLOCK=infinity and `lock_memory: true`; as root the limit does not count."""
    lock_memory()


def real_time_locked() -> None:
    """Both, which is what `install --real-time` and `lock_memory: true` make."""
    locked()
    real_time()


# The way in which the others leave that core free.
_OWN_CORE = "affinity, core of its own"
WAYS: dict[str, Callable[[], None]] = {
    "ordinary": ordinary,
    "memory locked": locked,
    "niceness -10": niced,
    "affinity, shared core": one_core,
    _OWN_CORE: one_core,
    "SCHED_FIFO": real_time,
    "SCHED_FIFO, memory locked": real_time_locked,
}


def busy(cores: set[int]) -> None:
    """Compute for ever on these cores."""
    os.sched_setaffinity(0, cores)
    values = np.random.default_rng(0).normal(size=100_000)
    while True:
        np.sort(values)


def measure(way: str, seconds: float, answer: "multiprocessing.connection.Connection") -> None:
    """Send the lateness of every waking in s, and the page faults of the process meanwhile."""
    WAYS[way]()
    answer.send(asyncio.run(_wakings(seconds)))


async def _wakings(seconds: float) -> tuple[list[float], int]:
    loop = asyncio.get_running_loop()
    late, faults = [], resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    start_s = due_s = loop.time() + 0.1
    while due_s < start_s + seconds:
        await asyncio.sleep(due_s - loop.time())
        late.append(loop.time() - due_s)
        end_s = loop.time() + WORK_S
        while loop.time() < end_s:
            # Fresh memory, as every frame and message is.
            np.ones(20_000).sum()
        due_s = max(due_s + PERIOD_S, loop.time())
    return late, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults


def lateness_of(way: str, seconds: float) -> tuple[list[float], int]:
    """Return what one way measures while the computer is busy."""
    cores = os.sched_getaffinity(0)
    left = cores - {max(cores)} if way == _OWN_CORE and len(cores) > 1 else cores
    context = multiprocessing.get_context("spawn")
    burners = [context.Process(target=busy, args=(left,), daemon=True) for _ in range(2 * len(cores))]
    here, there = context.Pipe()
    loop = context.Process(target=measure, args=(way, seconds, there))
    for burner in burners:
        burner.start()
    loop.start()
    there.close()
    try:
        found: tuple[list[float], int] = here.recv()
    finally:
        for process in (*burners, loop):
            process.kill()
            process.join()
    return found


def run(seconds: float, out: Path) -> None:
    """Measure all ways in turn, and write their numbers and the chart."""
    late: dict[str, list[float]] = {way: [] for way in WAYS}
    faults = dict.fromkeys(WAYS, 0)
    for _ in range(ROUNDS):
        for way in WAYS:
            more, faulted = lateness_of(way, seconds)
            late[way] += more
            faults[way] += faulted
    out.mkdir(parents=True, exist_ok=True)
    numbers = {way: _summary(np.array(values), faults[way]) for way, values in late.items()}
    facts = {"processors": len(os.sched_getaffinity(0)), "seconds": seconds * ROUNDS, "period_ms": PERIOD_S * 1e3}
    (out / "jitter.json").write_text(json.dumps({**facts, "ways": numbers}, indent=1) + "\n")
    print(f"{'lateness in ms':<28}{'median':>8}{'99 %':>8}{'99.9 %':>8}{'worst':>8}{'> 8 ms':>8}{'faults/s':>10}")
    for way, row in numbers.items():
        print(f"{way:<28}" + "".join(f"{row[key]:8.2f}" for key in ("median", "p99", "p99_9", "worst")), end="")
        print(f"{row['missed_share']:8.1%}{row['faults'] / facts['seconds']:10.0f}")
    _draw(late, out / "jitter.png")


def _summary(late_s: "np.ndarray", faults: int) -> dict[str, float]:
    p50, p99, p99_9 = np.percentile(late_s * 1e3, [50, 99, 99.9])
    return {
        "median": float(p50),
        "p99": float(p99),
        "p99_9": float(p99_9),
        "worst": float(late_s.max() * 1e3),
        "missed_share": float((late_s > PERIOD_S).mean()),
        "wakings": len(late_s),
        "faults": faults,
    }


def _draw(late: dict[str, list[float]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.add_subplot()
    styles = ("-", ":", (0, (3, 1, 1, 1)), "--", "-.", (0, (5, 1)), (0, (1, 1)))
    for (way, values), style in zip(late.items(), styles, strict=True):
        ordered = np.sort(values) * 1e3
        share = 1.0 - np.arange(len(ordered)) / len(ordered)
        axes.plot(np.maximum(ordered, 1e-3), share, label=way, linestyle=style, linewidth=1.8)
    axes.axvline(PERIOD_S * 1e3, color="0.6", linewidth=1)
    axes.annotate("a whole period", (PERIOD_S * 1e3, 0.3), rotation=90, ha="right", va="center", color="0.4")
    axes.set(xscale="log", yscale="log", xlabel="woken late by more than … ms", ylabel="share of wakings")
    axes.grid(color="0.9")
    axes.legend(loc="lower left")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Parse the command line and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=4.0, help="per way and round, of three (default: 4)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for jitter.json and jitter.png")
    args = parser.parse_args()
    run(args.seconds, args.out)


if __name__ == "__main__":
    main()
