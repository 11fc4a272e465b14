"""Lines that the operator types while the event loop runs; a pipe or a file works too."""

import asyncio
import os
import sys
from typing import Self

STDIN = 0
READ_BYTES = 4096


class Operator:
    """The person at the terminal, as an asynchronous context."""

    def __init__(self, *, stdout_is_for_json: bool = False) -> None:
        """Print to stdout, or to stderr if stdout is for a result in JSON."""
        self._out = sys.stderr if stdout_is_for_json else sys.stdout
        self._partial = b""
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._watching = False

    async def __aenter__(self) -> Self:
        """Start reading."""
        try:
            asyncio.get_running_loop().add_reader(STDIN, self._read)
            self._watching = True
        except PermissionError:
            # epoll refuses a file; reading a file never blocks.
            while self._read():
                pass
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop reading."""
        self._stop()

    async def ask(self, prompt: str) -> str:
        """Print the prompt and return the next line; raise UserError at the end of the input."""
        from shearloop.daemon.errors import UserError

        self.say(prompt)
        line = await self._lines.get()
        if line is None:
            self._lines.put_nowait(None)
            raise UserError("the input ended before all was measured; press Enter after each step")
        return line

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        print(sentence, file=self._out, flush=True)

    def _read(self) -> bool:
        data = os.read(STDIN, READ_BYTES)
        *lines, self._partial = (self._partial + data).split(b"\n")
        # An unfinished line must not grow without limit.
        self._partial = self._partial[-READ_BYTES:]
        for line in lines:
            self._lines.put_nowait(line.decode(errors="replace").strip())
        if not data:
            self._lines.put_nowait(None)
            self._stop()
        return bool(data)

    def _stop(self) -> None:
        if self._watching:
            asyncio.get_running_loop().remove_reader(STDIN)
            self._watching = False
