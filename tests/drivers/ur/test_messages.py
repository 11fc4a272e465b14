"""The pipe: messages arrive as sent, in any pieces; anything else is refused."""

import contextlib
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur import messages as wire
from shearloop.drivers.ur.messages import MessageDecoder, MoveLinear, Stop, WristSpeed, encode
from shearloop.drivers.ur.settings import UrSettings
from tests.drivers.ur.handler_bench import LIMITS
from tests.slices import slices

finite = st.floats(allow_nan=False, allow_infinity=False)
st.register_type_strategy(WristSpeed, st.builds(WristSpeed, finite, finite))
st.register_type_strategy(MoveLinear, st.builds(MoveLinear, st.tuples(*[finite] * 6), finite, finite))
st.register_type_strategy(Stop, st.builds(Stop, finite))
st.register_type_strategy(UrSettings, st.just(UrSettings(host="10.0.0.1", limits=LIMITS)))
messages = st.one_of(list(map(st.from_type, get_args(wire.Message))))
numbered = st.lists(st.tuples(st.integers(0, 2**32 - 1), messages), max_size=5)


@given(numbered, st.lists(st.integers(0, 10_000), max_size=8))
def test_messages_arrive_as_sent_in_any_pieces(entries, cuts):
    stream = b"".join(encode(message, number) for number, message in entries)
    decoder = MessageDecoder()
    # Values that are not finite do not equal themselves.
    assert repr([entry for part in slices(stream, cuts) for entry in decoder.feed(part)]) == repr(entries)


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
