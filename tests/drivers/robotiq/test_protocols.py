"""The gripper's two protocols and its widths."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import DeviceCalibrationError, DeviceLostError, ProtocolError
from shearloop.drivers.robotiq import messages, modbus_client
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.models import MODELS
from shearloop.drivers.robotiq.socket_client import SocketClient, readout_of, set_lines, take_answer, value_of
from shearloop.drivers.robotiq.width_fit import fit_width
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.emulators.gripper import Fingers

byte = st.integers(0, 255)


def test_requests_are_the_manuals_registers():
    # Instruction manual, "Modbus RTU": reset 0000 0000 0000, close at full speed and force 0900 00FF FFFF.
    last, closed = messages.GripperMove(0, 0, 0), messages.GripperMove(255, 255, 128)
    registers = modbus_client.command_registers
    assert registers(messages.GripperAction.RESET, last, act=True) == [0, 0, 0]
    assert registers(messages.GripperAction.ACTIVATE, last, act=False) == [0x0100, 0, 0]
    assert registers(messages.GripperMove(255, 255, 255), last, act=True) == [0x0900, 0x00FF, 0xFFFF]
    assert registers(messages.GripperAction.HALT, closed, act=True) == [0x0100, 0x00FF, 0xFF80]
    assert registers(messages.GripperAction.HALT, closed, act=False) == [0, 0x00FF, 0xFF80]


def test_replies_are_read_as_the_manual_explains_them():
    # The manual's three examples: closing under way, object gripped, opened completely.
    moving = modbus_client.readout_of([0x3900, 0x0000, 0xBB10])
    assert moving == messages.Readout(
        True, True, messages.ActivationStatus.ACTIVE, messages.ObjectStatus.MOVING, 0, 0, 187, 16
    )
    gripped = modbus_client.readout_of([0xB900, 0x00FF, 0xBD00])
    assert (gripped.obj, gripped.pre, gripped.pos) == (messages.ObjectStatus.CONTACT_CLOSING, 255, 189)
    opened = modbus_client.readout_of([0xF900, 0x0000, 0x0D00])
    assert (opened.obj, opened.pos) == (messages.ObjectStatus.AT_TARGET, 13)
    with pytest.raises(ProtocolError, match="2 registers"):
        modbus_client.readout_of([0, 0])


@given(st.binary(min_size=6, max_size=6))
def test_every_status_is_either_read_whole_or_refused(content):
    readout = modbus_client.readout_of([int.from_bytes(content[n : n + 2], "big") for n in (0, 2, 4)])
    status = readout.act | readout.gto << 3 | readout.sta << 4 | readout.obj << 6
    assert status == content[0] & 0b11111001
    assert (readout.flt, readout.pre, readout.pos, readout.current) == (content[2] & 15, *content[3:6])


def test_socket_lines_are_those_that_the_urcap_takes():
    assert set_lines(messages.GripperMove(100, 255, 50)) == ["SET POS 100 SPE 255 FOR 50 GTO 1"]
    assert set_lines(messages.GripperAction.RESET) == ["SET GTO 0", "SET ACT 0", "SET ATR 0"]
    assert set_lines(messages.GripperAction.ACTIVATE) == ["SET ACT 1"]
    assert set_lines(messages.GripperAction.HALT) == ["SET GTO 0"]


@pytest.mark.parametrize("line", ["SET GTO 0", "GET POS"])
@given(sliced=st.integers(0, 5), value=byte)
def test_socket_answer_is_awaited_until_it_is_whole(line, sliced, value):
    sent = b"ack" if line.startswith("SET") else b"POS %d\n" % value
    assert take_answer(line, sent[: min(sliced, len(sent) - 1)]) is None
    assert take_answer(line, sent) == (sent.decode().removeprefix("POS ").strip(), b"")
    assert take_answer(line, b"\n" + sent + b"rest") == (sent.decode().removeprefix("POS ").strip(), b"rest")


@given(st.binary(min_size=1, max_size=80))
def test_foreign_answer_is_refused_or_awaited(answer):
    for line in ("SET GTO 0", "GET POS"):
        try:
            taken = take_answer(line, answer)
        except ProtocolError:
            continue
        assert taken is None or answer.lstrip().startswith((b"ack", b"POS "))


@pytest.mark.parametrize("text", ["256", "-1", "1.5", "", "²", "0x10"])
def test_value_that_is_not_a_byte_is_refused(text):
    with pytest.raises(ProtocolError, match="POS"):
        value_of("POS", text)


def test_missing_values_are_a_lost_gripper_except_for_the_current():
    assert value_of("COU", "?") is None
    with pytest.raises(DeviceLostError, match="no data of the gripper"):
        value_of("POS", "?")
    values: dict[str, int | None] = {"ACT": 1, "STA": 3, "GTO": 1, "PRE": 9, "OBJ": 2, "POS": 7, "FLT": 0, "COU": None}
    assert readout_of(values).current is None
    with pytest.raises(ProtocolError, match="not in its manual"):
        readout_of(values | {"OBJ": 7})


def test_every_fault_code_has_a_sentence_and_its_cure():
    for code in range(1, 16):
        fault = messages.fault_of(code)
        assert fault.code == code
        assert fault.sentence.endswith(".")
        assert fault.needs_activation == (code >= 10)
        assert not fault.needs_activation or "activate" in fault.sentence
    assert "fault 3, which is not in its manual" in messages.fault_of(3).sentence
    assert messages.fault_of(0).sentence == ""


@given(st.floats(0, 20), st.floats(200, 255), st.floats(-20, 140))
def test_width_round_trips_within_half_a_count(opened, closed, width):
    calibration = WidthCalibration(open_counts=opened, open_mm=140.0, closed_counts=closed, std_mm=0.5)
    counts = calibration.counts(width)
    step = abs(calibration.mm_per_count)
    if 0 < counts < 255:
        assert calibration.width_mm(counts) == pytest.approx(width, abs=step / 2 * (1 + 1e-9))
    assert calibration.width_mm(opened) == pytest.approx(140)
    assert calibration.width_mm(closed) == pytest.approx(0, abs=1e-9)
    # A uniform error of one step has its standard deviation at step / √12.
    assert calibration.width_std_mm**2 == pytest.approx(0.25 + step**2 / 12)


def test_gauges_give_the_line_they_were_measured_on_and_its_scatter():
    truth = WidthCalibration(open_counts=5.0, open_mm=140.0, closed_counts=225.0, std_mm=1.0)
    gauges = [(truth.closed_counts + width / truth.mm_per_count, width) for width in (10.0, 20.0, 30.0, 40.0)]
    found = fit_width(gauges, "2F-140")
    assert [found.width_mm(counts) for counts in (0, 100, 255)] == pytest.approx(
        [truth.width_mm(counts) for counts in (0, 100, 255)]
    )
    assert found.std_mm == pytest.approx(140 / 220)
    off = fit_width([(counts + (2 if width == 20 else 0), width) for counts, width in gauges], "2F-140")
    # A bump of 2 counts in the second of four even points leaves 2² (1 − 1/4 − 1/20), over two degrees of freedom, and
    # tilts the line by 2 · (−5 mm) / 500 mm².
    assert off.std_mm == pytest.approx(2 * (0.7 / 2) ** 0.5 / (220 / 140 + 0.02))


@pytest.mark.parametrize("model", sorted(MODELS))
@pytest.mark.parametrize(("opened", "bow"), [(3.0, 0.0), (13.0, 0.03), (13.0, -0.03)])
def test_gauges_of_each_model_give_its_stroke_its_first_count_and_its_bow(model, opened, bow):
    stroke_mm = MODELS[model].stroke_mm
    fingers = Fingers(MODELS[model], open_counts=opened, bow_mm=bow * stroke_mm)
    widths = [part * stroke_mm for part in (0.1, 0.3, 0.5, 0.7, 0.9)]
    found = fit_width([(round(fingers.counts(width)), width) for width in widths], model)
    errors_mm = [found.width_mm(fingers.counts(part * stroke_mm)) - part * stroke_mm for part in np.linspace(0, 1, 50)]
    step_mm = stroke_mm / (fingers.closed_counts - opened)
    assert found.model == model
    assert np.abs(errors_mm).max() < 2 * step_mm, "a line would be wrong by 3 % of the stroke"
    assert found.width_std_mm < 1.5 * step_mm
    assert found.bow_mm == pytest.approx(fingers.bow_mm, abs=step_mm)
    assert all(abs(found.width_mm(found.counts(width)) - width) <= step_mm for width in widths)


@given(
    st.floats(-80, 20),
    st.floats(200, 255),
    st.lists(st.integers(5, 135), min_size=4, max_size=8, unique=True).filter(lambda all_mm: np.ptp(all_mm) > 70),
)
def test_straight_gauges_make_no_other_curve_than_their_line(opened, closed, widths_mm):
    """The bow of the best parabola is rounding noise there, which differs between processors."""
    truth = WidthCalibration(model="2F-140", open_counts=opened, open_mm=140.0, closed_counts=closed, std_mm=1.0)
    gauges = [(truth.closed_counts + width / truth.mm_per_count, float(width)) for width in widths_mm]
    found = fit_width(gauges, "2F-140")
    counts = np.linspace(opened, closed, 20)
    assert [found.width_mm(one) for one in counts] == pytest.approx([truth.width_mm(one) for one in counts], abs=1e-6)


def test_few_gauges_cannot_see_a_bow_and_say_so():
    fingers = Fingers(MODELS["2F-85"], bow_mm=2.0)
    found = fit_width([(fingers.counts(width), width) for width in (5.0, 80.0)], "2F-85")
    assert found.width_std_mm > abs(found.width_mm(fingers.counts(42.5)) - 42.5)


def test_an_object_that_does_not_fit_between_the_fingers_is_refused():
    with pytest.raises(DeviceCalibrationError, match="60 mm does not fit between the fingers of a Hand-E"):
        fit_width([(100.0, 20.0), (3.0, 60.0)], "Hand-E")


def test_diameters_in_centimetres_are_refused():
    gauges = [(round(Fingers(MODELS["2F-140"]).counts(width)), width / 10) for width in (10.0, 20.0, 30.0)]
    with pytest.raises(DeviceCalibrationError, match=r"10\.\d times as far as a 2F-140 does for these diameters: "):
        fit_width(gauges, "2F-140")


@pytest.mark.parametrize("model", sorted(MODELS))
@pytest.mark.parametrize("named", sorted(MODELS))
def test_gauges_of_another_model_than_the_named_one_are_refused(model, named):
    """A Hand-E passed as a 2F-140: its widths were right between the gauges, and every force was of the other model."""
    gauges = [(round(Fingers(MODELS[model]).counts(width)), width) for width in (10.0, 20.0, 40.0)]
    if model == named:
        assert fit_width(gauges, named).model == named
        return
    with pytest.raises(DeviceCalibrationError, match=f"as a {named} does for these diameters, .* like a {model}"):
        fit_width(gauges, named)


@pytest.mark.parametrize("model", sorted(MODELS))
def test_counts_of_speed_and_force_are_those_of_the_model(model):
    own, gripper = MODELS[model], RobotiqGripper(SocketClient("localhost"), WidthCalibration.nominal(model))
    for part, counts in ((0.0, 0), (1.0, 255)):
        asked = messages.GripperCommand(
            own.stroke_mm * (1 - part), *(low + part * (high - low) for low, high in (own.speed_mm_per_s, own.force_n))
        )
        sent = gripper.request_of(asked)
        assert (sent.speed, sent.force) == (counts, counts)
        assert sent.position == (own.closed_counts if part else own.open_counts)


@pytest.mark.parametrize(
    ("gauges", "said"),
    [
        ([(100.0, 20.0)], "two different"),
        ([(100.0, 20.0), (101.0, 20.0)], "two different"),
        ([(100.0, 20.0), (150.0, 40.0)], "smaller objects"),
        ([(100.0, 20.0), (100.0, 40.0)], "smaller objects"),
        ([(100.0, 80.0), (190.0, 20.0), (160.0, 25.0)], "scatter"),
    ],
)
def test_gauges_that_make_no_line_are_refused(gauges, said):
    with pytest.raises(DeviceCalibrationError, match=said):
        fit_width(gauges, "2F-140")


def test_pymodbus_logs_nothing():
    said = "import shearloop.drivers.robotiq.modbus_client; from pymodbus.logging import Log; Log.error('received pdu')"
    # Where pytest listens to every logger, nobody would print it anyway.
    done = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
