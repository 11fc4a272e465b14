"""Torques that are stamped at other times than the frames: measured by how single frames move as the load changes."""

from dataclasses import replace

import numpy as np
import pytest

from bank.errors import CalibrationError
from bank.estimators import fit
from bank.estimators.alignment import alignment


@pytest.mark.parametrize("late_s", [-2.0, -0.5, 0.0, 0.3, 1.0, 4.0])
def test_lateness_is_measured_to_a_quarter_of_a_frame(recorded, late_s):
    found = alignment(replace(recorded, torque_t_s=recorded.torque_t_s + late_s))
    assert found is not None
    assert found.late_s == pytest.approx(late_s, abs=0.13)


@pytest.mark.parametrize("late_s", [-0.6, 0.8, 4.0])
def test_torques_that_are_stamped_at_other_times_are_refused_unless_somebody_vouches_for_them(recorded, late_s):
    late = replace(recorded, torque_t_s=recorded.torque_t_s + late_s)
    with pytest.raises(CalibrationError, match=f"s {'before' if late_s > 0 else 'after'} the load that moves"):
        fit("fused", [late], "late")
    assert fit("regression", [late], "vouched for", trust_times=True).torque is not None


def test_nothing_is_said_where_no_load_changes_the_frames(recorded):
    noise = np.random.default_rng(0).normal(0, 1e-3, recorded.channels.shape)
    assert alignment(replace(recorded, channels=recorded.channels[50] + noise)) is None


def test_a_knocked_frame_does_not_hide_the_rest(recorded):
    knocked = recorded.channels.copy()
    knocked[[90, 140]] *= 1.5
    found = alignment(replace(recorded, channels=knocked))
    assert found is not None
    assert abs(found.late_s) < 0.2
