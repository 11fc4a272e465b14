"""Lookalikes: invisible characters, and characters that look like one of ASCII, with their replacements in YAML."""

import unicodedata
from typing import Final

# As chat programs, word processors and keyboards of other scripts write them.
_REPLACEMENTS: Final = {
    **dict.fromkeys("“”„‟«»″＂", '"'),
    **dict.fromkeys("‘’‚‛′＇", "'"),
    **dict.fromkeys("‐‑‒–—―−•·‣▪－", "-"),
    **{"：": ":", "，": ",", "［": "[", "］": "]", "｛": "{", "｝": "}", "．": ".", "＃": "#"},
}


def replacement_of(character: str) -> str | None:
    """Return the ASCII character that replaces a lookalike, empty for an invisible one; None for other characters."""
    if character.isascii():
        return None
    match unicodedata.category(character):
        case "Zs" | "Zl" | "Zp":
            return " "
        case "Cf" | "Cc":
            return ""
    return _REPLACEMENTS.get(character)


def first_lookalike(text: str) -> int | None:
    """Return the index of the first lookalike in a text, None without one."""
    return next((index for index, character in enumerate(text) if replacement_of(character) is not None), None)


def without_lookalikes(text: str) -> str:
    """Return a text with each lookalike replaced."""
    replacements = ((character, replacement_of(character)) for character in text)
    return "".join(character if replacement is None else replacement for character, replacement in replacements)


def describe(lookalike: str) -> str:
    """Return the code and the name of a lookalike, and the cure."""
    replacement = replacement_of(lookalike)
    written = "a space" if replacement == " " else replacement
    cure = f"write {written} instead" if written else "take it out"
    name = unicodedata.name(lookalike, "a control character").lower()
    return f"U+{ord(lookalike):04X} ({name}) stands here; {cure}"


def note_on(text: str) -> str:
    """Return a clause on the first lookalike in a text, empty without one."""
    index = first_lookalike(text)
    if index is None:
        return ""
    before = f"behind {text[:index]!r}" if index else "at the beginning"
    return f"; {before}, {describe(text[index])}"
