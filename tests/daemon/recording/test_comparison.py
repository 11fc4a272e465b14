"""What a replay made beside what was recorded: every difference is counted, and so is what has nothing beside it."""

import json
from typing import Any

import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import EitEstimate, wire_map
from shearloop.daemon.recording.replay import RecordedEvent, ReplayComparison
from shearloop.daemon.recording.schema import message_json, with_missing_keys
from tests.daemon.sample_messages import sample

TOPIC = EitEstimate.topic


def estimate(**changes: Any) -> dict[str, Any]:
    content = wire_map(sample(EitEstimate), Clock().unix_s(0), 7)
    return content | {"source": "right", "t_mono_ns": 5} | changes


def recorded(content: dict[str, Any]) -> RecordedEvent:
    """Return a message as it comes back from a recording, which leaves out what has no value."""
    plain = json.loads(message_json(TOPIC, content, 0))
    return RecordedEvent(TOPIC, content["t_mono_ns"], with_missing_keys(TOPIC, plain), content["source"])


@pytest.mark.parametrize(
    ("then", "now", "told"),
    [
        ({}, {}, ""),
        ({"latency_s": 0.1, "timestamp": 1.0, "seq": 3}, {"latency_s": 0.7, "timestamp": 2.0, "seq": 4}, ""),
        ({"torque_nm": 0.1}, {"torque_nm": 0.1 + 1e-16}, "torque_nm was 0.1, is 0.100000000000000"),
        ({"k": None}, {"k": 1.5}, "k was None, is 1.5"),
        ({"k": 1.5}, {"k": None}, "k was 1.5, is None"),
        ({"reason": ""}, {"reason": "no grip"}, "reason was"),
    ],
)
def test_a_difference_is_described(then: dict[str, Any], now: dict[str, Any], told: str) -> None:
    comparison = ReplayComparison(("eit.estimate.right",))
    comparison.add_computed(TOPIC, estimate(**now))
    comparison.compare(recorded(estimate(**then)))
    assert comparison.compared[TOPIC] == 1
    assert comparison.different[TOPIC] == bool(told)
    assert told in "".join(comparison.examples)
    assert comparison.unrecorded == 0


def test_a_missing_message_is_a_difference() -> None:
    comparison = ReplayComparison(("eit.estimate.right", "eit.estimate.left"))
    comparison.add_computed(TOPIC, estimate(source="left"))
    comparison.compare(recorded(estimate()))
    assert comparison.different[TOPIC] == 1
    assert "the replay did not compute it" in comparison.examples[0]
    assert comparison.unrecorded == 1, "the left one has no message beside it"


def test_messages_of_unrecorded_topics_are_only_counted() -> None:
    comparison = ReplayComparison(("eit.estimate.right",))
    for _ in range(3):
        comparison.add_computed(TOPIC, estimate(source="left"))
        comparison.add_computed("health", {"source": "daemon"})
    assert comparison.unrecorded == 3
    assert comparison._computed == {}
