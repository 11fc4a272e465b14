"""Activation and motion, step by step, with readouts and times that are made up."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.robotiq.gripper import (
    ACTIVATION_DEADLINE_NS,
    MOTION_DEADLINE_NS,
    PAUSE_NS,
    RESET_DEADLINE_NS,
    ActivationSequence,
    MotionWatch,
    object_status,
)
from shearloop.drivers.robotiq.messages import (
    Activate,
    ActivationStatus,
    GripperFaultError,
    GripperMove,
    ObjectStatus,
    Readout,
    Reset,
)

S = 10**9
RESET = Readout(False, False, ActivationStatus.RESET, ObjectStatus.MOVING, 0, 0, 3, 0)
ACTIVATING = replace(RESET, act=True, sta=ActivationStatus.ACTIVATING, flt=5)
ACTIVE = Readout(True, True, ActivationStatus.ACTIVE, ObjectStatus.AT_TARGET, 0, 50, 50, 0)
GO = GripperMove(100, 255, 0)


def after_activate() -> ActivationSequence:
    sequence = ActivationSequence()
    assert sequence.step(ACTIVE, 0) == Reset()
    assert sequence.step(ACTIVE, S) is None
    assert sequence.step(RESET, 2 * S) is None
    assert sequence.step(RESET, 2 * S + PAUSE_NS - 1) is None
    assert sequence.step(RESET, 2 * S + PAUSE_NS) == Activate()
    return sequence


def test_activation_is_a_reset_a_rest_and_a_rising_edge() -> None:
    sequence = after_activate()
    assert sequence.step(RESET, 3 * S) is None
    assert sequence.step(ACTIVATING, 4 * S) is None
    assert not sequence.done
    assert sequence.step(ACTIVE, 5 * S) is None
    assert sequence.done
    assert sequence.step(ACTIVE, 6 * S) is None


def test_the_old_active_state_is_not_taken_for_the_new_one() -> None:
    sequence = ActivationSequence()
    assert sequence.step(ACTIVE, 0) == Reset()
    assert sequence.step(ACTIVE, S) is None
    assert not sequence.done


def test_activation_that_hangs_or_fails_says_so() -> None:
    stuck = ActivationSequence()
    stuck.step(ACTIVE, 0)
    with pytest.raises(GripperFaultError, match="does not take the reset"):
        stuck.step(ACTIVE, RESET_DEADLINE_NS + 1)
    sequence = after_activate()
    with pytest.raises(GripperFaultError, match="clear what blocks"):
        sequence.step(replace(ACTIVATING, flt=13), 4 * S)
    sequence = after_activate()
    with pytest.raises(GripperFaultError, match="does not end"):
        sequence.step(ACTIVATING, 2 * S + PAUSE_NS + ACTIVATION_DEADLINE_NS + 1)
    # Having been silent during the rest is no obstacle.
    assert after_activate().step(replace(ACTIVATING, flt=9), 4 * S) is None


@given(st.sampled_from([status for status in ObjectStatus if status >= 0]), st.integers(0, 255), st.booleans())
def test_what_the_fingers_met_is_believed_only_for_the_target_that_was_asked_for(
    obj: ObjectStatus, pre: int, gto: bool
) -> None:
    readout = replace(ACTIVE, obj=obj, pre=pre, gto=gto)
    believed = object_status(readout, GO)
    assert believed is (obj if gto and pre == GO.position else ObjectStatus.MOVING)
    assert object_status(readout, None) is (obj if gto else ObjectStatus.UNKNOWN)


@pytest.mark.parametrize("sta", [one for one in ActivationStatus if one is not ActivationStatus.ACTIVE])
def test_a_gripper_that_is_not_active_holds_nothing(sta: ActivationStatus) -> None:
    """As after its supply was away for a moment: the fingers stand where they stood, and press on nothing."""
    held = replace(ACTIVE, obj=ObjectStatus.CONTACT_CLOSING, pre=GO.position, gto=True)
    for last in (GO, None):
        assert object_status(held, last) is ObjectStatus.CONTACT_CLOSING
        assert object_status(replace(held, sta=sta), last) is ObjectStatus.UNKNOWN


def test_a_motion_ends_at_its_target_or_on_an_object_and_not_before() -> None:
    watch = MotionWatch(GO, 0)
    assert not watch.has_finished(ACTIVE, S)
    assert not watch.has_finished(replace(ACTIVE, pre=100, obj=ObjectStatus.MOVING), S)
    assert watch.has_finished(replace(ACTIVE, pre=100, obj=ObjectStatus.CONTACT_CLOSING), S)
    with pytest.raises(GripperFaultError, match="does not finish"):
        watch.has_finished(ACTIVE, MOTION_DEADLINE_NS + 1)


@pytest.mark.parametrize(
    ("readout", "said"),
    [
        (replace(ACTIVE, flt=8), "too hot"),
        (replace(ACTIVE, flt=14), "too much current"),
        (RESET, "has to be activated"),
        (ACTIVATING, "still activating"),
    ],
)
def test_a_motion_that_will_never_end_is_reported(readout: Readout, said: str) -> None:
    with pytest.raises(GripperFaultError, match=said):
        MotionWatch(GO, 0).has_finished(readout, S)
