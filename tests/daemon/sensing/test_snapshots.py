"""The states of parsers: a restored parser continues like the stored one."""

import pytest

from shearloop.daemon.sensing.snapshots import SnapshotError, restored, snapshot
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


def test_a_state_without_an_attribute_that_the_program_needs_is_of_another_version():
    parser = LoadParser(LoadCalibration.of_torque_lines())
    text = snapshot({"parser": parser}, {}).replace(b'"flagged"', b'"marked"')
    with pytest.raises(SnapshotError, match="LoadParser has no flagged"):
        restored(text, {}, {"parser": parser})
