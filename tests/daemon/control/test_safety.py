import string
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.control.faults import LONGEST_HOLD_S, TABLE, Fault, FaultCode, Response
from shearloop.daemon.control.safety import SafetyMonitor

STOPS = (Response.STOP_AND_KEEP_GRIP, Response.STOP_AND_RELEASE)
SECOND = 10**9


def trouble(event: FaultCode) -> Fault:
    return Fault(event, "on the bench")


def test_every_event_has_a_row_with_a_sentence_and_a_cure():
    assert set(TABLE) == set(FaultCode)
    for rule in TABLE.values():
        fields = [name for _, name, _, _ in string.Formatter().parse(rule.sentence) if name]
        assert fields == ["detail"]
        assert rule.sentence.endswith(".")
        assert rule.cure.endswith(".")
        assert rule.response is not Response.HOLD or rule.hold_at_most_s is not None, "a hold may not last for ever"


@pytest.mark.parametrize("event", [event for event, rule in TABLE.items() if rule.response is Response.HOLD])
def test_a_hold_that_lasts_too_long_becomes_a_stop(event):
    gate = SafetyMonitor()
    longest_s = TABLE[event].hold_at_most_s
    assert longest_s is not None
    assert gate.judge([trouble(event)], 0).response is Response.HOLD
    assert gate.judge([trouble(event)], int(longest_s * SECOND)).response is Response.HOLD
    assert gate.judge([trouble(event)], int(longest_s * SECOND) + 1).response is Response.STOP_AND_KEEP_GRIP


def test_a_further_stop_by_a_person_keeps_the_cause_of_the_first():
    gate = SafetyMonitor()
    gate.stop(Fault(FaultCode.OPERATOR_STOP, "'hold' was under way"))
    gate.stop(Fault(FaultCode.OPERATOR_STOP, "nothing was under way"))
    assert gate.waiting is not None
    assert (gate.waiting.causes, gate.stop_number) == ("the operator stopped it: 'hold' was under way", 2)


def test_the_cause_of_a_stop_keeps_its_words_while_the_robot_is_made_ready():
    gate = SafetyMonitor()
    gate.report([Fault(FaultCode.PROTECTIVE_STOP, "look for its cause")])
    decision = gate.report([Fault(FaultCode.PROTECTIVE_STOP, "the robot is being made ready")])
    assert decision.reported[0].detail == "the robot is being made ready", "the present words, while it waits"
    gate.acknowledge()
    assert gate.acknowledged is not None
    assert gate.acknowledged.causes == "the robot is in a protective stop: look for its cause"


@pytest.mark.parametrize("code", [FaultCode.DEVICE_LOST, FaultCode.ROBOT_LOST, FaultCode.ROBOT_BLOCKED])
def test_a_cause_that_is_no_longer_shown_is_over_and_asks_for_nothing_that_is_done(code):
    gate = SafetyMonitor()
    present = gate.judge([trouble(code)], 0).reported[0]
    assert present.sentence.startswith(TABLE[code].kind)
    over = gate.judge([], SECOND).reported[0]
    assert over.sentence.startswith(f"over by now: {TABLE[code].kind}")
    assert over.sentence.endswith("on the bench. Look at the rig, then send `shearloop command unlock`.")


def test_a_stop_has_a_larger_number_after_each_further_cause_and_not_while_one_lasts():
    gate = SafetyMonitor()
    assert gate.stop_number == 0
    for _ in range(3):
        gate.report([trouble(FaultCode.PROTECTIVE_STOP), trouble(FaultCode.SENSOR_LOST)])
        assert gate.stop_number == 1
    gate.stop(trouble(FaultCode.OPERATOR_STOP))
    gate.report([trouble(FaultCode.PROTECTIVE_STOP)])
    assert gate.stop_number == 2
    # A second person presses the same button.
    gate.stop(trouble(FaultCode.OPERATOR_STOP))
    assert gate.stop_number == 3
    gate.acknowledge()
    assert gate.stop_number == 0
    assert gate.judge([trouble(FaultCode.TORQUE_LIMIT)], 0).response in STOPS
    gate.judge([trouble(FaultCode.TORQUE_LIMIT)], SECOND)
    assert gate.stop_number == 4


