"""Faults as lines of text."""

import pytest

from shearloop.drivers.emulators.ur_controller import Controller
from shearloop.drivers.emulators.ur_robot import Robot


def test_faults_are_carried_out_and_ended():
    controller = Controller(Robot())
    robot = controller.robot
    for line in (
        "registers-in-use", "local-control", "refuse-protocol", "mute-dashboard", "protective-stop",
        "emergency-stop", "version 5.0.0.0", "payload 2.5",
    ):  # fmt: skip
        controller.command(line)
    assert controller.faults == {"registers-in-use", "local-control", "refuse-protocol", "mute-dashboard"}
    assert (robot.spec.payload_kg, robot.spec.version) == (2.5, (5, 0, 0, 0))
    assert robot.safety_mode == 7
    controller.command("normal")
    assert (controller.faults, robot.safety_mode) == (set(), 1)


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
