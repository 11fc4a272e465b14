"""The result of one check, and how an error becomes one."""

import errno
import os
from dataclasses import dataclass
from functools import partial
from typing import Literal

MISSING = os.strerror(errno.ENOENT)


@dataclass(frozen=True, slots=True)
class Finding:
    """One check's result. `means` and `next_step` are empty when all is well."""

    subject: str
    found: str
    means: str = ""
    next_step: str = ""
    state: Literal["good", "note", "trouble"] = "good"


# All is well; something works, but not as well as it could; something keeps the loop from working.
good, note, trouble = Finding, partial(Finding, state="note"), partial(Finding, state="trouble")


def split_cure(sentence: str) -> tuple[str, str]:
    """Return an error's message or a task's report without its cure, and the cure.

    The cure follows the last `;` or else the last full stop. It is empty where neither is within the message.
    """
    for mark in ("; ", ". "):
        what, found, cure = sentence.rpartition(mark)
        if found:
            return what, cure.rstrip(".")
    return sentence, ""


def from_error(subject: str, error: Exception | str, means: str, otherwise: str = "") -> Finding:
    """Return the finding for an error; `otherwise` is the cure where the error names none, else it is a file's."""
    what, cure = split_cure(str(error))
    if cure or otherwise:
        return trouble(subject, what, means, cure or otherwise)
    return from_file(subject, what, means)


def from_file(subject: str, sentence: str, means: str) -> Finding:
    """Return the finding for a file; the sentence names all of its mistakes."""
    cure = "make the file, or correct its name" if MISSING in sentence else "correct the file"
    return trouble(subject, sentence, means, f"{cure}, then run `shearloop doctor CONFIG` again")
