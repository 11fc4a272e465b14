"""How late a loop of 8 ms wakes on a busy computer, with each of the service's real-time options.

    sudo python -m benchmarks.wakeup_jitter --out DIR

Each option runs in its own process: an asyncio loop that wakes 125 times a second and then works for half a
millisecond, as the daemon's loop does. Two endless computations per processor run at the same time. The options take
turns. Prints and writes the lateness in ms: median, 99 %, 99.9 %, worst, and the share later than a whole period.
"""

import asyncio
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks.common import parser_of, write_figures
from shearloop.daemon.process import NICENESS, lock_memory

PERIOD_S = 0.008
WORK_S = 0.0005
PRIORITY = 40
ROUNDS = 3


def use_fifo() -> None:
    """Set CPUSchedulingPolicy=fifo and CPUSchedulingPriority=40."""
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))


def use_one_core() -> None:
    """Set CPUAffinity= to one core."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def use_fifo_locked() -> None:
    """Set what `install --real-time` and `lock_memory: true` set."""
    lock_memory()
    use_fifo()


OWN_CORE = "affinity, core of its own"
OPTIONS: dict[str, Callable[[], object]] = {
    "ordinary": lambda: None,
    "memory locked": lock_memory,
    "niceness -10": lambda: os.setpriority(os.PRIO_PROCESS, 0, NICENESS),
    "affinity, shared core": use_one_core,
    OWN_CORE: use_one_core,
    "SCHED_FIFO": use_fifo,
    "SCHED_FIFO, memory locked": use_fifo_locked,
}


def compute_endlessly(cores: set[int]) -> None:
    """Keep these cores busy."""
    os.sched_setaffinity(0, cores)
    values = np.random.default_rng(0).normal(size=100_000)
    while True:
        np.sort(values)


def measure(option: str, seconds: float) -> list[float]:
    """Return the lateness of every wake-up in s."""
    OPTIONS[option]()
    return asyncio.run(_wake_ups(seconds))


async def _wake_ups(seconds: float) -> list[float]:
    loop = asyncio.get_running_loop()
    late = []
    start_s = due_s = loop.time() + 0.1
    while due_s < start_s + seconds:
        await asyncio.sleep(due_s - loop.time())
        late.append(loop.time() - due_s)
        end_s = loop.time() + WORK_S
        while loop.time() < end_s:
            # Fresh memory, as for every frame and message.
            np.ones(20_000).sum()
        due_s = max(due_s + PERIOD_S, loop.time())
    return late


def lateness(option: str, seconds: float) -> list[float]:
    """Return the lateness of one option's wake-ups on the busy computer, in s."""
    cores = os.sched_getaffinity(0)
    busy = cores - {max(cores)} if option == OWN_CORE and len(cores) > 1 else cores
    context = multiprocessing.get_context("spawn")
    burners = [context.Process(target=compute_endlessly, args=(busy,), daemon=True) for _ in range(2 * len(cores))]
    for burner in burners:
        burner.start()
    try:
        with ProcessPoolExecutor(1, context) as loop:
            return loop.submit(measure, option, seconds).result()
    finally:
        for burner in burners:
            burner.kill()
            burner.join()


def main() -> None:
    """Measure all options in turn, print and write the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="per option and round, of three (default: 4)")
    args = parser.parse_args()
    late: dict[str, list[float]] = {option: [] for option in OPTIONS}
    for _ in range(ROUNDS):
        for option in OPTIONS:
            late[option] += lateness(option, args.seconds)
    print(f"{'lateness in ms':<28}{'median':>8}{'99 %':>8}{'99.9 %':>8}{'worst':>8}{'> 8 ms':>8}")
    found = {}
    for option, values in late.items():
        p50, p99, p99_9, worst = np.percentile(np.array(values) * 1e3, [50, 99, 99.9, 100]).tolist()
        missed = float(np.mean(np.array(values) > PERIOD_S))
        found[option] = {"median": p50, "p99": p99, "p99_9": p99_9, "worst": worst, "missed_share": missed}
        print(f"{option:<28}{p50:8.2f}{p99:8.2f}{p99_9:8.2f}{worst:8.2f}{missed:8.1%}")
    write_figures(args.out / "wakeup_jitter.json", found)


if __name__ == "__main__":
    main()
