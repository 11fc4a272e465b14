"""What the operator types, one line at a time, while the event loop goes on; a pipe or a file answers as well."""

import asyncio
import os
import sys
from types import TracebackType
from typing import Self

STDIN = 0
READ_BYTES = 4096


class Operator:
    """The person at the terminal, as an asynchronous context."""

    def __init__(self, *, stdout_is_for_json: bool = False) -> None:
        """Nothing has been typed yet; what is said goes to stderr where stdout is for a result alone."""
        self._out = sys.stderr if stdout_is_for_json else sys.stdout
        self._begun = b""
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._watching = False

    async def __aenter__(self) -> Self:
        """Begin to listen."""
        try:
            asyncio.get_running_loop().add_reader(STDIN, self._read)
            self._watching = True
        except PermissionError:
            # A file cannot be waited for, and need not be: it never blocks.
            while self._read():
                pass
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Listen no more."""
        self._stop()

    async def ask(self, prompt: str) -> str:
        """Return the line that is typed after the prompt; UserError when the input has ended."""
        from shearloop.daemon.errors import UserError

        self.say(prompt)
        line = await self._lines.get()
        if line is None:
            self._lines.put_nowait(None)
            raise UserError("the input ended before all was measured; press Enter after each step")
        return line

    def say(self, sentence: str) -> None:
        """Print a sentence that asks for nothing."""
        print(sentence, file=self._out, flush=True)

    def _read(self) -> bool:
        data = os.read(STDIN, READ_BYTES)
        *lines, self._begun = (self._begun + data).split(b"\n")
        # No answer is as long as this.
        self._begun = self._begun[-READ_BYTES:]
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
