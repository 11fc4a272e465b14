"""The torque without a sensor: the mean torque at the same place of a repeated series."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.profile import SliceProfile
from tests.studies.slices.conftest import read, sliced


def test_repeated_slices_are_known_by_their_place():
    played = sliced()
    profile = SliceProfile.fit([played.between(1, 40)])
    later = played.between(40, 50)
    assert profile.predict(later) == pytest.approx(later.torque_at_frames(), abs=0.008)


@pytest.mark.parametrize("stop", range(21, 41))
def test_a_repeat_that_ends_early_counts_from_its_beginning(stop):
    played = sliced().between(1, 50)
    profile = SliceProfile.fit([played.between(1, 1 + stop)])
    later = played.between(1 + stop, 50)
    assert profile.predict(played)[1 + stop :] == pytest.approx(later.torque_at_frames(), abs=0.01)


def test_slices_of_a_load_cell_that_reads_negative_are_the_same_mirrored():
    played = sliced()
    mirrored = replace(played, torque_nm=-played.torque_nm)
    profiles = [SliceProfile.fit([one.between(1, 40)]) for one in (played, mirrored)]
    predicted = [profile.predict(one) for profile, one in zip(profiles, (played, mirrored), strict=True)]
    np.testing.assert_array_equal(predicted[1], -predicted[0])
    later = sliced(1, seed=3)
    estimates = [read(fit_slices("motion_regression", [one], "all"), later) for one in (played, mirrored)]
    torques = [[estimate.torque_nm for estimate in of_one] for of_one in estimates]
    np.testing.assert_allclose(torques[1], -np.array(torques[0]), atol=1e-9)
