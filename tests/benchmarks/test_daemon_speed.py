"""The benchmark's daemon takes the calibrations of the emulated rig."""

from dataclasses import replace

from benchmarks.daemon_speed import by_default, played
from shearloop.estimation import TRUSTED, fit
from tests.estimation.conftest import twisting


def test_the_daemon_runs_with_a_calibration_of_emulated_devices(tmp_path):
    recording = replace(twisting(cycles=4, tips=(1,)), emulated=True)
    fit("motion_regression", [recording], "rig", timing=TRUSTED).save(tmp_path / "rig-right.cal")
    with played(by_default(tmp_path, ("right",)), 0.54) as (boards, process, _):
        assert list(boards) == ["right"]
        assert process > 0
