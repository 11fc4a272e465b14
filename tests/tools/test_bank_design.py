"""`bank design` on recorded slices: what it prints is what `bank build` takes."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from shearloop.bank.bank_file import Bank
from shearloop.bank.build import build_bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.design import MeasuredFrames, Setting, design_bank, simulated_signals
from shearloop.bank.errors import CalibrationError
from shearloop.bank.forward import BatchForwardModel
from shearloop.cli import main
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.recorder.writer import new_recording
from shearloop.estimation.bank_match import NOT_TURNED, RefinedMatcher
from shearloop.estimation.series import FrameSeries
from shearloop.studies.slices.scene import scene_of_slices
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.bank_config import FingertipGeometryConfig, load_bank_plan, load_geometry
from shearloop.tools.bank_design import design_yaml, scene_of, scene_of_recording
from shearloop.tools.banks import OWN_FINGERTIP


@pytest.fixture(scope="session")
def built(shared, tmp_path_factory) -> Path:
    """Return a folder with a design and the bank built by it, before any test is watched: tqdm keeps a thread."""
    folder = tmp_path_factory.mktemp("design")
    config = folder / "design.yaml"
    assert main(["bank", "design", str(shared / "recordings" / "torque_slices"), "--out", str(config)]) == 0
    assert main(["bank", "build", "--config", str(config), "--out", str(folder / "scene.bank"), "--jobs", "1"]) == 0
    return folder


@pytest.mark.long
def test_a_design_is_a_configuration_that_builds(built):
    config = built / "design.yaml"
    text = config.read_text()
    assert "of a difference frame" in text
    assert "injections" in text
    plan = load_bank_plan(config)
    assert plan.definition.k_grid[0] < 3.3 < plan.definition.k_grid[-1]
    bank = Bank.open(built / "scene.bank")
    np.testing.assert_array_equal(bank.k_grid, plan.definition.k_grid)
    assert bank.valid.any()


def step_frames() -> np.ndarray:
    """Return the model's frames (8, 896) of steps of eight sizes."""
    mesh = load_geometry(OWN_FINGERTIP).mesh
    steps = [Setting(k, 1.0) for k in np.linspace(1.2, 2.2, 8).tolist()]
    return 0.01 * np.abs(simulated_signals(BatchForwardModel(mesh), "step", steps))


@pytest.mark.long
def test_a_design_without_a_sigma_is_a_configuration_of_one_column(tmp_path):
    frames = step_frames()
    # A third of a frame's size: a coarse mesh and few cells, built in no time.
    frames += np.random.default_rng(0).normal(0.0, 8e-4, frames.shape)
    fingertip = load_yaml_model(OWN_FINGERTIP, FingertipGeometryConfig).fingertip()
    design = design_bank(fingertip, MeasuredFrames(frames, 8e-4, None))
    config = tmp_path / "step.yaml"
    config.write_text(design_yaml(design, OWN_FINGERTIP, tmp_path))
    plan = load_bank_plan(config)
    assert plan.definition.model == "step"
    assert len(plan.definition.sigma_grid) == 1
    build_bank(*plan, tmp_path / "step.bank")
    place = RefinedMatcher(Bank.open(tmp_path / "step.bank"), NOT_TURNED).match(frames[4])
    assert abs(place.k - np.linspace(1.2, 2.2, 8)[4]) < 2 * np.diff(plan.definition.k_grid)[0]


@pytest.mark.parametrize(("torque_nm", "is_twisted"), [(0.01, True), (1e-4, False)])
def test_a_twist_is_not_asked_for_where_the_tool_is_twisted(torque_nm, is_twisted, tmp_path, ran):
    rng = np.random.default_rng(0)
    frames = step_frames()[:, rng.permutation(PAPER_TABLE.n_channels)]
    frames += rng.normal(0.0, 5e-3, frames.shape)
    for number, frame in enumerate(frames, 1):
        savemat(
            tmp_path / f"Data_Slice_{number}.mat", {"data_diff": frame[None], "torque_value": torque_nm * number / 8}
        )
    said = ran("bank", "design", tmp_path).err
    assert said.count("record a tool that is gripped and twisted") == (0 if is_twisted else 2)
    assert said.count("the twisted tool") == (2 if is_twisted else 0)


@pytest.mark.parametrize(("noise_v", "mixed_up"), [(1e-4, False), (5e-3, True)])
def test_frames_that_no_model_explains_are_called_so_on_screen_and_in_the_configuration(
    noise_v, mixed_up, tmp_path, ran
):
    frames = step_frames()
    rng = np.random.default_rng(0)
    frames = frames[:, rng.permutation(PAPER_TABLE.n_channels)] if mixed_up else frames
    frames += rng.normal(0.0, noise_v, frames.shape)
    for number, frame in enumerate(frames, 1):
        savemat(tmp_path / f"Data_Slice_{number}.mat", {"data_diff": frame[None], "torque_value": 0.01 * number})
    config = tmp_path / "design.yaml"
    errors, text = ran("bank", "design", tmp_path, "--out", config).err, config.read_text()
    for words in ("even the best model leaves ", "the noise is "):
        assert (f"shearloop bank: {words}" in errors) == (f"# NOTE: {words}" in text) == mixed_up
    assert load_bank_plan(config).definition.model in text


def test_sizes_that_overflow_are_refused_without_a_warning():
    t_s, frames = np.arange(12.0), np.random.default_rng(1).normal(0.0, 1e200, (12, 1, PAPER_TABLE.n_channels))
    with pytest.raises(CalibrationError, match="no noise to design for"):
        scene_of_slices(SliceSeries(("right",), t_s, frames, t_s, t_s, np.full(12, np.nan)))


def test_a_recording_that_is_none_is_one_sentence(tmp_path, mistake):
    assert mistake("bank", "design", tmp_path).count("\n") == 1


def test_a_recording_that_begins_gripped_is_designed_for_without_the_frame_that_stands_in_for_the_idle_one():
    rng = np.random.default_rng(4)
    t_s, frames = np.arange(12.0), rng.normal(0.3, 0.01, (12, 1, PAPER_TABLE.n_channels))
    series = FrameSeries(("right",), t_s, frames, t_s, np.full(12, 0.1), np.full(12, np.nan))
    found = scene_of(series)
    np.testing.assert_array_equal(found.differences, frames[1:, 0] - frames[0, 0])


def test_a_side_is_designed_for_by_its_own_frames_however_few_the_other_one_has(tmp_path):
    rng, period_ns = np.random.default_rng(5), 540_800_000
    with new_recording(tmp_path / "one.mcap", "a test") as writer:
        for number in range(12):
            t_ns = number * period_ns
            writer.add_frame("left", t_ns, t_ns, rng.uniform(0.3, 0.4, PAPER_TABLE.n_line_values))
            writer.add_torque(t_ns, 0.1)
        # A board that was lost soon, and whose frames lie beside the other's.
        for t_ns in (6 * period_ns, 20 * period_ns):
            writer.add_frame("right", t_ns, t_ns, rng.uniform(0.3, 0.4, PAPER_TABLE.n_line_values))
    # Of the twelve the first stands in for the idle one.
    found = scene_of_recording(tmp_path / "one.mcap", "left")
    assert found.differences.shape == (11, PAPER_TABLE.n_channels)
