"""A slip in --out costs nobody a file: commands write over what is of their own kind, and over nothing else."""

import io
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from shearloop.errors import UserError
from shearloop.tools.outputs import check_overwrite

MCAP = b"\x89MCAP0\r\n and what cannot be recorded again"


def matlab() -> bytes:
    file = io.BytesIO()
    savemat(file, {"LF2data": np.zeros((4, 4))})
    return file.getvalue()


# Each mistake must be told before anything else is looked at, or solved for minutes; so nothing that is named is there.
@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("calibrate no.mcap --out", "an estimator's calibration"),
        ("calibrate load --mass-g 100 --lever-arm-mm 35 --port no --out", "a calibration file"),
        ("calibrate gripper --diameter-mm 10 --diameter-mm 20 --port no --out", "a calibration file"),
        ("skin calibrate no.csv --out", "a calibration file"),
        ("bank build --config {bank} --out", "a bank"),
        ("bank solve --mesh no --model step --k 1 --sigma 1 --out", "an array of NumPy"),
        ("bank design no.mcap --out", "a configuration"),
        ("recording import mat no.mat --out", "a recording"),
        ("recording export no.mcap --format mat --out", "a MATLAB file"),
    ],
)
def test_no_command_overwrites_a_file_of_another_kind(command, kind, tmp_path, mistake):
    there = tmp_path / "precious"
    content = matlab() if kind == "a recording" else MCAP
    there.write_bytes(content)
    bank = Path(__file__).parents[2] / "config" / "banks" / "demo.yaml"
    assert f"{there} exists and is not {kind}: it was not changed" in mistake(*command.format(bank=bank).split(), there)
    assert there.read_bytes() == content


@pytest.mark.parametrize("content", [MCAP, b"PK\x03\x04\x14\0", matlab(), b"\x8eSHLBANK", "σ".encode()[:1] + b"x"])
def test_text_overwrites_only_text(content, tmp_path):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(UserError, match="is not a configuration"):
        check_overwrite(tmp_path / "file", "a configuration")


def test_same_kind_empty_and_special_files_may_be_overwritten(tmp_path):
    file = tmp_path / "file"
    check_overwrite(file, "a bank", b"BANK")
    file.touch()
    check_overwrite(file, "a bank", b"BANK")
    file.write_bytes(b"BANK of old")
    check_overwrite(file, "a bank", b"BANK")
    # The last character that is looked at lies half beyond the end.
    file.write_text("x" * 511 + "σ", encoding="utf-8")
    check_overwrite(file, "a configuration")
    os.mkfifo(tmp_path / "pipe")
    check_overwrite(tmp_path / "pipe", "a bank", b"BANK")
    check_overwrite(tmp_path, "a bank", b"BANK")
