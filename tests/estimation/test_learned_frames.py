"""A frame that a calibration has learned from counts once, whatever its recording is called."""

import re
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import Calibration, adapt, fit
from shearloop.estimation.learned_frames import UNKNOWN_FRAMES, LearnedFrames
from tests.estimation.conftest import twisting

USED = re.compile(r"the calibration has used (\d+) of (\d+) gripped frames of (.+) already \(frames (\d+) to (\d+)\)")


@pytest.fixture(scope="module")
def later():
    """Another grip of the same fingertips."""
    return twisting(seed=7, peak_nm=0.08)


def used(calibration, recordings, **options):
    """Return what the refusal to adapt tells: frames used already, frames, recording, the first and the last."""
    with pytest.raises(CalibrationError) as refused:
        adapt(calibration, recordings, "a copy", **options)
    assert "they would count twice; adapt on other twists" in str(refused.value)
    n, of, name, first, last = USED.match(str(refused.value)).groups()
    return int(n), int(of), name, int(first), int(last)


def test_frames_that_a_calibration_was_fitted_to_do_not_adapt_it(motion_calibration, recorded):
    n, of, name, first, last = used(motion_calibration, [recorded], names=["renamed.mcap"])
    assert n == of > 100
    assert (name, n) == ("renamed.mcap", last - first + 1)


def test_twists_adapt_once_also_with_overlap_and_another_delay(motion_calibration, later):
    adapted, _ = adapt(motion_calibration, [later.between(0, 140)], "later")
    again, _ = adapt(adapted, [later], "later", first_frames=[140])
    assert again.torque.regressor.gain.between <= adapted.torque.regressor.gain.between
    delayed = replace(later, torque_t_s=later.torque_t_s - 0.1)
    assert used(adapted, [delayed.between(0, 140)])[2] == "recording 1 of 1"
    assert used(adapted, [later], first_frames=[120]) == (20, 140, "recording 1 of 1", 120, 139)
    assert used(again, [twisting(seed=8), later.between(10, 290)])[2:] == ("recording 2 of 2", 52, 259)


def test_a_part_of_the_fitted_recording_that_was_left_out_adapts(later):
    early = fit("motion_regression", [later.between(0, 140)], "the first half")
    adapt(early, [later], "the second half", first_frames=[140])
    assert used(early, [later], first_frames=[139])[0] == 1


def test_one_fingertip_alone_is_the_same_data(motion_calibration, recorded, later):
    right = fit("motion_regression", [recorded.select_sides(("right",))], "right")
    assert used(right, [recorded])[0] > 100
    mixed = replace(later, channels=np.stack([later.channels[:, 0], recorded.channels[:, 1]], axis=1))
    assert motion_calibration.learned.include(mixed.channels).all()
    assert not motion_calibration.learned.include(later.channels).any()


def test_a_file_without_the_digests_loads_and_says_that_it_cannot_tell(motion_calibration, later, tmp_path):
    replace(motion_calibration, learned=UNKNOWN_FRAMES).save(tmp_path / "older.cal")
    older = Calibration.load(tmp_path / "older.cal")
    assert not older.learned.complete
    adapted, _ = adapt(older, [later], "later")
    adapted.save(tmp_path / "adapted.cal")
    adapted = Calibration.load(tmp_path / "adapted.cal")
    assert not adapted.learned.complete
    assert used(adapted, [later])[0] > 100
    motion_calibration.save(tmp_path / "new.cal")
    loaded = Calibration.load(tmp_path / "new.cal").learned
    assert loaded.complete
    assert np.array_equal(loaded.digests, motion_calibration.learned.digests)


def test_digests_are_bounded_and_find_a_copy_all_the_same(monkeypatch):
    monkeypatch.setattr("shearloop.estimation.learned_frames.MAX_DIGESTS", 50)
    frames = np.random.default_rng(0).normal(size=(300, 2, 8))
    learned = LearnedFrames.of([frames[:100]]).with_frames([frames[100:200], frames[:100]])
    assert len(learned.digests) == 50
    assert np.array_equal(learned.digests, LearnedFrames.of([frames[:200]]).digests)
    assert 30 < learned.include(frames[:200]).sum() <= 50
    assert not learned.include(frames[200:]).any()


def test_values_alone_decide():
    frames = np.zeros((2, 1, 8))
    frames[0] = -0.0
    learned = LearnedFrames.of([frames[:1]])
    assert learned.include(frames[:, :, ::-1]).all()
    assert learned.include(np.zeros((0, 1, 8))).shape == (0,)
