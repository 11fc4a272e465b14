"""Libraries that only some commands need, which the extras of the package bring."""

import shlex
import sys
from importlib.util import find_spec

from shearloop.errors import UserError


def require(module: str, extra: str, what: str) -> None:
    """Raise UserError if a module is not installed that `what` needs, and that `extra` of shearloop brings."""
    if find_spec(module) is None:
        raise missing(module, extra, what)


def missing(module: str | None, extra: str, what: str) -> UserError:
    """Return the error of a module that is not installed, with the command that installs it for this Python."""
    install = shlex.join([sys.executable, "-m", "pip", "install", f"shearloop[{extra}]"])
    return UserError(f"{what} needs {module}: `{install}`")
