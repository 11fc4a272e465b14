"""A design follows from the noise: more noise, less model; and it finds the model that made the frames."""

from pathlib import Path

import numpy as np
import pytest

from bank.channels import CHANNELS
from bank.design import ALLOWED, Choice, Scene, Step, _board_choices, designed
from bank.errors import CalibrationError
from bank.fingertip import Fingertip
from bank.forward import ForwardModel
from bank.models import conductivity
from daemon.bank_config import FingertipConfig
from daemon.config_file import load_yaml_model

FINGERTIP = Path(__file__).parents[2] / "config" / "fingertips" / "paper.yaml"
PLACES = [(3.1 + 0.02 * i, 1.3 + 0.04 * i) for i in range(10)]


@pytest.fixture(scope="module")
def fingertip() -> Fingertip:
    return load_yaml_model(FINGERTIP, FingertipConfig).fingertip()


@pytest.fixture(scope="module")
def clean(fingertip: Fingertip) -> np.ndarray:
    mesh = fingertip.mesh()
    forward = ForwardModel(mesh)
    homogeneous = forward.homogeneous()
    cells = [conductivity(mesh, "gaussian_derivative", k, sigma) for k, sigma in PLACES]
    return np.abs([forward.voltages(cell) - homogeneous for cell in cells]) * 0.01


def scene(clean: np.ndarray, noise_v: float) -> Scene:
    rng = np.random.default_rng(3)
    return Scene(np.abs(clean + rng.normal(0.0, noise_v, clean.shape)), noise_v, np.linspace(0.0, 0.1, len(clean)))


@pytest.fixture(scope="module")
def quiet(clean, fingertip):
    return designed(scene(clean, 2e-5), fingertip)


def test_more_noise_asks_for_less_of_everything(clean, fingertip, quiet) -> None:
    noisy = designed(scene(clean, 2e-4), fingertip)
    assert noisy.relative_noise == pytest.approx(10 * quiet.relative_noise, rel=0.05)
    assert noisy.mesh.chosen.setting > quiet.mesh.chosen.setting
    assert noisy.k_count.chosen.setting < quiet.k_count.chosen.setting
    assert noisy.rank.chosen.setting < quiet.rank.chosen.setting


def test_the_model_that_made_the_frames_is_the_one_that_they_support(quiet) -> None:
    assert quiet.model == "gaussian_derivative"
    others = [one.penalised for one in quiet.models if one.model != quiet.model]
    assert min(one.penalised for one in quiet.models) < 0.7 * min(others)
    assert quiet.k_range[0] < PLACES[0][0] < PLACES[-1][0] < quiet.k_range[1]


def test_every_choice_is_the_coarsest_that_adds_less_than_a_third_of_the_noise(quiet) -> None:
    for choice in (quiet.mesh, quiet.k_count, quiet.sigma_count, quiet.rank, quiet.channels, quiet.injections):
        before = choice.steps[: choice.steps.index(choice.chosen)]
        assert all(step.added > ALLOWED for step in before)
        assert choice.chosen.added <= ALLOWED or choice.chosen is choice.steps[-1]


def test_all_injections_lose_nothing_and_half_of_them_are_twice_as_fast(quiet) -> None:
    assert quiet.injections.steps[-1].added == 0.0
    assert "1.86 frames/s" in quiet.injections.steps[-1].cost
    assert "3.72 frames/s" in quiet.injections.steps[15].cost
    assert len(quiet.injections.steps) == len(np.unique(CHANNELS[:, 0]))


def test_channels_that_drift_as_they_twist_are_not_those_that_are_kept() -> None:
    """Half of the channels move twice as far with the torque, and along the same with a drift that says nothing."""
    rng = np.random.default_rng(4)
    torque, drift = rng.normal(size=(2, 60))
    loud = np.arange(896) % 2 == 0
    slope = np.where(loud, 2e-3, 1e-3) * np.where(rng.random(896) < 0.5, 1, -1)
    frames = 0.1 + np.outer(torque, slope) + np.outer(drift, np.where(loud, 10 * slope, 0.0))
    channels, _ = _board_choices(Scene(frames + rng.normal(0, 1e-3, frames.shape), 1e-3, torque))
    assert {step.setting: step.added for step in channels.steps}[448] < ALLOWED


def test_a_choice_that_nothing_is_good_enough_for_says_so() -> None:
    choice = Choice("mesh size", "cm", (Step(0.5, 3.0, "few"), Step(0.1, 1.0, "many")))
    assert not choice.enough
    assert choice.chosen.setting == 0.1
    assert choice.next_step is None


def test_too_few_frames_are_refused(clean) -> None:
    with pytest.raises(CalibrationError, match="too few to judge a model by"):
        Scene(clean[:5], 1e-4, None)
