"""Checks of a stored calibration's header."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shearloop.bank.errors import CalibrationError


def check_version(path: Path, header: Mapping[str, Any], version: int) -> None:
    """Raise CalibrationError, naming the file, for a header of another format version."""
    if header.get("format_version") != version:
        raise CalibrationError(
            f"{path}: the calibration has format version {header.get('format_version')}, expected {version}; "
            "calibrate again"
        )


def check_made_with(path: Path, header: Mapping[str, Any], identities: Mapping[str, str]) -> None:
    """Raise CalibrationError, naming the file, for a header that has other identities under these keys."""
    for key, wanted in identities.items():
        if header.get(key) != wanted:
            what = key.removesuffix("_hash").removesuffix("_identity").replace("_", " ")
            raise CalibrationError(
                f"{path}: the calibration was made with the {what} {str(header.get(key))[:12]}…, expected "
                f"{wanted[:12]}…; calibrate again"
            )
