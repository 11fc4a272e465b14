"""A daemon that breaks on request, for `benchmarks.stop_times`: `python -m benchmarks.breakable_daemon run CONFIG`.

SIGUSR1 blocks its event loop for `BLOCKED_S`. SIGUSR2 makes the pipe to the worker lose each write. Each
writes its time in ns into the pipe `cause` in the configuration's folder.
"""

import gc
import os
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from shearloop.cli import main
from shearloop.drivers.ur.client import WorkerConnection

BLOCKED_S = 0.5


def _note_cause() -> None:
    with (Path(sys.argv[-1]).parent / "cause").open("w") as cause:
        cause.write(f"{time.monotonic_ns()}\n")


def block_event_loop(_number: int, _frame: FrameType | None) -> None:
    """Sleep in the thread of the event loop."""
    _note_cause()
    time.sleep(BLOCKED_S)


def lose_commands(_number: int, _frame: FrameType | None) -> None:
    """Replace the pipe to the worker; the process keeps an open, silent input."""
    for connection in [one for one in gc.get_objects() if isinstance(one, WorkerConnection)]:
        pipe = connection._stdin.get_extra_info("pipe") or connection._stdin.get_extra_info("socket")
        os.dup(pipe.fileno())
        os.dup2(os.open(os.devnull, os.O_WRONLY), pipe.fileno())
    _note_cause()


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, block_event_loop)
    signal.signal(signal.SIGUSR2, lose_commands)
    sys.exit(main(sys.argv[1:]))
