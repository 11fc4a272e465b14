"""Mistakes that end a command with one sentence and exit status 2."""

from importlib.util import find_spec


class UserError(Exception):
    """Something in a configuration, a file or a command line that its author can mend; the message says how."""


def require(module: str, extra: str, what: str) -> None:
    """Raise UserError if a module is not installed that `what` needs, and that `extra` of shearloop brings."""
    if find_spec(module) is None:
        raise UserError(f"{what} needs {module}: `pip install 'shearloop[{extra}]'`")
