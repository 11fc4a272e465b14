"""The question before a motion: only the motion that the operator confirmed is carried out."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

from shearloop.errors import UserError


@dataclass(frozen=True, slots=True)
class Question:
    """A question, with the plan of an experiment; the confirmation gives back `digest`, which names the content."""

    text: str
    digest: str
    plan: tuple[str, ...] = ()

    @property
    def facts(self) -> Mapping[str, str | list[str]]:
        """The question as a reply has it."""
        plan = {"plan": list(self.plan)} if self.plan else {}
        return {"question": self.text, "digest": self.digest, **plan}


class QuestionChangedError(UserError):
    """The confirmed content differs from the present one; `question` is the present question."""

    def __init__(self, reason: str, question: Question) -> None:
        super().__init__(reason)
        self.question = question


def digest_of(*parts: bytes | str) -> str:
    """Return the digest of a question's content, in hexadecimal."""
    found = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        # With the length, so that no two contents are one text.
        found.update(len(data).to_bytes(8, "big") + data)
    return found.hexdigest()
