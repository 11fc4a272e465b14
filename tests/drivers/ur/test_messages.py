"""The pipe: everything arrives as it was sent, in any pieces, and nothing else is taken."""

import contextlib
import math
import struct
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import (
    CommandReply,
    Configure,
    Disconnect,
    Ease,
    Enable,
    Failed,
    Heartbeat,
    Message,
    MoveLinear,
    RobotPhase,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.wire import Decoder, encode
from tests.drivers.ur.test_limits import LIMITS

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
    motion_id=st.integers(0, 2**32 - 1), cycle=st.integers(0, 2**64 - 1), stops_in_vain=st.integers(0, 2**32 - 1),
    q_rad=six, qd_rad_per_s=six, tcp_pose=six, wrench=six, sent=sent, clipped=reasons,
    timestamp_s=finite, speed_scaling=finite, wrist_torque_nm=finite,
    motion=st.sampled_from(["idle", "wrist", "linear", "stopping"]),
)  # fmt: skip
messages = st.one_of(
    wrist, line, stop, st.just(Enable()), st.just(Unlock()), st.just(ZeroForceTorque()), st.just(Disconnect()),
    st.just(Heartbeat()), st.builds(Ease, st.integers(1, 100)),
    st.builds(CommandReply, st.text(), sent, reasons), st.builds(RobotPhase, st.text()),
    st.builds(Failed, st.sampled_from(["lost", "silent"]), st.text()), states,
    st.just(Configure(UrSettings(host="10.0.0.1", limits=LIMITS))),
)  # fmt: skip
numbered = st.lists(st.tuples(st.integers(0, 2**32 - 1), messages), max_size=5)


@given(numbered, st.lists(st.integers(0, 10_000), max_size=8))
def test_messages_arrive_as_sent_in_any_pieces(entries: list[tuple[int, Message]], cuts: list[int]) -> None:
    stream = b"".join(encode(message, number) for number, message in entries)
    decoder = Decoder()
    edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    assert [entry for a, b in pairwise(edges) for entry in decoder.feed(stream[a:b])] == entries


@given(st.binary(max_size=200))
def test_foreign_bytes_are_refused_or_waited_on(data: bytes) -> None:
    decoder = Decoder()
    with contextlib.suppress(ProtocolError):
        for _, message in decoder.feed(data):
            assert Decoder().feed(encode(message)) == [(0, message)]


@pytest.mark.parametrize(
    "body",
    [
        b"{}",
        b'{"deceleration_rad_per_s2":"0.1"}',
        b'{"deceleration_rad_per_s2":true}',
        b'{"deceleration_rad_per_s2":NaN}',
        b'{"deceleration_rad_per_s2":1e999}',
        b'{"deceleration_rad_per_s2":1.0,"time_s":1.0}',
        b"[0.1]",
        b"{",
    ],
)
def test_command_with_anything_missing_wrong_or_more_is_refused(body: bytes) -> None:
    with pytest.raises(ProtocolError, match="Stop"):
        Decoder().feed(_with_body(Stop(0.1), body))


@pytest.mark.parametrize(
    "body",
    [
        b"",
        struct.pack("<2d", 0.1, 1.0)[:-1],
        struct.pack("<3d", 0.1, 1.0, 0.0),
        struct.pack("<2d", 0.1, math.nan),
        struct.pack("<2d", -math.inf, 1.0),
    ],
)
def test_wrist_speed_with_anything_missing_wrong_or_more_is_refused(body: bytes) -> None:
    with pytest.raises(ProtocolError, match="WristSpeed"):
        Decoder().feed(_with_body(WristSpeed(0.1, 1.0), body))


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (lambda body: body[:-1], "Invalid JSON"),
        (lambda body: body[:-1] + b',"more"]', "2 items"),
        (lambda body: body[:40], "40 bytes"),
        (lambda body: b"\x04" + body[1:], "no motion 4"),
        (lambda body: b"\x01" + struct.pack("<d", math.nan) + body[9:], "no finite number"),
    ],
)
def test_reply_with_anything_missing_wrong_or_more_is_refused(change: Callable[[bytes], bytes], wrong: str) -> None:
    reply = CommandReply("", WristSpeed(0.5, 4.0), ("force",))
    with pytest.raises(ProtocolError, match=f"Reply: .*{wrong}"):
        Decoder().feed(_with_body(reply, change(encode(reply)[9:])))


@pytest.mark.parametrize(
    "change", ["a byte less of words", "a word more", "half of the numbers", "no such motion", "nothing like it sent"]
)
def test_a_state_with_anything_missing_wrong_or_more_is_refused(change: str) -> None:
    state = RobotState(
        0.0, (0.0,) * 6, (0.0,) * 6, (0.0,) * 6, (0.0,) * 6, 7, 1, 2, 1.0, 0, 0, True, False,
        0.0, False, False, "", False, "stopping", 0, "", None, (), 3, True, 0,
    )  # fmt: skip
    body = encode(state)[9:]
    # What was sent to the robot is a byte and eight numbers.
    sent = body.index(b"[") - 65
    body = {
        "a byte less of words": body[:-1],
        "a word more": body[:-1] + b',"more"]',
        "half of the numbers": body[: sent // 2],
        # Before the six flags.
        "no such motion": body[: sent - 7] + b"\x04" + body[sent - 6 :],
        "nothing like it sent": body[:sent] + b"\x04" + body[sent + 1 :],
    }[change]
    with pytest.raises(ProtocolError, match="RobotState"):
        Decoder().feed(_with_body(state, body))


def _with_body(message: Message, body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + encode(message)[4:9] + body


def test_states_carry_what_is_no_number() -> None:
    state = RobotState(
        0.0, (float("nan"),) * 6, (0.0,) * 6, (0.0,) * 6, (float("inf"),) * 6, 7, 1, 2, 1.0, 0, 0, True, False,
        0.0, False, False, "", False, "idle", 0, "", None, (), 3, False, 0,
    )  # fmt: skip
    ((_, got),) = Decoder().feed(encode(state))
    assert isinstance(got, RobotState)
    assert got.wrench == state.wrench
    assert all(map(math.isnan, got.q_rad))
