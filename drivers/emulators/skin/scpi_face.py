"""How an instrument understands SCPI: headers in long or short form, an error queue, replies in lines. No I/O."""

import re
from collections import deque
from collections.abc import Callable, Mapping

# Returns the answer to a query, and nothing for a command; the argument is what follows the header.
Handler = Callable[[str], str | None]

LONGEST_LINE = 512
MOST_ERRORS = 10
UNDEFINED_HEADER = '-113,"Undefined header"'
OUT_OF_RANGE = '-222,"Parameter data out of range"'
ILLEGAL_VALUE = '-224,"Illegal parameter value"'


class ScpiError(Exception):
    """What a handler refuses; the text goes into the error queue."""


class ScpiFace:
    """One connection to one instrument; what is refused goes into the error queue and gets no reply."""

    def __init__(self, identity: str, commands: Mapping[str, Handler], no_error: str) -> None:
        """Take commands by header, as manuals write them: `SOURce:CURRent[:LEVel]`, a query with `?`."""
        self._commands = [(_pattern(header), handler) for header, handler in commands.items()]
        self._commands += [
            (_pattern("*IDN?"), lambda _: identity),
            (_pattern("*CLS"), lambda _: self.errors.clear()),
            (_pattern("*OPC?"), lambda _: "1"),
            (_pattern("SYSTem:ERRor[:NEXT]?"), lambda _: self.errors.popleft() if self.errors else no_error),
        ]
        self._buffer = b""
        self.errors: deque[str] = deque(maxlen=MOST_ERRORS)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).replace(b"\r", b"\n").split(b"\n")
        self._buffer = self._buffer[-LONGEST_LINE:]
        return b"".join(self._line(line.decode("ascii", "replace").strip()) for line in lines)

    def _line(self, line: str) -> bytes:
        answers = [answer for unit in filter(None, line.split(";")) if (answer := self._unit(unit.strip())) is not None]
        return ";".join(answers).encode() + b"\n" if answers else b""

    def _unit(self, unit: str) -> str | None:
        header, _, argument = unit.partition(" ")
        for pattern, handler in self._commands:
            if pattern.fullmatch(header):
                try:
                    return handler(argument.strip())
                except ScpiError as error:
                    self.errors.append(str(error))
                    return None
        self.errors.append(UNDEFINED_HEADER)
        return None


def number(text: str, low: float, high: float) -> float:
    """Return the number that a command was given; ScpiError when it is none or out of its range."""
    try:
        value = float(text)
    except ValueError:
        raise ScpiError(ILLEGAL_VALUE) from None
    if not low <= value <= high:
        raise ScpiError(OUT_OF_RANGE)
    return value


def boolean(text: str) -> bool:
    """Return the truth value that a command was given."""
    values = {"ON": True, "1": True, "OFF": False, "0": False}
    if text.upper() not in values:
        raise ScpiError(ILLEGAL_VALUE)
    return values[text.upper()]


def _pattern(header: str) -> re.Pattern[str]:
    """Return what matches a header: each word in its long form or as its capitals, what is in brackets or not."""

    def word(match: re.Match[str]) -> str:
        text = match[0]
        short = "".join(letter for letter in text if letter.isupper())
        return f"(?:{text}|{short})1?" if short != text else text

    words = re.sub(r"[A-Za-z]{2,}", word, header.replace("*", r"\*").replace("?", r"\?"))
    return re.compile(":?" + words.replace("[", "(?:").replace("]", ")?"), re.IGNORECASE)
