"""The torque without a sensor: the mean torque at the same place of a repeated series."""

import pytest

from shearloop.studies.slices.profile import SliceProfile
from tests.studies.slices.conftest import sliced


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