@pytest.mark.parametrize("code", [FaultCode.PROTECTIVE_STOP, FaultCode.EMERGENCY_STOP])
@pytest.mark.parametrize("is_remembered", [False, True])
def test_a_second_stop_of_the_robot_at_rest_is_a_cause_of_its_own(code, is_remembered):
    gate = SafetyMonitor()
    first, second, third = (Fault(code, f"number {number}") for number in (1, 2, 3))
    if is_remembered:
        first = replace(first, when="stopped at 2026-11-30 12:03")
        gate.stop(first)
    else:
        gate.report([first])
    gate.report([])
    decision = gate.report([second])
    assert [fault.detail for fault in decision.reported] == ["number 2"]
    assert (gate.waiting.causes, gate.stop_number) == (f"{first.cause}; {second.cause}", 2)
    over = gate.report([]).reported
    assert [(fault.detail, fault.is_over) for fault in over] == [("number 1", True), ("number 2", True)]
    # Of many, the first and the latest are named. A person may hit the same obstacle again.
    gate.report([third])
    gate.report([])
    gate.report([third])
    assert (gate.waiting.faults, gate.stop_number) == ((first, third), 4)


def test_a_stop_that_lasts_stays_before_those_that_join_it():
    gate = SafetyMonitor()
    protective, operator = trouble(FaultCode.PROTECTIVE_STOP), trouble(FaultCode.OPERATOR_STOP)
    gate.report([protective])
    gate.stop(operator)
    gate.report([protective])
    assert gate.waiting.faults == (protective, operator)


TICK_S = 0.008


def taking_turns(*turns: tuple[FaultCode | None, float]) -> tuple[float, SafetyMonitor] | None:
    """Judge events, or none, that follow each other, each for so long, for a minute.

    Return when they became a stop, None where never.
    """
    gate = SafetyMonitor()
    cycle = [[] if event is None else [trouble(event)] for event, for_s in turns for _ in range(round(for_s / TICK_S))]
    for tick in range(round(60.0 / TICK_S)):
        if gate.judge(cycle[tick % len(cycle)], round(tick * TICK_S * SECOND)).response in STOPS:
            return tick * TICK_S, gate
    return None


HOLDS = [(event, rule.hold_at_most_s) for event, rule in TABLE.items() if rule.hold_at_most_s is not None]
OF_THE_MOMENT = [(event, longest_s) for event, longest_s in HOLDS if not TABLE[event].is_past]


@pytest.mark.parametrize(("event", "longest_s"), OF_THE_MOMENT)
@pytest.mark.parametrize(("held", "gone"), [(1, 1), (50, 50), (125, 125), (125, 12)])
def test_a_hold_that_flaps_becomes_a_stop(event, longest_s, held, gone):
    """Of each cycle's time so much is held and half of the rest forgotten, until it is as long as it may be."""
    stopped_s, _ = taking_turns((event, held * TICK_S), (None, gone * TICK_S))
    cycle_s, gained_s = (held + gone) * TICK_S, (held - 0.5 * gone) * TICK_S
    cycles_before = (longest_s - held * TICK_S) / gained_s
    assert stopped_s == pytest.approx(cycle_s * cycles_before, abs=cycle_s + held * TICK_S + 4 * TICK_S)


@pytest.mark.parametrize(("event", "longest_s"), OF_THE_MOMENT)
@pytest.mark.parametrize(("held", "gone"), [(1, 3), (12, 36), (125, 260)])
def test_a_hold_that_is_gone_for_more_than_two_thirds_of_the_time_stays_one(event, longest_s, held, gone):
    assert held * TICK_S < longest_s
    assert taking_turns((event, held * TICK_S), (None, gone * TICK_S)) is None


