"""The sender of a command, by the client's own words. Nothing checks it: it is only for the log and the events."""

import os
from collections.abc import Mapping
from typing import Any

from shearloop.printable import printable

# Of a name in messages.
_LONGEST = 80
UNKNOWN = "an unnamed client"


def caller(program: str) -> str:
    """Return the name of this process's user with the computer and the program, for `by` of a request."""
    user = os.environ.get("USER") or os.environ.get("LOGNAME") or f"user {os.getuid()}"
    return f"{user}@{os.uname().nodename}, {program}"


def caller_of(request: Mapping[str, Any]) -> str:
    """Return who a request says that it is from, as one printable line."""
    by = request.get("by")
    return " ".join(printable(by).split())[:_LONGEST] if isinstance(by, str) and by.strip() else UNKNOWN
