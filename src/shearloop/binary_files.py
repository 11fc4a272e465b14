"""What a file without text is, by its first bytes, and which command reads it."""

from typing import Final

SAVED_AS_UTF_8: Final = "save the file with the encoding UTF-8"
FIRST_BYTES: Final = {
    b"PK\x03\x04": "a calibration, which `shearloop evaluate` reads, or another archive",
    b"\x8eSHLBANK": "a bank, which `shearloop bank info` reads",
    b"\x89MCAP": "a recording, which `shearloop recording info` reads",
    b"MATLAB": "a MATLAB file, which `shearloop recording import mat` reads",
}


# The marks of byte order that a text in UTF-16 may begin with.
_BYTE_ORDERS: Final = (b"\xff\xfe", b"\xfe\xff")
IN_UTF_16: Final = f"the file is text in UTF-16, and not in UTF-8; {SAVED_AS_UTF_8}"


def is_utf_16(data: bytes) -> bool:
    """Return whether a file is text in UTF-16: of ASCII characters, every second byte is 0."""
    return data.startswith(_BYTE_ORDERS) or data[:8].count(0) == len(data[:8]) / 2 > 0


def why_no_text(data: bytes, at: int, what: str) -> str:
    """Return the place in a file with these bytes, and why it is no text; `at` is its first byte that is none.

    Both follow the path of the file, which is meant as a `what`.
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
    return f":{line}:{column}: {found}; {SAVED_AS_UTF_8}"
