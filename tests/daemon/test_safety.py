import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.safety import TABLE, Event, Response, SafetyGate, Trouble

STOPS = (Response.STOP_AND_KEEP_GRIP, Response.STOP_AND_RELEASE)
SECOND = 10**9


def trouble(event: Event) -> Trouble:
    return Trouble(event, "on the bench")


def test_every_event_has_a_row_with_a_sentence_and_a_cure() -> None:
    assert set(TABLE) == set(Event)
    for rule in TABLE.values():
        fields = [name for _, name, _, _ in string.Formatter().parse(rule.sentence) if name]
        assert fields == ["detail"]
        assert rule.sentence.endswith(".")
        assert rule.cure.endswith(".")
        assert rule.response is not Response.HOLD or rule.hold_at_most_s is not None, "a hold may not last for ever"


def test_nothing_wrong_is_no_more_than_a_note() -> None:
    assert SafetyGate().judge([], 0).response is Response.NOTE


def test_a_hold_goes_with_its_cause() -> None:
    gate = SafetyGate()
    assert gate.judge([trouble(Event.ESTIMATE_STALE)], 0).response is Response.HOLD
    assert gate.judge([], SECOND).response is Response.NOTE


@pytest.mark.parametrize("event", [event for event, rule in TABLE.items() if rule.response is Response.HOLD])
def test_a_hold_that_lasts_too_long_becomes_a_stop(event: Event) -> None:
    gate = SafetyGate()
    longest_s = TABLE[event].hold_at_most_s
    assert longest_s is not None
    assert gate.judge([trouble(event)], 0).response is Response.HOLD
    assert gate.judge([trouble(event)], int(longest_s * SECOND)).response is Response.HOLD
    assert gate.judge([trouble(event)], int(longest_s * SECOND) + 1).response is Response.STOP_AND_KEEP_GRIP


def test_a_hold_that_comes_and_goes_starts_its_time_anew() -> None:
    gate = SafetyGate()
    for second in range(0, 60, 2):
        assert gate.judge([trouble(Event.ESTIMATE_STALE)], second * SECOND).response is Response.HOLD
        assert gate.judge([], (second + 1) * SECOND).response is Response.NOTE


def test_a_stop_outlives_its_cause_until_it_is_acknowledged() -> None:
    gate = SafetyGate()
    gate.judge([trouble(Event.PROTECTIVE_STOP)], 0)
    later = gate.judge([], 100 * SECOND)
    assert later.response is Response.STOP_AND_KEEP_GRIP
    assert "protective stop: on the bench" in later.reasons[0]
    gate.acknowledge()
    assert gate.judge([], 101 * SECOND).response is Response.NOTE


def test_acknowledging_does_not_help_against_what_is_still_wrong() -> None:
    gate = SafetyGate()
    gate.judge([trouble(Event.GRIPPER_FAULT)], 0)
    gate.acknowledge()
    assert gate.judge([trouble(Event.GRIPPER_FAULT)], 1).response is Response.STOP_AND_KEEP_GRIP


@given(st.lists(st.tuples(st.lists(st.sampled_from(Event), max_size=4), st.integers(0, 10 * SECOND)), max_size=20))
def test_no_sequence_of_events_weakens_a_stop_or_answers_less_than_the_table(
    story: list[tuple[list[Event], int]],
) -> None:
    gate, t_ns, strongest = SafetyGate(), 0, Response.NOTE
    for events, pause_ns in story:
        t_ns += pause_ns
        verdict = gate.judge([trouble(event) for event in events], t_ns)
        assert verdict.response >= max((TABLE[event].response for event in events), default=Response.NOTE)
        if strongest in STOPS:
            assert verdict.response >= strongest
        assert {found.event for found in verdict.troubles} >= set(events)
        strongest = max(strongest, verdict.response)
        assert gate.stopped == (strongest in STOPS)


def test_two_things_of_one_kind_are_both_told() -> None:
    both = [Trouble(Event.DEVICE_LOST, "the gripper"), Trouble(Event.DEVICE_LOST, "the load cell")]
    gate = SafetyGate()
    for seen in (gate.judge(both, 0), gate.judge([], SECOND), gate.look([])):
        assert [found.detail for found in seen.troubles] == ["the gripper", "the load cell"]
