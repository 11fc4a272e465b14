"""Faults as lines of text."""

import pytest

from shearloop.drivers.emulators.ur.robot import Robot
from shearloop.drivers.emulators.ur.server import Controller, apply_fault


def test_faults_are_carried_out_and_ended() -> None:
    controller = Controller(Robot())
    robot = controller.robot
    for line in (
        "registers-in-use", "local-control", "refuse-protocol on", "stop-hangs 2", "protective-stop",
        "emergency-stop",
    ):  # fmt: skip
        apply_fault(controller, line)
    assert controller.stop_hangs == 2
    assert (robot.registers_taken, robot.remote_control, controller.protocol_refused) == (True, False, True)
    assert robot.safety_mode == 7
    apply_fault(controller, "registers-in-use off")
    assert not robot.registers_taken
    apply_fault(controller, "normal")
    assert (robot.remote_control, controller.protocol_refused, robot.safety_mode) == (True, False, 1)
    assert controller.stop_hangs == 0


@pytest.mark.parametrize(
    ("line", "said"),
    [("fire", "there are protective-stop, emergency-stop"), ("silence long", "long"), ("silence", "nothing")],
)
def test_unknown_fault_is_refused(line: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        apply_fault(Controller(Robot()), line)
