"""Numbers and values in words and in digits, and sentences that differ in their numbers alone."""

import re

_LONGEST_VALUE = 60
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def times(count: int) -> str:
    """Return how often something happened: once, twice, 3 times."""
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def counted(count: int, one: str, many: str = "") -> str:
    """Return a number with its noun, and the verb if the noun brings one: 1 frame is, 2 frames are."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def beyond(value: float, limit: float, decimals: int, sign: str = "") -> str:
    """Return a value beyond a limit, with more decimals where the two would read the same."""
    while decimals < 9 and round(abs(value), decimals) == round(abs(limit), decimals):
        decimals += 1
    return f"{value:{sign}.{decimals}f}"


def shown(value: object) -> str:
    """Return a value of a file for a message, at most 60 characters."""
    return shortened(repr(value))


def shortened(text: str) -> str:
    """Return a text for a message, at most 60 characters."""
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"


def is_whole_number(text: str, most_digits: int) -> bool:
    """Return whether a text is a number of ASCII digits alone, and not of more than `most_digits`."""
    # `int` accepts signs, blanks, underscores and the digits of every script, and takes long for many.
    return text.isascii() and text.isdecimal() and len(text) <= most_digits


def without_digits(text: str) -> str:
    """Return a text without its digits: sentences that differ in their numbers alone are then the same."""
    return "".join(character for character in text if not character.isdigit())


class CountedReasons:
    """Counts reasons; those that differ in their numbers alone count as one, without these numbers."""

    def __init__(self) -> None:
        self._counts: dict[str, tuple[int, str]] = {}

    def add(self, reason: str) -> None:
        """Count a reason."""
        kind = without_digits(reason)
        count, before = self._counts.get(kind, (0, reason))
        # Both have the same blanks, because they have the same kind.
        words = zip(before.split(" "), reason.split(" "), strict=True)
        shared = " ".join(word if word == other else _NUMBER.sub("…", other) for word, other in words)
        self._counts[kind] = count + 1, shared

    @property
    def total(self) -> int:
        """The number of reasons."""
        return sum(count for count, _ in self._counts.values())

    @property
    def most_frequent_first(self) -> list[tuple[int, str]]:
        """Each reason with its count."""
        return sorted(self._counts.values(), key=lambda counted_reason: -counted_reason[0])
