"""An emulated device in a process of its own, as a driver meets it: at the other end of a socket or a terminal."""

import asyncio
import json
import os
import subprocess
import sys
import time
from typing import Any

Event = dict[str, Any]


def own_address(module: int) -> str:
    """Return an address of this machine that this process and a module of it (0 to 7) have for themselves.

    The ports of a robot are fixed by its client: two test runs at once need two addresses, and so do two modules.
    """
    first, second = module & 3, module >> 2
    pid = os.getpid()
    return f"127.{first << 6 | pid >> 14 & 63}.{second << 7 | pid >> 7 & 127}.{1 + pid % 128}"


class EmulatorProcess:
    """`shearloop emulate DEVICE`, which prints JSON lines and takes commands; `ready` is in the line that it is up."""

    def __init__(self, device: str, *options: str, module: int, ready: str) -> None:
        self.host = own_address(module)
        self.events: list[Event] = []
        self._unread = b""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "shearloop", "emulate", device, "--host", self.host, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._stdin, self._stdout = self.process.stdin, self.process.stdout
        self.greeting = self._stdout.readline().decode()
        assert ready in self.greeting
        os.set_blocking(self._stdout.fileno(), False)

    async def ask(self, line: str, answer: str) -> Event:
        """Write a line, and return the event with which it is answered."""
        asked_ns = time.monotonic_ns()
        self._stdin.write(line.encode() + b"\n")
        self._stdin.flush()
        return await self.event(answer, asked_ns)

    async def fault(self, line: str) -> int:
        """Ask for a fault, wait for it, and return when it was asked for, in ns."""
        asked_ns = time.monotonic_ns()
        assert (await self.ask(line, "obeyed"))["detail"] == line
        return asked_ns

    async def event(self, name: str, since_ns: int, *, within_s: float = 10.0) -> Event:
        """Return the first event of a name since a moment, waiting for it."""
        async with asyncio.timeout(within_s):
            while True:
                for event in self.events:
                    if event["event"] == name and event["t_mono_ns"] >= since_ns:
                        return event
                await self._more()

    def happened(self, name: str, since_ns: int) -> list[Event]:
        """Return the events of a name since a moment, of those that were read so far."""
        return [event for event in self.events if event["event"] == name and event["t_mono_ns"] >= since_ns]

    def close(self) -> int:
        """End it as its user does, by the end of its input, and return its exit status."""
        self._stdin.close()
        status = self.process.wait(10)
        self._stdout.close()
        return status

    async def _more(self) -> None:
        loop, ready = asyncio.get_running_loop(), asyncio.Event()
        loop.add_reader(self._stdout, ready.set)
        try:
            await ready.wait()
        finally:
            loop.remove_reader(self._stdout)
        *lines, self._unread = (self._unread + (self._stdout.read() or b"")).split(b"\n")
        self.events += [json.loads(line) for line in lines]
