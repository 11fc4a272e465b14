"""The help of each emulated device names every fault that its code knows."""

import argparse
import re

import pytest

from shearloop.cli.emulate import DEVICES
from shearloop.emulators import emulated_rig, skin
from shearloop.emulators.boards import EitKitBoard, Hx711Board
from shearloop.emulators.emulated_rig import JOINTS
from shearloop.emulators.ports import OUTAGES
from shearloop.emulators.ur_controller import FAULTS


def help_of(device: str) -> str:
    parser = argparse.ArgumentParser()
    DEVICES[device].configure(parser)
    assert parser.epilog is not None
    return parser.epilog


def first_words(commands: str) -> list[str]:
    """Return the first word of each command of a list."""
    return [re.split(r"[ |]", command)[0] for command in commands.split(", ")]


@pytest.mark.parametrize(
    ("device", "faults"),
    [
        ("eit-kit", EitKitBoard.faults),
        ("hx711", Hx711Board.faults),
        ("gripper-socket", ["object", "drop", "fault", *first_words(OUTAGES)]),
        ("skin", skin.EmulatedAdcBoard.faults),
        ("skin", first_words(skin.CIRCUIT_COMMANDS)),
        ("rig", [*first_words(emulated_rig.COMMANDS.partition(", a fault of the robot")[0]), "normal"]),
        ("rig", JOINTS),
    ],
)
def test_help_names_every_fault(device, faults):
    words = set(re.findall(r"[\w-]+", help_of(device)))
    assert set(faults) <= words


def test_help_of_the_robot_lists_its_faults_and_no_others():
    listed = re.findall(r"^  ([a-z-]+)", help_of("ur"), re.MULTILINE)
    assert sorted(listed) == sorted(FAULTS)


def test_help_says_how_a_flipped_sign_is_turned_back():
    """A second `flip` does not turn it back."""
    (line,) = (line for line in help_of("rig").splitlines() if line.lstrip().startswith("flip"))
    assert "until `normal`" in line
