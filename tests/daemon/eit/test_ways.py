"""Whatever a board sends, and whenever: what compiled code says of a session is what NumPy says."""

from collections.abc import Callable
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS
from shearloop.bank.estimation import Calibration, FrameSeries, fit
from shearloop.daemon.sensing.estimator import Reading
from shearloop.daemon.sensing.tracking import TrackedEstimator
from shearloop.drivers.eit_kit import Frame
from tests.bank.estimators.conftest import PERIOD_S, series

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")
BY_NUMPY = mock.patch.object(compiled, "IS_COMPILED", False)
ODD = (np.nan, np.inf, -np.inf, 0.0, -0.3, 1e300, 5e-324)
# What befalls some of the channels of one side of some frames; all of them; and when frames come.
OF_CHANNELS = ("dead", "dead unseen", "saturated", "saturated unseen", "lost", "odd", "odd and dead", "flickering")
OF_FRAMES = ("repeated", "missing", "out of order", "still", "garbled", "another", "let go", "gap", "louder")


@pytest.fixture(scope="module")
def calibration_of() -> Callable[[str, int], Calibration]:
    """Return what gives the calibration of an estimator on so many fingertips."""
    recorded = series()
    right = recorded.of_sides(("right",))
    found = {
        (name, len(one.sides)): fit(name, [one], "a played rig")
        for name in ("fused", "regression")
        for one in (recorded, right)
    }
    return lambda name, m: found[name, m]


def spoil(fault: tuple[str, int, int, int], channels: np.ndarray, flags: dict[str, np.ndarray]) -> None:
    """Let something befall channels (n, m, 896) of frames, and what the board says of them; a few at least."""
    kind, first, n, seed = fault
    random, rows = np.random.default_rng(seed), slice(first, first + n)
    side, some = random.integers(channels.shape[1]), random.permutation(N_CHANNELS)[: random.integers(1, 260)]
    if random.integers(2):
        some = np.flatnonzero((CHANNELS[:, 2:] == random.integers(32)).any(axis=1))
    match kind:
        case "dead" | "dead unseen":
            channels[rows, side, some] = channels[min(first, len(channels) - 1), side, some]
            flags["dead"][rows, side, some] = kind == "dead"
        case "saturated" | "saturated unseen":
            channels[rows, side, some] = 2.2
            flags["saturated"][rows, side, some] = kind == "saturated"
        case "lost":
            channels[rows, side, some] *= 0.01
        case "odd" | "odd and dead":
            channels[rows, side, some] = random.choice(ODD)
            flags["dead"][rows, side, some] |= kind == "odd and dead"
        case "flickering":
            flags["dead"][slice(first, first + n, 2), side, some] = True
        case "still":
            channels[rows] = channels[min(first, len(channels) - 1)]
        case "garbled":
            channels[rows, side] = channels[rows, side][:, random.permutation(N_CHANNELS)]
        case "another":
            channels[rows, side] = random.uniform(0.05, 0.5, N_CHANNELS)
        case "let go":
            channels[rows] = channels[0]
        case "louder":
            channels[rows] *= random.uniform(0.3, 3.0)


def frame_of(
    number: int, t_ns: int, channels: np.ndarray, dead: np.ndarray, saturated: np.ndarray, repeated: np.ndarray
) -> Frame:
    return Frame(
        channels=channels, raw=np.zeros(1024), line=b"", t_mid_ns=t_ns, t_arrival_ns=t_ns, seq=number,
        saturated=saturated, dead=dead, unusable=int((saturated | dead).sum()), repeated=bool(repeated[0]),
    )  # fmt: skip


def frames_of(played: FrameSeries, faults: list[tuple[str, int, int, int]]) -> list[tuple[Frame, ...]]:
    channels = played.channels.copy()
    flags = {name: np.zeros(channels.shape, dtype=np.bool_) for name in ("dead", "saturated", "repeated")}
    t_ns, is_there = np.round(1e9 * played.t_s).astype(np.int64), np.ones(len(channels), dtype=np.bool_)
    for kind, first, n, seed in faults:
        spoil((kind, first, n, seed), channels, flags)
        match kind:
            case "repeated":
                flags["repeated"][first : first + 1 + n // 20, seed % channels.shape[1], 0] = True
            case "missing":
                is_there[first : first + 1 + seed % 5] = False
            case "out of order":
                t_ns[first : first + 2] = t_ns[first : first + 2][::-1]
            case "gap":
                t_ns[first:] += round(n * 1e8)
    return [
        tuple(
            frame_of(number, int(t_ns[number]), *(each[number, side] for each in (channels, *flags.values())))
            for side in range(channels.shape[1])
        )
        for number in np.flatnonzero(is_there)
    ]


def assert_same(one: Reading, other: Reading) -> None:
    assert one.why == other.why
    assert (one.difference is None) == (other.difference is None)
    if one.difference is not None:
        np.testing.assert_allclose(one.difference, other.difference, rtol=0, atol=1e-12)
    for name in ("torque_nm", "diameter_mm"):
        mine, its = getattr(one, name), getattr(other, name)
        assert (mine is None) == (its is None)
        if mine is not None:
            found = [mine.low, mine.value, mine.high]
            assert np.isfinite(found).all()
            assert found == sorted(found)
            np.testing.assert_allclose(found, [its.low, its.value, its.high], rtol=1e-9, atol=1e-12)


FAULTS = st.lists(
    st.tuples(
        st.sampled_from([*OF_CHANNELS, *OF_CHANNELS, *OF_FRAMES]),
        st.integers(0, 140), st.integers(1, 100), st.integers(0, 2**32 - 1),
    ),
    max_size=5,
)  # fmt: skip


@settings(deadline=None, max_examples=30)
@given(
    st.sampled_from(["fused", "fused", "regression"]),
    st.integers(1, 2),
    FAULTS,
    st.sets(st.integers(0, 140), max_size=2),
)
def test_a_session_is_read_as_by_numpy_whatever_comes(calibration_of, name, m, faults, tares) -> None:
    calibration = calibration_of(name, m)
    played = series(cycles=2, seed=9).of_sides(calibration.sides)
    with BY_NUMPY:
        by_numpy = TrackedEstimator(calibration, None, None, baseline_frames=6, period_s=PERIOD_S)
    estimator = TrackedEstimator(calibration, None, None, baseline_frames=6, period_s=PERIOD_S)
    n_valid = 0
    with np.errstate(all="ignore"):
        for number, frames in enumerate(frames_of(played, faults)):
            if number in tares:
                estimator.tare()
                with BY_NUMPY:
                    by_numpy.tare()
            found = estimator.update(*frames)
            with BY_NUMPY:
                expected = by_numpy.update(*frames)
            assert_same(found, expected)
            assert found.valid == (found.torque_nm is not None)
            n_valid += found.valid
    assert faults or tares or n_valid > 80
