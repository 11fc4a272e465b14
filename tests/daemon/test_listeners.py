"""Listeners of the daemon's messages: each takes every message, and none can end a task."""

import dataclasses
import re
from collections.abc import Iterator
from contextlib import closing
from io import StringIO
from typing import Any, get_args, get_type_hints

import pytest
import zmq

from shearloop.cli.emulator_processes import EmulatedDevices
from shearloop.cli.terminal import StatusLine, message_json, message_line, print_estimate
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.messages import TOPICS, EitEstimate, LoadTorque, Message, decode, encode, wire_map
from shearloop.daemon.messaging.publisher import LISTENER_FAILED, Publisher
from shearloop.daemon.run_summary import RunSummary
from tests.sample_messages import sample
from tests.tools.recordings.every_message import distinct


def nullable_keys(kind: type[Message]) -> list[str]:
    hints = get_type_hints(kind)
    return [item.name for item in dataclasses.fields(kind) if type(None) in get_args(hints[item.name])]


def contents(kind: type[Message]) -> Iterator[dict[str, Any]]:
    """Yield a message of the topic with everything, with each nullable key empty, and with all of them empty."""
    keys = nullable_keys(kind)
    for empty in ([], *([key] for key in keys), keys):
        message = sample(kind, **dict.fromkeys(empty))
        yield decode(encode(wire_map(message, timestamp=0.0, seq=1)))


@pytest.mark.parametrize("topic", TOPICS)
def test_every_message_is_shown_with_any_key_empty(topic):
    for content in contents(TOPICS[topic]):
        line = message_line(topic, content)
        assert f" {content['source']} " in line
        assert "None" not in line
        assert message_json(topic, content)


@pytest.mark.parametrize("topic", TOPICS)
def test_each_number_that_listen_prints_is_that_of_its_key_with_its_unit(topic, monkeypatch):
    marked = {name: {key: f"<{key}>" for key in messages.units(name)} for name in TOPICS}
    monkeypatch.setattr(messages, "units", lambda name: marked[name])
    content = decode(encode(wire_map(distinct(TOPICS[topic], 0, "one", 5), timestamp=0.0, seq=1)))
    # Every value is shown, not the reason for its absence.
    content |= {key: True for key in ("valid",) if key in content}
    line = message_line(topic, content)
    shown = re.findall(r"(\S+) <(\w+)>", line)
    scalars = {key for key in marked[topic].keys() & content.keys() if isinstance(content[key], float)}
    # The line of the loop has words, and no value with a unit.
    assert bool(shown) == (topic != "loop.state" and scalars != {"timestamp"})
    for text, key in shown:
        if key in scalars:
            digits = len(text.partition(".")[2])
            assert float(text) == pytest.approx(content[key], abs=0.51 * 10**-digits, rel=1e-4), key
    # No unit is typed in: without the marks there is none.
    bare = re.sub(r"<\w+>", "", line)
    assert not re.search(r"\d (N·m/rad|N·m|N|rad/s|rad|mm|mA|cm|Ω|MB|s|V|% CPU)(?!\S)", bare), line


@pytest.mark.parametrize("topic", TOPICS)
def test_every_listener_of_the_daemon_takes_every_message(topic):
    """One object of each, so that it meets the messages of a whole run."""
    running = sample(TOPICS["loop.state"], phase="running", step_name="identify")
    ended = dataclasses.replace(running, phase="done")
    listeners = [RunSummary(StringIO()), EmulatedDevices((), None)]
    listeners += [StatusLine(StringIO()), lambda *message: print_estimate(StringIO(), *message)]
    start, end = (wire_map(one, timestamp=0.0, seq=1) for one in (running, ended))
    for content in contents(TOPICS[topic]):
        for listener in listeners:
            listener("loop.state", start)
            listener(topic, content)
            listener("loop.state", end)


def test_the_state_of_a_task_is_shown_with_any_fact_empty():
    message = next(contents(TOPICS["health"]))
    facts = {"alive": None, "rate_hz": None, "expected_hz": None, "errors": None, "restarts": None, "connections": None}
    for empty in (*({key: None} for key in facts), facts):
        shown = message_line("health", {**message, "tasks": {"right": {"rate_hz": 1.85, "connected": False, **empty}}})
        assert "right" in shown
        assert "None" not in shown


def test_an_estimate_without_a_torque_shows_its_diameter():
    empty = dict.fromkeys(("torque_nm", "torque_low_nm", "torque_high_nm", "k", "sigma", "score"))
    message = sample(EitEstimate, **empty, diameter_mm=31.0)
    line = message_line("eit.estimate", wire_map(message, timestamp=0.0, seq=1))
    assert line.endswith("no torque   diameter  31.0 mm")


@pytest.fixture
def publisher(tmp_path) -> Iterator[Publisher]:
    with zmq.Context() as context, closing(Publisher(context, f"ipc://{tmp_path}/publish", Clock())) as bound:
        yield bound


def test_a_listener_that_fails_ends_no_task_and_no_other_listener(publisher, log):
    heard: list[str] = []

    def fail(_topic: str, _content: dict[str, Any]) -> None:
        raise TypeError("unsupported format string")

    publisher.add_listener(fail)
    publisher.add_listener(lambda topic, _content: heard.append(topic))
    for _ in range(20):
        publisher.publish(sample(LoadTorque))
    assert heard == ["load.torque"] * 20
    assert publisher.diagnostics() == {"errors": {LISTENER_FAILED: 20}}
    assert log.said == ["a listener of the messages failed"] * 2, "the first and the tenth are logged"


def test_a_listener_that_a_command_needs_raises(publisher):
    def close(_topic: str, _content: dict[str, Any]) -> None:
        raise BrokenPipeError

    publisher.add_listener(close, raises=True)
    with pytest.raises(BrokenPipeError):
        publisher.publish(sample(LoadTorque))


def test_a_path_that_is_not_utf_8_is_sent():
    assert decode(encode({"file": "/data/\udcff"})) == {"file": "/data/\\udcff"}
