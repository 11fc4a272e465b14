"""What an examination comes to: what was found, what it means, and the next step."""

from dataclasses import dataclass
from typing import Literal

State = Literal["good", "note", "trouble"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. `means` and `next_step` are empty where nothing follows from it."""

    subject: str
    state: State
    found: str
    means: str = ""
    next_step: str = ""


def good(subject: str, found: str) -> Finding:
    """Return the finding that all is well."""
    return Finding(subject, "good", found)


def note(subject: str, found: str, means: str, next_step: str) -> Finding:
    """Return the finding of something that works, but not as well as it could."""
    return Finding(subject, "note", found, means, next_step)


def trouble(subject: str, found: str, means: str, next_step: str) -> Finding:
    """Return the finding of what keeps the loop from working."""
    return Finding(subject, "trouble", found, means, next_step)


def from_sentence(subject: str, sentence: str, means: str) -> Finding:
    """Return the finding of an error, whose last sentence, or what follows its last `;`, is the cure."""
    for mark in ("; ", ". "):
        what, found, cure = sentence.rpartition(mark)
        if found:
            return trouble(subject, what, means, cure.rstrip("."))
    return from_file(subject, sentence, means)


def from_file(subject: str, sentence: str, means: str) -> Finding:
    """Return the finding of a file whose mistakes a sentence names, all of them."""
    return trouble(subject, sentence, means, "mend what it names, then `shearloop doctor CONFIG` again")
