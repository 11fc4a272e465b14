"""What compiled calls say of the frames of a session, one after the other, against what NumPy says of them."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.values import FrameSeries, TactileFrame
from tests.bank.estimators.odd_frames import BY_NUMPY

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")

FAULTS = (
    "none",
    "dead",
    "one dead",
    "growing",
    "flickering",
    "lost",
    "lost beside dead",
    "blinking",
    "rail",
    "noise",
    "garbled",
    "gap",
)
# How many frames are looked at the long way: the first, those at which masks change, and the one after each.
LONG_LOOKS = {"none": 1, "dead": 3, "one dead": 2, "growing": 9, "lost": 3, "lost beside dead": 7}


def with_fault(fault: str, series: FrameSeries) -> list[TactileFrame]:
    random = np.random.default_rng(1)
    channels, times = series.channels.copy(), series.t_s.copy()
    usable = np.ones(channels.shape, dtype=np.bool_)
    match fault:
        case "dead":
            usable[60:90, :, random.permutation(N_CHANNELS)[:80]] = False
        case "one dead":
            usable[:, 1, 17] = False
        case "growing":
            for n in range(4):
                usable[60 + 20 * n :, n % 2, 3 * n : 30 * n + 5] = False
        case "flickering":
            usable[60::2, :, 200:210] = False
        case "lost":
            channels[60:120, :, 100:160] *= 0.01
        case "lost beside dead":
            usable[40:, :, 300:310] = False
            channels[60:120, :, 100:160] *= 0.01
        case "blinking":
            channels[60:120:5, :, 100:260] *= 0.01
        case "rail":
            channels[60:120] = np.minimum(channels[60:120], np.quantile(channels, 0.97))
        case "noise":
            channels += random.normal(0, 0.002, channels.shape)
        case "garbled":
            channels[::17] = channels[::17][..., random.permutation(N_CHANNELS)]
        case "gap":
            times[80:] += 30.0
    return [TactileFrame.of(float(t), *each) for t, *each in zip(times, channels, usable, strict=True)]


@pytest.mark.parametrize("with_motion", [True, False])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_session_is_the_same_as_by_numpy_but_for_rounding(fused_calibration, twisting, fault, with_motion) -> None:
    motion = replace(fused_calibration.motion, placed=True) if with_motion else None
    memory = SessionState(fused_calibration.guards, motion, period_s=0.54)
    with BY_NUMPY:
        other = SessionState(fused_calibration.guards, motion, period_s=0.54)
    n_valid, first, told = 0, None, None
    with mock.patch.object(memory._guards, "seen", wraps=memory._guards.seen) as looked_long:
        for frame in with_fault(fault, twisting(seed=7)):
            moment = memory.see(frame)
            with BY_NUMPY:
                expected = other.see(frame)
            assert moment.why == expected.why
            np.testing.assert_array_equal(moment.usable, expected.usable)
            np.testing.assert_allclose(moment.channels, expected.channels, rtol=0, atol=1e-12)
            np.testing.assert_allclose(moment.difference, expected.difference, rtol=0, atol=1e-12)
            if not moment.why:
                n_valid += 1
                first, told = (moment, expected) if n_valid == 1 else (first, told)
                np.testing.assert_allclose(memory.held, other.held, rtol=0, atol=1e-12)
                assert (memory.moved is not None) == with_motion
                if memory.moved is not None:
                    np.testing.assert_allclose(memory.moved, other.moved, rtol=0, atol=1e-9)
                    from_idle = motion.places(moment.difference)
                    np.testing.assert_allclose(memory.moved[-len(from_idle) :], from_idle, rtol=0, atol=1e-9)
    assert n_valid > 100
    np.testing.assert_allclose(
        first.difference, told.difference, rtol=0, atol=1e-12, err_msg="moments stay as they were"
    )
    assert not np.array_equal(first.difference, memory.held)
    assert looked_long.call_count == LONG_LOOKS.get(fault, looked_long.call_count)