@pytest.mark.parametrize("each_s", [0.008, 0.1, 1.0])
@pytest.mark.parametrize("count", [3, 4, 6])
def test_causes_that_take_turns_hold_the_wrist_no_longer_than_one_alone_may(count, each_s):
    events = [event for event, _ in HOLDS][:count]
    stopped = taking_turns(*((event, each_s) for event in events))
    stopped_s, gate = stopped
    assert stopped_s == pytest.approx(LONGEST_HOLD_S, abs=2 * TICK_S)
    (last,) = (one for one in gate.report([]).faults if one.code is FaultCode.HELD_TOO_LONG)
    assert all(f"{event.text} for " in last.detail for event in events[:4])


def test_a_stop_by_a_single_cause_reports_only_that_cause():
    stopped = taking_turns((FaultCode.ESTIMATE_STALE, 1.0))
    assert [found.code for found in stopped[1].report([]).faults] == [FaultCode.ESTIMATE_STALE]


def test_what_does_not_hold_is_not_counted_as_a_hold():
    notes = [event for event, rule in TABLE.items() if rule.response < Response.HOLD]
    assert taking_turns(*((event, 0.1) for event in notes)) is None


LATE = [trouble(FaultCode.LOOP_LATE)]


@pytest.mark.parametrize(("stall_s", "decisions"), [(0.15, 1), (0.15, 10), (0.3, 60), (1.0, 1)])
def test_a_loop_that_is_away_for_more_than_a_third_of_the_time_is_stopped(stall_s, decisions):
    """It is found late when it is back, and in time at the next decision: what counts is the time between."""
    gate, t_ns = SafetyMonitor(), SECOND
    gate.judge([], t_ns)
    while t_ns < 60 * SECOND:
        t_ns += round(stall_s * SECOND)
        if gate.judge(LATE, t_ns).response in STOPS:
            break
        for _ in range(decisions):
            t_ns += round(TICK_S * SECOND)
            assert gate.judge([], t_ns).response not in STOPS
    held_s, gone_s = stall_s + TICK_S, (decisions - 1) * TICK_S
    longest_s = TABLE[FaultCode.LOOP_LATE].hold_at_most_s
    cycles = (longest_s - held_s) / (held_s - 0.5 * gone_s)
    assert t_ns / SECOND - 1.0 == pytest.approx(cycles * (held_s + gone_s), abs=2 * (held_s + gone_s))


def test_a_loop_that_is_late_now_and_then_is_held_and_goes_on():
    gate, t_ns = SafetyMonitor(), 0
    for _ in range(100):
        t_ns += 150_000_000
        assert gate.judge(LATE, t_ns).response is Response.HOLD
        for _ in range(60):
            t_ns += round(TICK_S * SECOND)
            assert gate.judge([], t_ns).response is Response.NOTE


def test_what_was_before_the_first_judgement_does_not_count():
    gate = SafetyMonitor()
    assert gate.judge(LATE, 3600 * SECOND).response is Response.HOLD
    gate.report([])
    assert gate.judge(LATE, 7200 * SECOND).response is Response.HOLD


CAUSES = st.lists(st.sampled_from([event for event, _ in HOLDS]), max_size=3)
STRETCHES = st.tuples(CAUSES, st.integers(1, 3 * SECOND))


@given(st.lists(STRETCHES, min_size=1, max_size=60))
def test_whatever_holds_a_wrist_for_more_than_a_third_of_the_time_ends_in_a_stop(sequence):
    gate, t_ns, held_ns = SafetyMonitor(), 0, 0.0
    for events, lasts_ns in sequence:
        if gate.judge([trouble(event) for event in events], t_ns).response in STOPS:
            return
        assert not events or held_ns <= LONGEST_HOLD_S * SECOND
        t_ns += lasts_ns
        held_ns = held_ns + lasts_ns if events else max(0.0, held_ns - 0.5 * lasts_ns)


