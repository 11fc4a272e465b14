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


TICK_S = 0.008


def flapping(event: Event, held: int, gone: int, for_s: float = 60.0) -> float | None:
    """Judge an event that is there for some ticks and gone for some; return when it became a stop, None where never."""
    gate = SafetyGate()
    for tick in range(round(for_s / TICK_S)):
        active = [trouble(event)] if tick % (held + gone) < held else []
        if gate.judge(active, round(tick * TICK_S * SECOND)).response in STOPS:
            return tick * TICK_S
    return None


HOLDS = [(event, rule.hold_at_most_s) for event, rule in TABLE.items() if rule.hold_at_most_s is not None]


@pytest.mark.parametrize(("event", "longest_s"), HOLDS)
@pytest.mark.parametrize(("held", "gone"), [(1, 1), (50, 50), (125, 125), (125, 12)])
def test_a_hold_that_flaps_becomes_a_stop(event: Event, longest_s: float, held: int, gone: int) -> None:
    """Of each cycle's time so much is held and half of the rest forgotten, until it is as long as it may be."""
    stopped_s = flapping(event, held, gone)
    assert stopped_s is not None
    cycle_s, gained_s = (held + gone) * TICK_S, (held - 0.5 * gone) * TICK_S
    cycles_before = (longest_s - held * TICK_S) / gained_s
    assert stopped_s == pytest.approx(cycle_s * cycles_before, abs=cycle_s + held * TICK_S + 4 * TICK_S)


@pytest.mark.parametrize(("event", "longest_s"), HOLDS)
@pytest.mark.parametrize(("held", "gone"), [(1, 3), (12, 36), (125, 260)])
def test_a_hold_that_is_gone_for_more_than_two_thirds_of_the_time_stays_one(
    event: Event, longest_s: float, held: int, gone: int
) -> None:
    assert held * TICK_S < longest_s
    assert flapping(event, held, gone) is None


def test_a_hold_begins_anew_with_the_next_experiment_and_after_the_operators_word() -> None:
    for ends in (SafetyGate.acknowledge, lambda gate: gate.look([trouble(Event.STATE_STALE)])):
        gate = SafetyGate()
        gate.judge([trouble(Event.STATE_STALE)], 0)
        ends(gate)
        assert gate.judge([trouble(Event.STATE_STALE)], 3600 * SECOND).response is Response.HOLD
        assert gate.judge([trouble(Event.STATE_STALE)], 3602 * SECOND).response is Response.HOLD
        assert gate.judge([trouble(Event.STATE_STALE)], 3603 * SECOND).response is Response.STOP_AND_KEEP_GRIP


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
