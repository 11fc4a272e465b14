"""What comes before a frame, as a recording keeps it: byte for byte, and read as it was written."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.sensing.session_inputs import session_inputs
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.estimation import BeforeFrame, HeldTool, KnownTorques, Measured
from shearloop.tools.recordings.before_frame import SESSION_KINDS, before_frame
from shearloop.tools.recordings.replay import together

WHOLE = BeforeFrame(
    begins_tare=True,
    gives_up_tare=True,
    tool=HeldTool(Measured(20.25, 0.1)),
    fingers_moved=True,
    known_torques=KnownTorques("load_cell", np.array([0.1, np.nan])),
)
RECORDED = [
    (InputKind.TARE, b"7"),
    (InputKind.TARE, b"7 given up"),
    (InputKind.TOOL, b"7 20.25 0.1"),
    (InputKind.MOVED, b"7"),
    (InputKind.ADAPT, b"7 load_cell 0.1 nan"),
]


def plain(before: BeforeFrame) -> tuple[object, ...]:
    known = before.known_torques
    torques = None if known is None else (known.reference, str(known.torque_nm.tolist()))
    return before.begins_tare, before.gives_up_tare, before.tool, before.fingers_moved, torques


def test_each_thing_is_an_input_in_the_order_in_which_a_session_applies_it():
    inputs = list(session_inputs(7, WHOLE, 99))
    assert [(one.kind, one.data) for one in inputs] == RECORDED
    assert {one.t_ns for one in inputs} == {99}
    assert {one.kind for one in inputs} == SESSION_KINDS
    assert list(session_inputs(7, BeforeFrame(), 99)) == []


def test_all_inputs_of_a_frame_together_say_what_was_recorded():
    read = BeforeFrame()
    for event in session_inputs(7, WHOLE, 99):
        number, part = before_frame(event)
        assert number == 7
        read = together(read, part)
    assert plain(read) == plain(WHOLE)


POSITIVE = st.floats(0.0, allow_nan=False, allow_infinity=False)


@given(st.integers(0), st.none() | st.builds(Measured, POSITIVE, POSITIVE), st.none() | POSITIVE)
def test_a_tool_is_read_as_it_was_written(frame, measured, stated_mm):
    tool = HeldTool(measured, stated_mm)
    (event,) = session_inputs(frame, BeforeFrame(tool=tool), 0)
    number, before = before_frame(event)
    assert (number, before.tool) == (frame, tool)


@pytest.mark.parametrize(
    ("kind", "data"),
    [(InputKind.TOOL, data) for data in (b"", b"x", b"3 20", b"3 20 x", b"3 20 1 1", b"3 stated", b"3 20 stated 20")]
    + [(InputKind.TARE, data) for data in (b"", b"8388607.0", b" given up", b"3 given")]
    + [(InputKind.MOVED, b""), (InputKind.ADAPT, b"3"), (InputKind.ADAPT, b"3 load_cell x"), (InputKind.DATA, b"3")],
)
def test_what_says_nothing_of_a_frame_is_refused(kind, data):
    with pytest.raises(ValueError):  # noqa: PT011 - the recording's reader says where
        before_frame(RawEvent(kind, 0, data))