def test_a_hold_begins_anew_with_the_next_experiment_and_after_the_operators_word():
    for ends in (SafetyMonitor.acknowledge, lambda gate: gate.report([trouble(FaultCode.STATE_STALE)])):
        gate = SafetyMonitor()
        gate.judge([trouble(FaultCode.STATE_STALE)], 0)
        ends(gate)
        assert gate.judge([trouble(FaultCode.STATE_STALE)], 3600 * SECOND).response is Response.HOLD
        assert gate.judge([trouble(FaultCode.STATE_STALE)], 3602 * SECOND).response is Response.HOLD
        assert gate.judge([trouble(FaultCode.STATE_STALE)], 3603 * SECOND).response is Response.STOP_AND_KEEP_GRIP


@pytest.mark.parametrize("code", FaultCode)
def test_a_code_in_a_message_names_its_row(code):
    assert FaultCode.of_text(code.text) is code
    assert trouble(code).sentence.startswith(f"{code.value.kind}: ")


def test_a_stop_outlives_its_cause_until_it_is_acknowledged():
    gate = SafetyMonitor()
    gate.judge([trouble(FaultCode.PROTECTIVE_STOP)], 0)
    later = gate.judge([], 100 * SECOND)
    assert later.response is Response.STOP_AND_KEEP_GRIP
    assert later.faults[0] == trouble(FaultCode.PROTECTIVE_STOP)
    gate.acknowledge()
    assert gate.judge([trouble(FaultCode.PROTECTIVE_STOP)], 101 * SECOND).response is Response.STOP_AND_KEEP_GRIP
    gate.acknowledge()
    assert gate.judge([], 102 * SECOND).response is Response.NOTE


@given(st.lists(st.tuples(st.lists(st.sampled_from(FaultCode), max_size=4), st.integers(0, 10 * SECOND)), max_size=20))
def test_no_sequence_of_events_weakens_a_stop_or_answers_less_than_the_table(sequence):
    gate, t_ns, strongest = SafetyMonitor(), 0, Response.NOTE
    for events, pause_ns in sequence:
        t_ns += pause_ns
        verdict = gate.judge([trouble(event) for event in events], t_ns)
        assert verdict.response >= max((TABLE[event].response for event in events), default=Response.NOTE)
        if strongest in STOPS:
            assert verdict.response >= strongest
        assert {found.code for found in verdict.faults} >= set(events)
        strongest = max(strongest, verdict.response)
        assert (gate.waiting is not None) == (strongest in STOPS)


@pytest.mark.parametrize("refused", [[], [FaultCode.COMMAND_REFUSED]])
def test_a_lost_robot_is_named_before_what_came_with_its_earlier_state(refused):
    monitor = SafetyMonitor()
    monitor.judge([trouble(code) for code in (FaultCode.ROBOT_UNCONTROLLED, *refused)], 0)
    lost = monitor.judge([trouble(code) for code in (*refused, FaultCode.ROBOT_LOST)], 1)
    assert lost.faults[0].code is FaultCode.ROBOT_LOST
    assert {fault.code for fault in lost.faults[1:]} == {FaultCode.ROBOT_UNCONTROLLED, *refused}


def test_two_faults_of_one_code_are_both_reported():
    both = [Fault(FaultCode.DEVICE_LOST, "the gripper"), Fault(FaultCode.DEVICE_LOST, "the load cell")]
    gate = SafetyMonitor()
    for seen in (gate.judge(both, 0), gate.judge([], SECOND), gate.report([])):
        assert [found.detail for found in seen.faults] == ["the gripper", "the load cell"]


