"""The questions of a commissioning to the person at the robot."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from shearloop.errors import UserError

# The word that allows one motion or one action of the operator.
WORD: Final = "move"
DONE: Final = "done"
# Wrong answers until the commissioning ends.
_MOST_TRIES: Final = 3


class DeclinedError(UserError):
    """The operator did not allow a motion."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Asks and tells; `answer` returns the line that is typed after a question."""

    answer: Callable[[str], str]
    say: Callable[[str], None]

    def ask(self, question: str) -> str:
        """Return the answer, without blanks around it."""
        return self.answer(question).strip()

    def number(self, question: str, low: float, high: float) -> float:
        """Return a number within a range; raises UserError after some other answers."""
        for _ in range(_MOST_TRIES):
            try:
                value = float(self.ask(f"{question} ({low:g} to {high:g}):"))
            except ValueError:
                continue
            if low <= value <= high:
                return value
        raise UserError(f"no number from {low:g} to {high:g} was given: {question}")

    def allow(self, motion: str) -> None:
        """Show a motion with its speed and travel, and return once the word was typed; raises DeclinedError."""
        if (
            self.ask(f"MOTION: {motion}. Keep clear, one hand at the emergency stop. Type `{WORD}` to allow it:")
            != WORD
        ):
            raise DeclinedError(f"not allowed: {motion}. What is measured so far is kept; run it again to continue")

    def act(self, action: str) -> None:
        """Have the operator do something; raises DeclinedError where it is not done."""
        if self.ask(f"{action}. Type `{DONE}`:") != DONE:
            raise DeclinedError(f"not done: {action}. What is measured so far is kept; run it again to continue")
