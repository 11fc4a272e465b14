from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.forward import ForwardModel
from shearloop.bank.mesh import load_mesh
from shearloop.bank.models import conductivity
from shearloop.drivers.eit_kit import FrameParser
from shearloop.emulators.boards import format_line
from shearloop.emulators.synthetic_frames import Synthesiser, TwistProgramme
from shearloop.errors import UserError
from shearloop.tools.recordings.matlab_import import read_torque_slices

ADC_STEP_V = 2.2 / 1024


def small_bank() -> SimpleNamespace:
    """Signals with the shape of a bank's, growing with k and σ, that can be computed in advance."""
    k, sigma = np.array([3.0, 3.5]), np.array([1.0, 1.5, 2.0])
    shape = np.cos(PAPER_TABLE.electrodes @ [0.3, 0.1, 0.2, 0.5])
    valid = np.ones((2, 3), bool)
    valid[1, 2] = False
    return SimpleNamespace(
        table=PAPER_TABLE,
        k_grid=k,
        sigma_grid=sigma,
        homogeneous=0.5 * np.sin(PAPER_TABLE.electrodes @ [0.1, 0.2, 0.3, 0.4]) + 0.7,
        signals=(k[:, None, None] * sigma[None, :, None] * shape / 10).astype(np.float32),
        valid=valid,
    )


def test_frames_have_the_recorded_mean_noise_and_steps_and_pass_the_parser():
    synthesiser = Synthesiser(small_bank())
    lines = np.array([synthesiser.line(3.0, 1.5) for _ in range(400)])
    channels = PAPER_TABLE.channels_of_line(lines)
    assert channels.mean() == pytest.approx(0.13, abs=0.003)
    # A step's own rounding adds its twelfth to the variance.
    assert np.median(channels.std(axis=0)) == pytest.approx(np.hypot(0.002, ADC_STEP_V / 12**0.5), rel=0.05)
    steps = channels / ADC_STEP_V
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert (lines[:, PAPER_TABLE.zero_slots] == 0).all()
    parser = FrameParser(PAPER_TABLE.zero_slots)
    assert len(parser.feed(b"".join(map(format_line, lines)), 0)) == 400


def test_no_live_channel_reads_nothing():
    bank = small_bank()
    bank.homogeneous[:5] = 0.0
    lines = np.array([Synthesiser(bank, seed=seed).line(3.0, 1.5, grip=0.0) for seed in range(20)])
    assert PAPER_TABLE.channels_of_line(lines).min() == pytest.approx(ADC_STEP_V)


def test_without_noise_a_frame_is_the_magnitude_of_homogeneous_and_scaled_signal():
    bank = small_bank()
    synthesiser = Synthesiser(bank, noise_v=0.0)
    gain = 0.13 / np.abs(bank.homogeneous).mean()
    expected = gain * np.abs(bank.homogeneous + 0.5 * 0.17 * bank.signals[0, 1].astype(float))
    found = PAPER_TABLE.channels_of_line(synthesiser.line(3.0, 1.5, grip=0.5))
    assert ((expected - found >= -1e-12) & (expected - found < ADC_STEP_V + 1e-12)).all(), "rounded down to a step"


@given(st.floats(3.0, 3.5), st.floats(1.0, 1.5))
def test_between_cells_the_signal_is_interpolated(k, sigma):
    bank = small_bank()
    shape = bank.signals[0, 0].astype(float) / (3.0 * 1.0)
    np.testing.assert_allclose(Synthesiser(bank).signal(k, sigma), k * sigma * shape, rtol=1e-6, atol=1e-9)


def test_a_twist_during_the_frame_shows_in_the_injections_after_it():
    synthesiser = Synthesiser(small_bank(), noise_v=0.0)
    before, after = (PAPER_TABLE.channels_of_line(synthesiser.line(3.0, sigma)) for sigma in (1.9, 1.1))
    sigma = np.where(np.arange(32) < 20, 1.9, 1.1)
    found = PAPER_TABLE.channels_of_line(
        synthesiser.line(3.0, sigma[synthesiser.injections], np.ones(32)[synthesiser.injections])
    )
    # 28 channels belong to each injection.
    np.testing.assert_array_equal(found, np.concatenate([before[: 20 * 28], after[20 * 28 :]]))
    assert np.count_nonzero(before != after) > PAPER_TABLE.n_channels / 4


@pytest.mark.parametrize(
    ("k", "sigma", "sentence"),
    [
        (2.9, 1.5, "k from 3 to 3.5, and not 2.9"),
        (3.0, 2.1, "sigma from 1 to 2, and not 2.1"),
        (3.4, 1.9, "no signal"),
        (3.0, np.nan, "not nan"),
    ],
)
def test_what_the_bank_does_not_have_is_refused(k, sigma, sentence):
    with pytest.raises(UserError, match=sentence):
        Synthesiser(small_bank()).line(k, sigma)


def test_a_programme_idles_grips_twists_and_lets_go():
    programme = TwistProgramme(torque_nm=0.1, idle_s=10, grip_s=2, turn_s=4, hold_s=6, cycles=2)
    at = programme.at
    assert [at(t) for t in (0.0, 9.9)] == [(0.0, 0.0)] * 2
    assert at(11.0) == (0.5, 0.0)
    assert at(14.0) == (1.0, pytest.approx(0.05))
    assert at(18.0) == (1.0, 0.1)
    assert at(24.0) == (1.0, pytest.approx(0.05))
    assert at(28.0) == (1.0, 0.0)
    assert at(38.0) == (1.0, 0.1), "the second cycle"
    assert at(53.0) == (0.5, 0.0)
    assert at(54.0 + 14.0) == at(14.0), "and again"


def test_the_same_seed_gives_the_same_frames():
    first, again, other = (Synthesiser(small_bank(), seed=seed).line(3.0, 1.5) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_grip_changes_the_frame_by_as_much_as_the_recorded_torques_do(shared):
    mesh = load_mesh(shared / "reference" / "fingertip_mesh.npz")
    forward = ForwardModel(mesh)
    homogeneous = forward.voltages(np.ones(len(mesh.triangles)))
    k, sigma = np.array([3.25]), np.array([1.25, 1.85])
    signals = [[forward.voltages(conductivity(mesh, "gaussian_derivative", k[0], s)) - homogeneous for s in sigma]]
    arrays = {"signals": np.array(signals, np.float32), "valid": np.ones((1, 2), bool)}
    bank = SimpleNamespace(table=PAPER_TABLE, k_grid=k, sigma_grid=sigma, homogeneous=homogeneous, **arrays)
    synthesiser = Synthesiser(bank)
    idle, gripped = (
        np.mean([PAPER_TABLE.channels_of_line(synthesiser.line(3.25, 1.55, grip)) for _ in range(60)], axis=0)
        for grip in (0, 1)
    )
    recorded = read_torque_slices(shared / "recordings" / "torque_slices").differences
    assert np.sqrt(np.mean((gripped - idle) ** 2)) == pytest.approx(np.sqrt(np.mean(recorded**2)), rel=0.1)