def test_a_pause_of_the_daemon_stops_and_what_it_leads_to_is_not_repeated():
    """Torques and states are old to one who was away, boards are thought to be gone, the worker was ended."""
    paused, old = (
        Fault(FaultCode.DAEMON_PAUSED, "it stood still for 3.0 s"),
        Fault(FaultCode.STATE_STALE, "the gripper"),
    )
    invalid, lost = (
        Fault(FaultCode.ESTIMATE_INVALID, "too lately"),
        Fault(FaultCode.ROBOT_LOST, "its process was ended"),
    )
    gate = SafetyMonitor()
    assert gate.judge([], 0).response is Response.NOTE
    away = gate.judge([old, paused], 3 * SECOND)
    assert (away.response, away.reasons) == (Response.STOP_AND_KEEP_GRIP, (paused.sentence,))
    # Nothing moves any more; what is found until the operator's word follows from the pause, but for a lost robot.
    later = gate.report([invalid, old, lost])
    assert later.reasons == (paused.sentence, lost.sentence)
    assert {one.code for one in later.faults} == {one.code for one in (paused, invalid, old, lost)}
    gate.acknowledge()
    assert gate.report([invalid]).reasons == (invalid.sentence,)


def test_a_fault_that_stops_is_reported_before_one_that_holds():
    held, stops = trouble(FaultCode.ESTIMATE_STALE), trouble(FaultCode.ROBOT_BLOCKED)
    assert SafetyMonitor().judge([held, stops], 0).reasons == (stops.sentence, held.sentence)


@pytest.mark.parametrize("code", ["ROBOT_STARTING", "ROBOT_BLOCKED", "ROBOT_LOST", "DEVICE_LOST"])
def test_a_reason_to_wait_with_the_start_does_not_ask_for_a_start(code):
    """The configured experiment begins by itself once the reason is gone."""
    assert "start the experiment again" not in trouble(FaultCode[code]).sentence


@pytest.mark.parametrize("code", FaultCode)
def test_the_cure_of_a_stop_names_the_command_that_allows_the_next_start(code):
    # A hold that lasts too long becomes a stop.
    stops = code.value.response >= Response.STOP_AND_KEEP_GRIP or code.value.hold_at_most_s is not None
    # These two only delay a start.
    if stops and code not in {FaultCode.DEVICE_AWAITED, FaultCode.ROBOT_STARTING}:
        assert "`shearloop command unlock`" in code.value.cure


@pytest.mark.parametrize("event", [FaultCode.RECORDING_FAILED, FaultCode.COMMAND_REFUSED])
def test_a_fault_that_a_pause_does_not_cause_is_reported_beside_the_pause(event):
    paused, other, limit = trouble(FaultCode.DAEMON_PAUSED), trouble(event), trouble(FaultCode.TORQUE_LIMIT)
    gate = SafetyMonitor()
    assert gate.judge([other, paused], 0).reasons == (paused.sentence, other.sentence)
    assert gate.report([other, trouble(FaultCode.COMMAND_UNANSWERED)]).reasons == (paused.sentence, other.sentence)
    assert gate.report([limit]).reasons == (paused.sentence, other.sentence, limit.sentence)


TIMES = st.sampled_from([8_000_000, SECOND // 5, SECOND, 2 * SECOND, 2 * SECOND + 1, 3 * SECOND, 6 * SECOND])
MOMENTS = st.lists(st.tuples(TIMES, st.sets(st.sampled_from(list(FaultCode)), max_size=4)), max_size=20)


@given(MOMENTS)
def test_an_explained_fault_changes_the_report_and_never_weakens_the_response(moments):
    """Beside a gate that takes a pause of the daemon for a loop that is late, which explains nothing."""
    explaining, plain, t_ns = SafetyMonitor(), SafetyMonitor(), 0
    for passed_ns, events in moments:
        t_ns += passed_ns
        verdict = explaining.judge(map(trouble, events), t_ns)
        late = {FaultCode.LOOP_LATE if event is FaultCode.DAEMON_PAUSED else event for event in events}
        assert verdict.response >= plain.judge(map(trouble, late), t_ns).response
        reported = [one for one in verdict.faults if not one.is_consequence]
        assert reported or not events
        for one in verdict.faults:
            assert one in reported or TABLE[one.code].response in (Response.NOTE, Response.HOLD)
