"""Which signals end a process in order."""

import signal
import threading


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return SIGINT, SIGTERM, and SIGHUP of a terminal that is closed, unless that was to be ignored (`nohup`).

    None outside of the main thread: only there can a signal be heard.
    """
    if threading.current_thread() is not threading.main_thread():
        return ()
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hangs_up else ()))
