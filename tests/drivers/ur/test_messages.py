"""The pipe: messages arrive as sent, in any pieces; anything else is refused."""

import contextlib
import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur import messages as wire
from shearloop.drivers.ur.messages import MessageDecoder, MoveLinear, RobotState, Stop, WristSpeed, encode
from shearloop.drivers.ur.settings import UrSettings
from tests.drivers.ur.flight import LIMITS, Flight
from tests.slices import slices

finite = st.floats(allow_nan=False, allow_infinity=False)
six = st.tuples(*[finite] * 6)
wrist, line, stop = (
    st.builds(WristSpeed, finite, finite),
    st.builds(MoveLinear, six, finite, finite),
    st.builds(Stop, finite),
)
sent = st.none() | wrist | line | stop
reasons = st.lists(st.text(max_size=20), max_size=3).map(tuple)
mode, time_ns = st.integers(-(2**31), 2**31 - 1), st.integers(-(2**63), 2**63 - 1)
states = st.builds(
    RobotState,
    t_mono_ns=time_ns, age_ns=time_ns, robot_mode=mode, safety_mode=mode, runtime_state=mode,
    script_state=mode,
    motion_id=st.integers(0, 2**32 - 1), cycle=st.integers(0, 2**64 - 1),
    q_rad=six, qd_rad_per_s=six, tcp_pose=six, tcp_speed=six, wrench=six, tcp_offset=six, payload_kg=finite,
    payload_cog_m=st.tuples(*[finite] * 3), sent=sent, clipped=reasons,
    timestamp_s=finite, speed_scaling=finite,
    motion=st.sampled_from(["idle", "wrist", "linear", "stopping"]),
)  # fmt: skip
messages = st.one_of(
    st.sampled_from([wire.Enable(), wire.Unlock(), wire.ZeroForceTorque(), wire.Disconnect(), wire.Heartbeat()]),
    wrist, line, stop, states, st.just(UrSettings(host="10.0.0.1", limits=LIMITS)),
    st.builds(wire.CommandReply, st.text(), sent, reasons), st.builds(wire.WorkerPhase, st.text(), st.text()),
    st.builds(wire.Failed, st.sampled_from(["lost", "silent"]), st.text()),
)  # fmt: skip
numbered = st.lists(st.tuples(st.integers(0, 2**32 - 1), messages), max_size=5)


@given(numbered, st.lists(st.integers(0, 10_000), max_size=8))
def test_messages_arrive_as_sent_in_any_pieces(entries, cuts):
    stream = b"".join(encode(message, number) for number, message in entries)
    decoder = MessageDecoder()
    assert [entry for part in slices(stream, cuts) for entry in decoder.feed(part)] == entries


@given(st.binary(max_size=200))
def test_foreign_bytes_are_refused_or_waited_on(data):
    decoder = MessageDecoder()
    with contextlib.suppress(ProtocolError):
        assert decoder.feed(data) == []
    with pytest.raises(ProtocolError):
        decoder.feed(data.replace(b"\n", b"") + b"\n")


@pytest.mark.parametrize("value", ["", '"0.1"', "NaN", "-Infinity", "null", "[0.1]", "0.1]", "true", "{}"])
def test_malformed_command_is_refused(value):
    line = encode(Stop(0.1))
    assert MessageDecoder().feed(line) == [(0, Stop(0.1))]
    with pytest.raises(ProtocolError):
        MessageDecoder().feed(line.replace(b"0.1", value.encode()))


@pytest.mark.parametrize(
    "line", ["7", "0 Enable", "0 Go {}", "x Enable {}", "0 Enable []", "0 Stop {}", "Enable {}", ""]
)
def test_only_numbered_messages_are_accepted(line):
    with pytest.raises(ProtocolError, match="invalid message"):
        MessageDecoder().feed(f"{line}\n".encode())


def test_message_without_an_end_is_refused():
    decoder = MessageDecoder()
    assert decoder.feed(bytes(wire.LARGEST_MESSAGE)) == []
    with pytest.raises(ProtocolError, match="without an end"):
        decoder.feed(b"x")


def test_states_carry_values_that_are_not_finite():
    state = dataclasses.replace(Flight().state, q_rad=(math.nan,) * 6, wrench=(math.inf,) * 6)
    ((_, got),) = MessageDecoder().feed(encode(state))
    assert got.wrench == state.wrench
    assert all(map(math.isnan, got.q_rad))
