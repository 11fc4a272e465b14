"""Which load values are stray, by how fast the rig can turn."""

import numpy as np
import pytest

from shearloop.tools.recordings.load_validity import stray_values


def left_out_around(rate_hz: float, spike_s: float) -> np.ndarray:
    """Return which values of 60 s are left out: noise of 0.02 mN·m, and a torque of 0.1 N·m for `spike_s`."""
    t_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    torque_nm = 2e-5 * np.random.default_rng(3).standard_normal(len(t_s))
    torque_nm[(t_s >= 30.0) & (t_s < 30.0 + spike_s)] += 0.1
    return stray_values(t_s, torque_nm)


@pytest.mark.parametrize(("rate_hz", "left_out"), [(10.0, 1), (80.0, 1), (5.0, 1), (2.0, 0), (1.0, 0)])
def test_one_value_is_a_spike_where_the_rig_could_not_turn_there_and_back(rate_hz, left_out):
    assert left_out_around(rate_hz, 0.5 / rate_hz).sum() == left_out


def test_a_short_twist_is_no_spike_however_few_values_it_has():
    for rate_hz in (1.0, 2.0, 5.0, 10.0, 80.0):
        assert not left_out_around(rate_hz, 0.6).any()
