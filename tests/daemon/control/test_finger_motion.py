"""When the fingers moved, by commands and states of the gripper, in simulated time."""

import pytest

from shearloop.daemon.control.finger_motion import FingerMotion
from shearloop.drivers.robotiq.gripper import ACTIVATION_DEADLINE_NS
from shearloop.drivers.robotiq.messages import ActivationStatus, GripperState, ObjectStatus, fault_of

MS = 1_000_000
HELD, MOVING, OPEN = ObjectStatus.CONTACT_CLOSING, ObjectStatus.MOVING, ObjectStatus.AT_TARGET


def state(
    t_ms: int,
    status: ObjectStatus,
    activation: ActivationStatus = ActivationStatus.ACTIVE,
    fault: int = 0,
    others_requests: int = 0,
) -> GripperState:
    return GripperState(t_ms * MS, 100, 20.0, 0.5, status, activation, None, fault_of(fault), None, others_requests)


def moved(motion: FingerMotion, from_ms: int, to_ms: int) -> bool:
    return motion.moved_between(from_ms * MS, to_ms * MS)


def test_fingers_move_from_the_command_until_a_state_shows_them_at_rest():
    motion = FingerMotion()
    motion.take(state(1000, HELD))
    with motion.commanded(1050 * MS):
        # The gripper has not taken up the command yet.
        motion.take(state(1060, HELD))
        assert moved(motion, 1060, 1060)
        motion.take(state(1160, MOVING))
    motion.take(state(1400, OPEN))
    assert not moved(motion, 0, 1049)
    assert moved(motion, 600, 1050)
    assert moved(motion, 1200, 1250)
    assert moved(motion, 1399, 2000)
    motion.take(state(1500, OPEN))
    assert not moved(motion, 1401, 9000)


def test_a_motion_that_nobody_here_commanded_began_after_the_state_before_it():
    motion = FingerMotion()
    for t_ms, status in ((100, OPEN), (200, OPEN), (300, MOVING), (400, MOVING), (500, HELD)):
        motion.take(state(t_ms, status))
    assert not moved(motion, 0, 199)
    assert moved(motion, 0, 250)
    assert moved(motion, 450, 460)
    assert not moved(motion, 501, 600)


def test_fingers_that_lost_their_tool_between_two_states_have_moved():
    motion = FingerMotion()
    motion.take(state(100, HELD))
    motion.take(state(200, OPEN))
    assert moved(motion, 120, 130)
    assert not moved(motion, 201, 300)
    motion.take(state(400, HELD))
    motion.take(state(500, HELD, others_requests=1))
    assert moved(motion, 420, 430), "another program has gripped it anew"
    assert not moved(motion, 501, 600)


@pytest.mark.parametrize("changes", [{"activation": ActivationStatus.ACTIVATING}, {"fault": 11}])
def test_an_activation_and_a_release_of_its_own_move_the_fingers(changes):
    motion = FingerMotion()
    motion.take(state(100, ObjectStatus.UNKNOWN, **changes))
    assert moved(motion, 150, 160)


def test_without_a_state_a_motion_ends_after_the_longest_one():
    motion = FingerMotion()
    with pytest.raises(OSError, match="gone"), motion.commanded(1000 * MS):
        raise OSError("gone")
    longest_ms = ACTIVATION_DEADLINE_NS // MS
    assert moved(motion, 900 + longest_ms, 2000 + longest_ms)
    assert not moved(motion, 1001 + longest_ms, 9000 + longest_ms)
    # The gripper is back an hour later, and at rest.
    motion.take(state(3_600_000, OPEN))
    assert not moved(motion, 3_000_000, 3_600_000)
    motion.take(state(3_600_100, MOVING))
    assert not moved(motion, 3_000_000, 3_599_999)
    assert moved(motion, 3_600_050, 3_600_060)


def test_a_state_that_comes_late_changes_nothing():
    motion = FingerMotion()
    motion.take(state(300, MOVING))
    motion.take(state(200, HELD))
    assert moved(motion, 310, 320)
