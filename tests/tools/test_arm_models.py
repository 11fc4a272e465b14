"""Which arm a controller says that it has, and what it is rated for."""

import math

import pytest

from shearloop.drivers.ranges import LARGEST_PAYLOAD_KG
from shearloop.tools import arm_models
from shearloop.tools.arm_models import SMALLEST_ARM_KG, UNKNOWN_ARM, Arm, read_arm


@pytest.mark.parametrize(
    ("answer", "major", "arm"),
    [
        ("UR10e", 5, Arm("UR10", (10.0, 12.5))),
        ("UR10", 3, Arm("UR10", (10.0,))),
        ("UR3\n", 5, Arm("UR3", (3.0,))),
        ("UR99", 5, Arm("UR99")),
        ("could not understand: get robot model", 5, UNKNOWN_ARM),
    ],
)
def test_the_dashboard_names_the_arm(monkeypatch, answer, major, arm):
    monkeypatch.setattr(arm_models, "ask_dashboard", lambda *_: (answer,))
    assert read_arm("127.0.0.9", 1.0, major) == arm


def test_an_early_arm_of_a_model_carries_less_than_a_newer_one():
    arm = Arm("UR10", (10.0, 12.5))
    payloads_kg = (9.0, 10.0, 11.0, 12.5, 13.0, math.nan, None)
    assert [arm.may_be_beyond(kg) for kg in payloads_kg] == [False, False, True, True, False, False, False]
    assert [arm.is_beyond(kg) for kg in payloads_kg] == [False, False, False, False, True, False, False]
    assert not UNKNOWN_ARM.is_beyond(LARGEST_PAYLOAD_KG)
    assert SMALLEST_ARM_KG == 3.0
