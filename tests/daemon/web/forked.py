"""Runs viewers and fake daemons as processes of their own, without the second that their imports take each time.

`python -m tests.daemon.web.forked` imports what they need. For each line of its input it starts or kills such a
process, a fork of itself, and answers with a line; both are JSON.
"""

import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Forks:
    """The process that forks, as a test has it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def start(self, kind: str, *arguments: str, output: Path | None = None) -> int:
        """Start a `view` or `daemon` with arguments, which prints into a file; return its process."""
        return int(self._ask(start=kind, arguments=arguments, output=str(output or os.devnull)))

    def kill(self, pid: int) -> None:
        """Kill a process, and return when it is gone."""
        self._ask(kill=pid)

    def runs(self, pid: int) -> bool:
        """Return whether a process has not ended."""
        return bool(self._ask(runs=pid))

    def close(self) -> None:
        """End the process that forks, and with it those that it has started."""
        self._process.communicate()

    def _ask(self, **request: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def serve() -> None:
    """Do what the lines of the input ask for; kill at its end what still runs."""
    from shearloop.cli import main
    from shearloop.daemon.web import server  # noqa: F401 - for `view`, which imports it when it runs
    from tests.daemon.web import fake_daemon

    kinds: dict[str, Callable[..., Any]] = {"view": lambda *words: main(["view", *words]), "daemon": fake_daemon.run}
    running: set[int] = set()

    def runs(pid: int) -> bool:
        if pid in running and os.waitpid(pid, os.WNOHANG) != (0, 0):
            running.remove(pid)
        return pid in running

    def kill(pid: int) -> None:
        if runs(pid):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            running.remove(pid)

    for line in sys.stdin:
        match json.loads(line):
            case {"start": kind, "arguments": arguments, "output": output}:
                pid = os.fork()
                if not pid:
                    _become(kinds[kind], arguments, output)
                running.add(pid)
                print(pid, flush=True)
            case {"kill": pid}:
                kill(pid)
                print("null", flush=True)
            case {"runs": pid}:
                print(json.dumps(runs(pid)), flush=True)
    for pid in list(running):
        kill(pid)


def _become(call: Callable[..., Any], arguments: list[str], output: str) -> None:
    """Call in this fork, with nothing to read, and end it."""
    for number, path, flags in ((0, os.devnull, os.O_RDONLY), (1, output, os.O_WRONLY)):
        opened = os.open(path, flags)
        os.dup2(opened, number)
        os.close(opened)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - as long as the process
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115 - as long as the process
    try:
        os._exit(call(*arguments) or 0)
    except BaseException:  # noqa: BLE001 - told, and the end of the process
        traceback.print_exc()
        os._exit(1)


if __name__ == "__main__":
    serve()
