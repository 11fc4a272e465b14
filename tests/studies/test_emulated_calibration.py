"""What the public `emulate_recordings` refuses before it computes anything."""

import math

import pytest

from shearloop import emulate_recordings
from shearloop.errors import UserError


@pytest.mark.parametrize(
    ("diameters_mm", "said"),
    [
        ((math.nan,), "diameters_mm has nan; give numbers above 0 and below 140"),
        ((15.0, 0), "diameters_mm has 0; give numbers"),
        (-5, "diameters_mm has -5; give numbers"),
        (140.0, "diameters_mm has 140; give numbers"),
        ((15.0, 15), "diameters_mm has 15 twice, and both have one file; give each diameter once"),
    ],
)
def test_no_recording_is_made_of_a_tool_that_cannot_be(diameters_mm, said, tmp_path):
    with pytest.raises(UserError, match=said):
        emulate_recordings(tmp_path / "new", diameters_mm)
    assert not (tmp_path / "new").exists()
