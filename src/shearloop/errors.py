"""Mistakes that end a command with one sentence and exit status 2."""

from typing import NamedTuple


class UserError(Exception):
    """Something in a configuration, a file or a command line that its author can mend; the message says how."""


class Hint(NamedTuple):
    """Something that works less well than it could or not at all, and what helps; both without a full stop."""

    cause: str
    cure: str

    @property
    def sentence(self) -> str:
        """Both as one sentence."""
        return f"{self.cause}: {self.cure}."

    @property
    def clause(self) -> str:
        """Both as a part of a sentence."""
        return f"{self.cause}; {self.cure}"


class ActionError(Exception):
    """An action of the devices that cannot be carried out; the message says why, and what to do."""


class NotBegunError(ActionError):
    """An action was refused before its motion, or before the next one."""
