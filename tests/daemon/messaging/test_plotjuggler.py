"""PlotJuggler's ZeroMQ streamer, read as it reads: what it needs of our framing to plot scalars as they are.

It takes the frames of a multipart message one by one, gives each to its msgpack parser (nlohmann/json, which refuses
bytes that are left over), and plots the numbers and booleans of the map; `timestamp` is the time, where asked for.
Its sources: plotjuggler_plugins/DataStreamZMQ/datastream_zmq.cpp and plotjuggler_app/nlohmann_parsers.cpp. Later ones
take the first of two frames as the topic, which names the series; a third would have to be a time as text.
"""

from collections.abc import Iterator
from typing import Any

import msgpack
import pytest
import zmq

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import TOPICS, EitAdapted, Message
from shearloop.daemon.messaging.publisher import Publisher
from tests.daemon.conftest import DEADLINE_S
from tests.daemon.sample_messages import sample
from tests.daemon.web.fake_daemon import MESSAGES, made


def messages() -> list[Message]:
    """Return the messages of the page, and the one that it does not show."""
    return [*(made({"t_mono_ns": 1_000_000_000, **given}) for given in MESSAGES.values()), sample(EitAdapted)]


def parsed(frame: bytes) -> Any:
    """Return what nlohmann's from_msgpack makes of a frame; None where it throws and the streamer goes on."""
    try:
        return msgpack.unpackb(frame, strict_map_key=True)
    except (ValueError, msgpack.exceptions.UnpackException):
        return None


def plotted(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the series that the streamer makes of a value: maps and lists are walked, other kinds passed over."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from plotted(item, f"{name}/{key}")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from plotted(item, f"{name}[{number}]")
    elif isinstance(value, bool | int | float):
        yield name, float(value)


@pytest.fixture
def frames(tmp_path) -> dict[str, list[bytes]]:
    """The frames of one message of each topic, received one by one by a plain SUB socket."""
    address = f"ipc://{tmp_path}/publish"
    received: dict[str, list[bytes]] = {}
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        publisher = Publisher(context, address, Clock())
        socket.setsockopt(zmq.RCVTIMEO, DEADLINE_S * 1000)
        socket.connect(address)
        socket.subscribe("")
        while not publisher.has_subscriber("health"):
            socket.poll(1)
        for message in messages():
            publisher.publish(message)
            parts = [socket.recv()]
            while socket.getsockopt(zmq.RCVMORE):
                parts.append(socket.recv())
            received[message.topic] = parts
        publisher.close()
    return received


def test_plotjuggler_ignores_the_topic_and_parses_the_map(frames):
    assert set(frames) == set(TOPICS) - {"eit.frame"}
    for topic, (name, payload) in frames.items():
        assert name == topic.encode(), "so that its topic filter finds it"
        assert list(plotted(parsed(name))) == [], "a topic must not be taken for a number"
        assert isinstance(parsed(payload), dict)
    for topic in TOPICS:
        assert parsed(topic.encode()) is None


def test_each_scalar_is_a_series_and_no_array_is(frames):
    for given in MESSAGES.values():
        kind: type[Message] = given["kind"]
        series = dict(plotted(parsed(frames[kind.topic][1])))
        assert isinstance(parsed(frames[kind.topic][1])["timestamp"], float)
        assert series["/timestamp"] == pytest.approx(Clock().unix_s(1_000_000_000), abs=5.0)
        for key, value in given.items():
            if isinstance(value, bool | int | float):
                assert series[f"/{key}"] == float(value)
            elif value is None or isinstance(value, str) or hasattr(value, "shape"):
                assert not any(name == f"/{key}" or name.startswith(f"/{key}[") for name in series)
        # A hundred heatmap cells would be a hundred lines: only shapes come through.
        assert len(series) < 40
    assert dict(plotted(parsed(frames["health"][1])))["/tasks/right/rate_hz"] == 1.8479
