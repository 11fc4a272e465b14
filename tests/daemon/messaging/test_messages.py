import dataclasses

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shearloop.daemon.messaging.messages import TOPICS, EitHeatmap, Message, RobotStateMessage, decode, encode, wire_map
from tests.sample_messages import sample

SCALARS = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text()
ARRAYS = hnp.arrays(np.float32, hnp.array_shapes(min_dims=1, max_dims=3, max_side=8))


def heatmap(scores: np.ndarray) -> Message:
    return sample(EitHeatmap, source="right", t_mono_ns=5, scores=scores)


@given(ARRAYS)
def test_arrays_round_trip(scores):
    content = decode(encode(wire_map(heatmap(scores), timestamp=1.5, seq=3)))
    np.testing.assert_array_equal(content["scores"], scores)
    assert "scores_shape" not in content
    assert (content["timestamp"], content["seq"], content["source"], content["t_mono_ns"]) == (1.5, 3, "right", 5)


def test_an_array_is_bin_with_a_shape_key():
    content = wire_map(heatmap(np.array([[0.25, np.nan]])), timestamp=0.0, seq=0)
    assert content["scores"] == np.array([0.25, np.nan], "<f4").tobytes()
    assert content["scores_shape"] == [1, 2]


@given(st.lists(st.floats(), max_size=8))
def test_a_tuple_is_encoded_like_an_array(numbers):
    with np.errstate(over="ignore"):
        array = np.array(numbers).astype("<f4")
    content = wire_map(sample(RobotStateMessage, joints_rad=tuple(numbers)), 0.0, 0)
    assert content["joints_rad_shape"] == [len(numbers)]
    np.testing.assert_array_equal(np.frombuffer(content["joints_rad"], "<f4"), array)


@given(st.dictionaries(st.text().filter(lambda key: not key.endswith("_shape")), SCALARS))
def test_scalars_round_trip(content):
    assert decode(encode(content)) == content


@given(st.binary(max_size=300))
def test_foreign_bytes_raise_a_value_error(payload):
    try:
        content = decode(payload)
    except ValueError:
        return
    assert all(isinstance(key, str) for key in content)


@pytest.mark.parametrize("kind", TOPICS.values(), ids=TOPICS)
def test_plotjuggler_plots_each_scalar_and_no_array(kind):
    """Its streamer reads each frame as msgpack without bytes left over, and plots numbers, also within maps.

    Sources: plotjuggler_plugins/DataStreamZMQ/datastream_zmq.cpp and plotjuggler_app/nlohmann_parsers.cpp.
    """
    with pytest.raises((ValueError, msgpack.exceptions.ExtraData)):
        msgpack.unpackb(kind.topic.encode(), strict_map_key=True)
    message = sample(kind)
    content = msgpack.unpackb(encode(wire_map(message, timestamp=1.5, seq=3)), strict_map_key=True)
    assert isinstance(content["timestamp"], float)
    for name in (item.name for item in dataclasses.fields(kind)):
        value = getattr(message, name)
        is_array = isinstance(value, np.ndarray | tuple)
        assert isinstance(content[name], bytes) if is_array else content[name] == value


def test_a_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="'scores' does not fit its shape"):
        decode(encode({"scores": b"\0" * 8, "scores_shape": [3]}))
    with pytest.raises(ValueError, match="does not fit"):
        decode(encode({"scores": 1.0, "scores_shape": [1]}))


def test_every_key_of_every_topic_is_documented():
    for topic, kind in TOPICS.items():
        assert kind.topic == topic
        assert kind.__doc__
        for item in dataclasses.fields(kind):
            if item.name not in ("source", "t_mono_ns"):
                assert item.metadata["meaning"], f"{topic}.{item.name}"
