"""What cannot be calibrated on is said in a sentence."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import TRUSTED, fit


def with_a_nan(series, name):
    spoilt = getattr(series, name).copy()
    spoilt.flat[len(spoilt) // 2] = np.nan
    return replace(series, **{name: spoilt})


def of_a_single_frame(series):
    torque = series.torque_nm.copy()
    torque[900] = 1000.0
    return replace(series, torque_nm=torque)


NO_NUMBER = "holds 1 value that is not a finite number"


@pytest.mark.parametrize(
    ("recordings_of", "message"),
    [
        (lambda raw: [raw, with_a_nan(raw, "t_s")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw, with_a_nan(raw, "channels")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw, with_a_nan(raw, "torque_nm")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw.between(0, 0)], "recording 1 of 1 has no frames"),
        (lambda raw: [raw, raw.between(0, 0)], "recording 2 of 2 has no frames"),
        (lambda raw: [of_a_single_frame(raw)], "from the first torque to the last there are 1 frames"),
    ],
)
def test_recordings_that_determine_nothing_are_refused(recorded, recordings_of, message):
    with pytest.raises(CalibrationError, match=message):
        fit("motion_regression", recordings_of(recorded), "rig", timing=TRUSTED)
