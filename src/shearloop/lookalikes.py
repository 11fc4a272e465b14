"""Characters that look like another one, or like nothing, and what is meant by them in a YAML file."""

import unicodedata
from typing import Final

# As chat programs, word processors and keyboards of other scripts write them.
_MEANT: Final = {
    **dict.fromkeys("“”„‟«»″＂", '"'),
    **dict.fromkeys("‘’‚‛′＇", "'"),
    **dict.fromkeys("‐‑‒–—―−•·‣▪－", "-"),
    **{"：": ":", "，": ",", "［": "[", "］": "]", "｛": "{", "｝": "}", "．": ".", "＃": "#"},
}
_NAMES: Final = {" ": "a space"}


def meant_by(character: str) -> str | None:
    """Return what is meant by a character, None by one that stands for itself; an empty text: it does not belong."""
    if character.isascii():
        return None
    match unicodedata.category(character):
        case "Zs" | "Zl" | "Zp":
            return " "
        case "Cf" | "Cc":
            return ""
    return _MEANT.get(character)


def first_lookalike(text: str) -> int | None:
    """Return the index of the first such character of a text, None without one."""
    return next((index for index, character in enumerate(text) if meant_by(character) is not None), None)


def with_what_is_meant(text: str) -> str:
    """Return a text with what is meant by each of its characters."""
    return "".join(character if (meant := meant_by(character)) is None else meant for character in text)


def described(character: str) -> str:
    """Return the name of such a character, and its cure."""
    meant = meant_by(character)
    cure = f"write {_NAMES.get(meant, meant)} instead" if meant else "take it out"
    name = unicodedata.name(character, "a control character").lower()
    return f"U+{ord(character):04X} ({name}) stands here; {cure}"


def note_on(text: str) -> str:
    """Return the end of a sentence on the first such character of a text, or an empty text."""
    index = first_lookalike(text)
    if index is None:
        return ""
    before = f"behind {text[:index]!r}" if index else "at the beginning"
    return f"; {before}, {described(text[index])}"
