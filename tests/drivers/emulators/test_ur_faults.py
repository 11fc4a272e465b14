"""Faults as lines of text."""

import pytest

from shearloop.drivers.emulators.ur_controller import Controller
from shearloop.drivers.emulators.ur_robot import Robot


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("version 5", "'5' is not a version such as 5.4.0.0"),
        ("fire", "there are protective-stop, emergency-stop"),
        ("silence long", "long"),
        ("silence", "nothing"),
    ],
)
def test_unknown_fault_is_refused(line, said):
    with pytest.raises(ValueError, match=said):
        Controller(Robot()).command(line)
