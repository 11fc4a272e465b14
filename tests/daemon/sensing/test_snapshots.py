"""The states of parsers: a restored parser continues like the stored one."""

import numpy as np
import pytest

from shearloop.daemon.sensing.snapshots import SnapshotError, restored, snapshot
from shearloop.drivers.eit_kit import FrameParser
from shearloop.drivers.load_cell import LoadCalibration, LoadParser
from shearloop.drivers.serial_sensor import InputKind, RawEvent


@pytest.mark.parametrize(
    "calibration",
    [LoadCalibration.of_torque_lines(), LoadCalibration(tare_counts=81_250, scale_n_per_count=2.3e-5, sign=-1)],
)
def test_a_restored_load_cell_takes_a_tare(calibration):
    stored = LoadParser(calibration)
    stored.handle(RawEvent(InputKind.TARE, 0, b"0.25"))
    restored_one = restored(snapshot({"parser": stored}, {}), {}, {"parser": LoadParser(calibration)})["parser"]
    assert restored_one.calibration == stored.calibration
    for parser in (stored, restored_one):
        parser.handle(RawEvent(InputKind.TARE, 1, b"0.5"))
    assert restored_one.calibration == stored.calibration != calibration


@pytest.mark.parametrize(
    "parser", [LoadParser(LoadCalibration.of_torque_lines()), FrameParser(np.zeros(896, dtype=bool))]
)
def test_a_parser_that_has_refused_a_line_is_restored_with_the_reason(parser):
    parser.handle(RawEvent(InputKind.OPENED, 0))
    parser.handle(RawEvent(InputKind.DATA, 3 * 10**9, b"0.1, 0.2\r\n" * 5))
    assert parser.refusal is not None
    assert restored(snapshot({"parser": parser}, {}), {}, {"parser": parser})["parser"].refusal == parser.refusal


def test_a_state_without_an_attribute_that_the_program_needs_is_of_another_version():
    parser = LoadParser(LoadCalibration.of_torque_lines())
    text = snapshot({"parser": parser}, {}).replace(b'"flagged"', b'"marked"')
    with pytest.raises(SnapshotError, match="LoadParser has no flagged"):
        restored(text, {}, {"parser": parser})
