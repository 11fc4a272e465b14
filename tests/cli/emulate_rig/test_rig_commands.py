"""The commands of `shearloop emulate rig`, and what it says of those that are none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.emulators.emulated_rig import EmulatedRig


class Blank:
    """An untouched fingertip."""

    def line(self, *_: object) -> NDArray[np.float64]:
        return np.zeros(1024)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("explode", "'explode' is no command; there are kick NM"),
        ("kick hard", "'hard' is no torque in N·m"),
        ("kick 0.1", "kick needs a tool in the grip"),
        ("joint loose", "there are kick NM, slip .NM., weigh NM, flip load.FINGERTIP, joint lever.tight"),
        ("unplug toaster", "there is no device 'toaster'; there are right, left, load, gripper, robot"),
        ("right explode", "there is no fault 'explode'"),
        ("gripper fault 99", "'99' is not a fault code"),
        ("flip gripper", "'flip gripper' is no command"),
        ("load late", "no number of lines from 0 to 100"),
    ],
)
def test_what_is_no_command_is_said_to_be_none(line, sentence, tmp_path):
    rig = EmulatedRig(dict.fromkeys(("right", "left"), Blank()), tmp_path)
    with pytest.raises(ValueError, match=sentence):
        rig.command(line)


class Commanded:
    """A device that keeps its commands."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def command(self, text: str) -> None:
        self.lines.append(text)


@pytest.mark.parametrize(
    ("line", "device", "passed"),
    [
        ("unplug right", "right", "unplug"),
        ("silence load 0.5", "load", "silence 0.5"),
        ("replug left", "left", "normal"),
        ("right cut-line", "right", "cut-line"),
        ("gripper fault 12", "gripper", "fault 12"),
        ("object 30", "gripper", "object 30"),
        ("robot emergency-stop", "robot", "emergency-stop"),
    ],
)
def test_a_command_reaches_its_device_and_normal_all(line, device, passed, tmp_path):
    rig = EmulatedRig(dict.fromkeys(("right", "left"), Blank()), tmp_path)
    devices = rig.commanded = {name: Commanded() for name in rig.commanded}
    rig.command(line)
    assert {name: one.lines for name, one in devices.items() if one.lines} == {device: [passed]}
    rig.command("normal")
    assert all(one.lines[-1] == "normal" for one in devices.values())


def test_the_tool_and_the_robot_obey_the_rig(tmp_path):
    rig = EmulatedRig(dict.fromkeys(("right", "left"), Blank()), tmp_path)
    rig.command("joint seized")
    rig.command("protective-stop")
    assert (rig.scene.truth().joint, rig.controller.robot.safety_mode) == ("seized", 3)
