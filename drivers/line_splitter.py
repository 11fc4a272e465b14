"""Cuts what a device sends, in whatever slices it comes, into lines. No I/O."""


def transfer_ns(n_bytes: int, baud: int) -> int:
    """Return how long so many bytes take over a serial line: ten bits each, with start and stop."""
    return n_bytes * (10 * 10**9 // baud)


class LineSplitter:
    """Gives each line once it is complete; one that is too long is counted once, and left out whole.

    `too_long` and `unfinished` count since the beginning: lines beyond `longest_bytes`, and other lines that had begun
    when the port was opened again.
    """

    def __init__(self, longest_bytes: int) -> None:
        """Wait for the first line; `longest_bytes` is without its newline."""
        self._longest_bytes = longest_bytes
        self._begun = b""
        self._flooded = False
        self.too_long = 0
        self.unfinished = 0

    @property
    def begun(self) -> bool:
        """Whether a line has begun to come and not ended."""
        return self._flooded or bool(self._begun.strip())

    def restart(self) -> None:
        """Begin anew: the port was opened, and what was half received stays so."""
        # What was too long has been counted as that.
        self.unfinished += self.begun and not self._flooded
        self._begun = b""
        self._flooded = False

    def feed(self, data: bytes) -> list[bytes | None]:
        """Return the lines that `data` completes, without their newlines; None for one that was too long."""
        *ends, rest = (self._begun + data).split(b"\n")
        lines = [self._whole(end) for end in ends]
        self._begun = rest
        if len(rest) > self._longest_bytes:
            self._flood()
            self._begun = b""
        return lines

    def _whole(self, line: bytes) -> bytes | None:
        if self._flooded or len(line) > self._longest_bytes:
            # What is left of a line whose beginning is gone is not a line.
            self._flood()
            self._flooded = False
            return None
        return line

    def _flood(self) -> None:
        self.too_long += not self._flooded
        self._flooded = True
