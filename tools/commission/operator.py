"""The questions of a commissioning to the person at the robot."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from shearloop.errors import UserError
from shearloop.tools.commission.given_word import GivenWord

# The word that allows one motion or one action of the operator.
WORD: Final = "move"
DONE: Final = "done"
# The word by which the operator accepts something that was not tried before.
GO_ON: Final = "continue"
# Answers that end the commissioning at once, an empty line among them.
_NO: Final = ("", "no")
# Wrong answers until the commissioning ends.
_MAX_TRIES: Final = 3


class DeclinedError(UserError):
    """The operator did not allow a motion, or did not go on."""


@dataclass(frozen=True, slots=True)
class Played:
    """What emulated devices do in the place of the operator's hands, once the operator has typed the word.

    `shown` says it to the operator, who types the words and numbers. `commands` are of `shearloop emulate rig`, with
    `{}` for the number; without one nothing has to be done.
    """

    shown: str
    commands: tuple[str, ...] = ()


NOTHING_TO_DO: Final = Played("there is nothing to do")


class Play(Protocol):
    """Has the emulated devices carry out a command of `shearloop emulate rig`."""

    def __call__(self, command: str) -> None:
        """Return once it is carried out; raises UserError where it is not."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Asks and tells; `answer` returns the line that is typed after a question.

    `play` is of devices that are emulated for this commissioning, and None for others. `allows`: who answers may allow
    a motion, as a person at a terminal and any script for emulated devices. `word` is the one that was typed last.
    """

    answer: Callable[[str], str]
    say: Callable[[str], None]
    play: Play | None = None
    allows: bool = False
    word: GivenWord = field(default_factory=GivenWord)

    def ask(self, question: str, played: Played | None = None) -> str:
        """Return the answer, without blanks around it."""
        return self.answer(self._with_hint(question, played)).strip()

    def word_of(self, question: str) -> str:
        """Return an answer that is not empty; raises UserError after some empty ones."""
        for _ in range(_MAX_TRIES):
            if answer := self.ask(question):
                return answer
            self.say("Nothing was typed.")
        raise UserError(f"nothing was typed: {question.removesuffix(':')}")

    def number(self, question: str, low: float, high: float, played: Played | None = None) -> float:
        """Return a number within a range; raises UserError after some other answers."""
        for _ in range(_MAX_TRIES):
            answer = self.ask(f"{question} ({low:g} to {high:g}):", played)
            if (value := _number(answer)) is not None and low <= value <= high:
                self._do(played, value)
                return value
            with_point = answer.replace(",", ".")
            cure = f": write {with_point}" if "," in answer and _number(with_point) is not None else ""
            self.say(f"{answer!r} is no number from {low:g} to {high:g}{cure}.")
        raise UserError(f"no number from {low:g} to {high:g} was given: {question}")

    def choose(self, question: str, choices: Sequence[str], played: Played | None = None) -> str:
        """Return the chosen word; raises UserError after some other answers."""
        for _ in range(_MAX_TRIES):
            answer = self.ask(f"{question} {' or '.join(choices)}?", played).lower()
            if answer in choices:
                return answer
            self.say(f"{answer!r} is not {' or '.join(f'`{choice}`' for choice in choices)}.")
        raise UserError(f"neither {' nor '.join(choices)} was given: {question.removesuffix(':')}")

    def allow(self, motion: str) -> None:
        """Show a motion with its speed and travel, and return once the word was typed; raises DeclinedError.

        Raises UserError where the answers are a script, and no person sees the motion before.
        """
        if not self.allows:
            raise UserError(
                f"the answers do not come from a terminal, and a person has to allow this motion: {motion}. Run it in "
                "a terminal, without a pipe or a file before it"
            )
        question = f"MOTION: {motion}. Keep clear, one hand at the emergency stop. Type `{WORD}` to allow it:"
        self._confirm(question, WORD, f"not allowed: {motion}")
        self.word.give(motion)

    def allow_again_after_standstill(self) -> None:
        """Return at once, or once the last motion is allowed again where this program stood still since its word."""
        if (stood_s := self.word.standstill_s()) > 0.0 and self.word.motion:
            self.say(
                f"This program stood still for {stood_s:.0f} s since `{WORD}` was typed, by Ctrl-Z or on a suspended "
                "computer. Look at the rig."
            )
            Operator.allow(self, self.word.motion)

    def accept(self, warning: str) -> None:
        """Show a warning, a whole sentence, and return once the operator goes on; raises DeclinedError."""
        self._confirm(f"{warning} Type `{GO_ON}` to continue with it:", GO_ON, f"not accepted: {warning}")

    def act(self, action: str, played: Played = NOTHING_TO_DO) -> None:
        """Have the operator do something; raises DeclinedError where it is not done."""
        question = f"{self._with_hint(f'{action}.', played)} Type `{DONE}`:"
        self._confirm(question, DONE, f"not done: {action}")
        self._do(played)

    def _confirm(self, question: str, word: str, declined: str) -> None:
        """Return once the word was typed. A word that is misspelt is asked for again; raises DeclinedError."""
        cause = f"another word than `{word}` was typed {_MAX_TRIES} times"
        for _ in range(_MAX_TRIES):
            answer = self.ask(question)
            if answer == word:
                return
            if answer in _NO:
                cause = f"`{answer}` was typed" if answer else "nothing was typed"
                break
            self.say(f"{answer!r} is not `{word}`, so that nothing was done. `no` ends the commissioning here.")
        raise DeclinedError(f"{cause}, so this was {declined.removesuffix('.')}")

    def _with_hint(self, question: str, played: Played | None) -> str:
        """Return the question with what the emulated devices do, if there are any, before its last character."""
        if self.play is None or played is None:
            return question
        return f"{question[:-1]} [emulated: {played.shown}]{question[-1]}"

    def _do(self, played: Played | None, value: float = 0.0) -> None:
        if self.play is None or played is None:
            return
        for command in played.commands:
            self.play(command.format(f"{value:g}"))


def _number(answer: str) -> float | None:
    """Return the number that was typed, or None."""
    try:
        return float(answer)
    except ValueError:
        return None
