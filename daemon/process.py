"""The process: signals that end it, its priority, its limits, resident memory, no long garbage collections."""

import contextlib
import ctypes
import gc
import os
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from shearloop.errors import UserError

# Compiled code has usually returned after this time.
RETRY_S = 0.05
# Before ordinary programs, behind the system's own.
NICENESS = -10
# Many times what the daemon and all its clients use.
MAX_DESCRIPTORS = 4096
_MCL_CURRENT, _MCL_FUTURE = 1, 2


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return SIGINT, SIGTERM, and SIGHUP unless it is ignored (`nohup`); none outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return ()
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hangs_up else ()))


@contextlib.contextmanager
def raise_ending_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for every ending signal, in the main thread, with the signal's number.

    SIGTERM and SIGHUP are handled as SIGINT is, so that the same clean-up runs: asyncio cancels its main task, since an
    exception amid its own work can lose a task or a connection. Python drops an exception that is raised in a callback
    from compiled code; the signal is then sent again.
    """
    if not ending_signals():
        yield
        return
    ended_by: list[int] = []
    retries: list[threading.Timer] = []
    previous_hook = sys.unraisablehook

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            previous_hook(dropped)
            return
        # Later: raised in this hook, it would be dropped again.
        retries.append(threading.Timer(RETRY_S, os.kill, (os.getpid(), _signal_of(dropped.exc_value))))
        retries[-1].start()

    def interrupt(number: int, frame: FrameType | None) -> None:
        ended_by.append(number)
        handler = signal.getsignal(signal.SIGINT)
        if handler is signal.default_int_handler or not callable(handler):
            raise KeyboardInterrupt(number)
        handler(number, frame)

    sys.unraisablehook = hook
    handlers = {number: signal.signal(number, interrupt) for number in ending_signals() if number != signal.SIGINT}
    try:
        yield
    except KeyboardInterrupt as interruption:
        # asyncio raises it without a number.
        interruption.args = interruption.args or tuple(ended_by[:1])
        raise
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.unraisablehook = previous_hook
        for timer in retries:
            timer.cancel()
            timer.join()


def interrupt_status(interrupt: KeyboardInterrupt) -> int:
    """Return the exit status that shells use: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + _signal_of(interrupt)


def _signal_of(interrupt: BaseException | None) -> int:
    """Return the signal that interrupted the program: SIGINT where none is noted."""
    return int(interrupt.args[0]) if interrupt is not None and interrupt.args else signal.SIGINT


def raise_priority() -> None:
    """Raise the priority of this process and of its later children, if the system allows it."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(NICENESS, os.getpriority(os.PRIO_PROCESS, 0)))


def raise_descriptor_limit() -> None:
    """Raise the limit of open files to MAX_DESCRIPTORS, or as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, MAX_DESCRIPTORS)), hard))


def lock_memory() -> None:
    """Lock all present and future memory of the process; raise UserError if the limit does not allow it."""
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        # With a limit, locking succeeds now and allocations fail later, in the middle of the work.
        raise UserError(
            f"`lock_memory: true` needs an unlimited RLIMIT_MEMLOCK, and it is {limit / 1024:.0f} kB: run "
            "`sudo shearloop install --real-time`, or remove `lock_memory` from the configuration"
        )
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise UserError(
            f"the system refused `lock_memory: true` ({os.strerror(ctypes.get_errno())}); "
            "remove it from the configuration"
        )


@contextlib.contextmanager
def without_long_collections() -> Iterator[Callable[[], None]]:
    """Disable garbage collection until the yielded function is called; then exempt all objects made so far.

    Modules, banks and calibrations are some 100 000 objects. A collection through them stops the loop for 20 to 100 ms.
    """
    gc.disable()

    def on_ready() -> None:
        gc.freeze()
        gc.enable()

    try:
        yield on_ready
    finally:
        gc.unfreeze()
        gc.enable()
