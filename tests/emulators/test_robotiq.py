"""The emulated gripper: timing, faults, protocols."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.robotiq.models import MODELS
from shearloop.emulators.gripper import Fingers, Gripper, GripperRegisters, ModbusSlave, UrcapSession, crc16
from tests.slices import slices

READ_STATUS = bytes.fromhex("09 03 07D0 0003")


def steps(gripper: Gripper, seconds: float, dt_s: float = 0.004) -> None:
    for _ in range(round(seconds / dt_s)):
        gripper.step(dt_s)


def active_gripper() -> Gripper:
    gripper = Gripper()
    gripper.write(GripperRegisters(act=True))
    steps(gripper, 5.0)
    assert gripper.sta == 3
    return gripper


def go(gripper: Gripper, position: int, speed: int = 255, force: int = 0) -> None:
    act = gripper.sta == 3
    gripper.write(GripperRegisters(act=act, gto=True, pos=position, spe=speed, force=force))


def framed(request: bytes) -> bytes:
    return request + crc16(request)


def test_activation_opens_closes_and_opens_at_its_speed():
    gripper = Gripper()
    gripper.write(GripperRegisters(act=True))
    travelled, extremes, t_s = 0.0, set(), 0.0
    before = gripper.width_mm
    while gripper.sta != 3:
        gripper.step(0.004)
        t_s += 0.004
        assert gripper.flt == (0 if gripper.sta == 3 else 5)
        travelled += abs(gripper.width_mm - before)
        before = gripper.width_mm
        extremes.add(round(before, 6))
    assert (min(extremes), max(extremes)) == (0.0, 140.0)
    assert t_s == pytest.approx(travelled / 150.0, abs=0.02)


@pytest.mark.parametrize(("speed", "mm_s"), [(0, 30.0), (255, 250.0), (51, 74.0)])
def test_fingers_move_at_the_commanded_speed(speed, mm_s):
    gripper = active_gripper()
    go(gripper, 230, speed)
    steps(gripper, 0.2)
    assert 140.0 - gripper.width_mm == pytest.approx(0.2 * mm_s, rel=1e-6)
    assert gripper.obj == 0


@given(st.floats(1, 139), st.integers(0, 255), st.floats(0.001, 0.2))
def test_fingers_never_pass_through_an_object(width, force, dt_s):
    gripper = active_gripper()
    gripper.object_mm = width
    go(gripper, 255, force=force)
    for _ in range(int(2.0 / dt_s) + 2):
        gripper.step(dt_s)
        assert gripper.width_mm >= width - 1e-9
    assert gripper.obj == 2
    assert gripper.width_mm == pytest.approx(width)
    assert gripper.grip_force_n == pytest.approx(10 + 115 * force / 255)


def test_closing_on_air_ends_at_the_fingers_own_stop_without_an_object():
    gripper = active_gripper()
    go(gripper, 255)
    steps(gripper, 1.0)
    assert (gripper.obj, gripper.pos, gripper.taken.pos) == (3, 230, 255)
    assert gripper.grip_force_n == 0


def test_moving_before_activation_is_fault_7_and_a_major_fault_waits_for_an_edge():
    gripper = Gripper()
    go(gripper, 100)
    steps(gripper, 0.1)
    assert gripper.flt == 7
    gripper = active_gripper()
    gripper.fail(12)
    go(gripper, 230)
    steps(gripper, 1.0)
    assert (gripper.flt, gripper.pos) == (12, 3)
    gripper.clear_minor()
    assert gripper.flt == 12
    gripper.write(GripperRegisters())
    steps(gripper, 0.1)
    gripper.write(GripperRegisters(act=True))
    steps(gripper, 5.0)
    assert (gripper.flt, gripper.sta) == (0, 3)


def test_frames_are_the_manuals_byte_for_byte():
    # Instruction manual, "Modbus RTU example": requests and replies with their checks.
    assert framed(bytes.fromhex("0910 03E8 0003 06 0000 0000 0000")) == bytes.fromhex("091003E800030600000000000073 30")
    assert framed(bytes.fromhex("0910 03E8 0003 06 0900 00FF FFFF"))[-2:] == bytes.fromhex("4229")
    assert framed(bytes.fromhex("0904 07D0 0003"))[-2:] == bytes.fromhex("B1CE")
    assert framed(bytes.fromhex("0903 06 B900 00FF BD00"))[-2:] == bytes.fromhex("1D7C")
    gripper = active_gripper()
    face = ModbusSlave(gripper)
    assert face.feed(bytes.fromhex("0910 03E8 0003 06 0900 00FF FFFF 4229")) == framed(bytes.fromhex("0910 03E8 0003"))
    gripper.object_mm = Fingers().width_mm(189)
    steps(gripper, 1.0)
    reply = face.feed(framed(READ_STATUS))
    assert reply[:7] == bytes.fromhex("0903 06 B900 00FF")
    assert reply[7] == 189
    assert crc16(reply[:-2]) == reply[-2:]


@given(st.lists(st.integers(0, 100)))
def test_modbus_requests_come_in_any_slices(cuts):
    requests = [framed(READ_STATUS), framed(bytes.fromhex("0910 03E8 0003 06 0900 0064 FF32")), framed(READ_STATUS)]
    whole, sliced = ModbusSlave(active_gripper()), ModbusSlave(active_gripper())
    expected = b"".join(whole.feed(request) for request in requests)
    assert b"".join(sliced.feed(part) for part in slices(b"".join(requests), cuts)) == expected


def test_the_socket_answers_as_the_urcap_does():
    gripper = active_gripper()
    face = UrcapSession(gripper)
    assert face.feed(b"SET POS 100 SPE 255 FOR 50 GTO 1\n") == b"ack"
    steps(gripper, 1.0)
    assert face.feed(b"GET POS\nGET OBJ\nGET P") == b"POS 100\nOBJ 3\n"
    assert face.feed(b"RE\nGET FLT\nGET XYZ\n") == b"PRE 100\nFLT 00\nXYZ ?\n"
    gripper.fail(14)
    assert face.feed(b"GET FLT\n") == b"FLT 14\n"
    gripper.powered = False
    assert face.feed(b"GET POS\n") == b"POS ?\n"


@given(st.sampled_from(sorted(MODELS)), st.floats(3, 13), st.floats(-0.05, 0.05), st.floats(0, 1))
def test_the_position_of_a_width_is_the_one_where_the_fingers_have_it(model, opened, bow, part):
    own = MODELS[model]
    fingers = Fingers(own, open_counts=opened, bow_mm=bow * own.stroke_mm)
    assert fingers.width_mm(fingers.counts(part * own.stroke_mm)) == pytest.approx(part * own.stroke_mm, abs=1e-9)
    assert fingers.counts(own.stroke_mm) == pytest.approx(opened)
