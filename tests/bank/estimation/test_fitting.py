"""What cannot be calibrated on is said in a sentence."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation import TRUSTED, fit


def with_a_nan(values):
    spoilt = values.copy()
    spoilt.flat[len(spoilt) // 2] = np.nan
    return spoilt


@pytest.mark.parametrize("name", ["t_s", "channels", "torque_nm"])
def test_values_that_are_no_numbers_are_told(recorded, name):
    spoilt = replace(recorded, **{name: with_a_nan(getattr(recorded, name))})
    with pytest.raises(CalibrationError, match="recording 2 of 2 holds 1 value that is not a finite number"):
        fit("motion_regression", [recorded, spoilt], "rig", timing=TRUSTED)


def test_a_recording_or_slice_without_frames_or_numbers_is_told(recorded, sliced):
    slices = sliced()
    for series, message in (
        ([replace(slices, channels=with_a_nan(slices.channels))], "holds 1 value that is not a finite"),
        ([recorded.between(0, 0)], "recording 1 of 1 has no frames"),
        ([slices, slices.between(0, 0)], "recording 2 of 2 has no frames"),
        ([slices, recorded], "do not fit into one calibration"),
    ):
        with pytest.raises(CalibrationError, match=message):
            fit("motion_regression", series, "nothing")


def test_a_torque_of_a_single_frame_is_too_little_to_calibrate_on(recorded):
    torque = recorded.torque_nm.copy()
    torque[900] = 1000.0
    with pytest.raises(CalibrationError, match="from the first torque to the last there are 1 frames"):
        fit("motion_regression", [replace(recorded, torque_nm=torque)], "rig", timing=TRUSTED)
