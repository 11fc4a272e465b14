"""What a file without text is, by its first bytes, and which command reads it."""

from typing import Final

FIRST_BYTES: Final = {
    b"PK\x03\x04": "a calibration, which `shearloop evaluate` reads, or another archive",
    b"\x8eSHLBANK": "a bank, which `shearloop bank info` reads",
    b"\x89MCAP": "a recording, which `shearloop recording info` reads",
    b"MATLAB": "a MATLAB file, which `shearloop recording import mat` reads",
}


def why_no_text(data: bytes, at: int) -> str:
    """Return what a file with these bytes is, in words; `at` is its first byte that is no text."""
    for first, what in FIRST_BYTES.items():
        if data.startswith(first):
            return f"has to be YAML, and this file is {what}"
    return f"is not UTF-8 text (byte {at})"
