"""Records in many processes, each killed at a random moment of its life; prints the folder of each."""

import asyncio
import mmap
import os
import random
import sched
import signal
import struct
import sys
from pathlib import Path

import numpy as np

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import EitFrame, wire_map
from shearloop.daemon.recorder.recorder import Identity, Recorder
from shearloop.daemon.recorder.schema import basic_identity
from tests.sample_messages import sample

# Five boards of frames: a kill in the middle of a write is likely.
PERIOD_S = 0.1
BETWEEN_S = 0.05


async def write(folder: Path) -> None:
    clock = Clock()
    recorder = Recorder(folder, Identity(basic_identity("a test")), clock)
    # It survives a kill: when recording began, and when the last message was taken in.
    (folder / "times").write_bytes(struct.pack("<qq", clock.now_ns(), clock.now_ns()))
    with (folder / "times").open("r+b") as file:
        times = mmap.mmap(file.fileno(), 0)

    async def record() -> None:
        async for _ in recorder.flushes():
            pass

    task = asyncio.create_task(record())
    generator = np.random.default_rng(1)
    seq = 0
    while not task.done():
        now_ns = clock.now_ns()
        arrays = {"channels": generator.uniform(size=896), "line": generator.uniform(size=1024)}
        frame = sample(EitFrame, source="right", t_mono_ns=now_ns, **arrays)
        recorder.record_message(frame.topic, wire_map(frame, clock.unix_s(now_ns), seq))
        times[8:] = struct.pack("<q", now_ns)
        seq += 1
        await asyncio.sleep(PERIOD_S)


def main(folder: Path, number: int, longest_s: float) -> None:
    draw, plan = random.Random(7), sched.scheduler()

    def begin(own: Path) -> None:
        if (child := os.fork()) == 0:
            asyncio.run(write(own))
        plan.enter(draw.uniform(0.1, longest_s), 0, kill, (child, own))

    def kill(child: int, own: Path) -> None:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        print(own, flush=True)

    for n in range(number):
        plan.enter(n * BETWEEN_S, 0, begin, (folder / str(n),))
    plan.run()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
