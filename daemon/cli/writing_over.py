"""What a command may write over: a file of the kind that it writes, and nothing else.

`shearloop calibrate --out recordings/*.mcap`, with one word left out, names a recording as what is to be written, and
nobody can record it again.
"""

import codecs
from pathlib import Path

from shearloop.daemon.errors import UserError

# As much of a file as tells whether it is text: beyond the 124 characters with which a MATLAB file begins.
_LOOKED_AT_BYTES = 512


def check_writes_over(out: Path, kind: str, begins: bytes | None = None) -> None:
    """Raise UserError where `out` is a file with something in it that does not begin like `kind`; None is any text.

    What cannot be looked at is left to whoever writes, who says why it cannot be written.
    """
    if not out.is_file():
        return
    try:
        with out.open("rb") as file:
            there = file.read(_LOOKED_AT_BYTES)
    except OSError:
        return
    if there and not (_is_text(there) if begins is None else there.startswith(begins)):
        raise UserError(f"{out} is there already, and is not {kind}: it was left as it is; choose another --out")


def _is_text(beginning: bytes) -> bool:
    try:
        # A character may be cut in two where the reading ended.
        codecs.getincrementaldecoder("utf-8")().decode(beginning)
    except UnicodeDecodeError:
        return False
    return b"\0" not in beginning
