"""What a file without text is, by its first bytes, and which command reads it."""

import codecs
from typing import Final

_SAVE_AS_UTF_8: Final = "save the file with the encoding UTF-8"
IN_UTF_16: Final = f"the file is text in UTF-16, and not in UTF-8; {_SAVE_AS_UTF_8}"
FIRST_BYTES: Final = {
    b"PK\x03\x04": "a calibration, which `shearloop evaluate` reads, or another archive",
    b"\x8eSHLBANK": "a bank, which `shearloop bank info` reads",
    b"\x89MCAP": "a recording, which `shearloop recording info` reads",
    b"MATLAB": "a MATLAB file, which `shearloop recording import mat` reads",
}


def is_utf_16(data: bytes) -> bool:
    """Return whether a file is text in UTF-16: it has a byte order mark, or half of its first bytes are 0."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return True
    # One byte of each ASCII character is 0.
    first = data[:8]
    return bool(first) and 2 * first.count(0) == len(first)


def why_no_text(data: bytes, at: int, what: str) -> str:
    """Return why a file with these bytes is no text in UTF-8, as the end of a message that begins with its path.

    `at` is the index of the first wrong byte, and `what` the kind of file that is expected.
    """
    for first, kind in FIRST_BYTES.items():
        if data.startswith(first):
            return f": the {what} has to be YAML, and this file is {kind}"
    if is_utf_16(data):
        return f": {IN_UTF_16}"
    before = data[:at].decode()
    line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
    found = f"the byte 0x{data[at]:02x} is not UTF-8 text"
    meant = data[at : at + 1].decode("cp1252", "replace")
    if meant.isprintable() and meant != "\ufffd":
        found += f", and would be {meant} in Windows-1252"
    return f":{line}:{column}: {found}; {_SAVE_AS_UTF_8}"
