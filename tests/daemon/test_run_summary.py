import re
from collections.abc import Sequence
from io import StringIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.messages import with_unit
from shearloop.daemon.run_record import TorqueSeries
from shearloop.daemon.run_summary import RunSummary

S = 1_000_000_000
TOPICS = {"loop": "loop.state", "robot": "robot.state", "load_cell": "load.torque", "stop": "loop.stop"}


def loop_state(t_s: float, **changes: Any) -> dict[str, Any]:
    return {
        "t_mono_ns": round(t_s * S),
        "source": "loop",
        "phase": "running",
        "experiment": "hold",
        "torque_source": "right",
        "step": 2,
        "steps": 3,
        "step_name": "hold_torque",
        "hold": 0,
        "activity": "",
        "set_point_nm": 0.1,
        "torque_nm": 0.1,
        "stiffness_nm_per_rad": 0.75,
        "delay_s": 0.8,
        "noise_nm": 0.012,
        "response": "note",
        "cause": "",
        "faults": "",
        "reasons": "",
        "held_s": 0.0,
        **changes,
    }


def summary_of(
    *messages: dict[str, Any], truth: TorqueSeries | None = None, sent: Sequence[tuple[int, str]] = ()
) -> str:
    """Return what is told of these messages, each of the topic of its source."""
    out = StringIO()
    summary = RunSummary(out, SimpleNamespace(torques=lambda: truth, sent=sent))
    for content in with_hold_times(messages):
        summary(TOPICS.get(content["source"], "eit.estimate"), content)
    return out.getvalue()


def with_hold_times(messages: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the messages with the loop's hold time, as it counts without late decisions."""
    told, held_ns, before = [], 0, loop_state(0)
    for content in messages:
        if content["source"] == "loop":
            held_ns += content["t_mono_ns"] - before["t_mono_ns"] if before["phase"] == "held" else 0
            before = content
            told.append({**content, "held_s": content["held_s"] or held_ns / S})
        else:
            told.append(content)
    return told


def summary_of_hold(truth: TorqueSeries | None, happened: list[tuple[int, str]], *more: dict[str, Any]) -> str:
    first = {"step": 1, "step_name": "identify", "set_point_nm": None}
    messages = [loop_state(0, **first), loop_state(10), loop_state(14, hold=1), *more]
    for t_s in np.arange(14.0, 44.0, 0.5):
        values = {"torque_nm": 0.098, "valid": True}
        messages.append({"source": "right", "t_mono_ns": round(t_s * S), **values})
    messages.append({"source": "right", "t_mono_ns": 44 * S, "torque_nm": None, "valid": False, "reason": "no grip"})
    return summary_of(*messages, loop_state(44, phase="done", hold=0), truth=truth, sent=happened)


@pytest.mark.parametrize("before_s", [0.001, 0.023, 0.26])
def test_a_torque_that_was_acquired_beyond_the_hold_in_part_does_not_count(before_s):
    """A fingertip's frame takes 0.54 s; the middle of the last one lies shortly before a release."""
    period_s, end_s = 0.54, 44.0
    times_s = end_s - before_s - period_s * np.arange(54)[::-1]
    messages = [loop_state(10), loop_state(times_s[0] - 0.001, hold=1)]
    for number, t_s in enumerate(times_s):
        # The first is half of what was before the hold, and the last half of opening fingers.
        torque_nm = {0: 0.05, 53: -0.05}.get(number, 0.1)
        said = {"torque_nm": torque_nm, "valid": number != 20, "reason": "disturbed"}
        messages.append({"source": "right", "t_mono_ns": round(t_s * S), **said})
    text = summary_of(*messages, loop_state(end_s, step=3, step_name="release"), loop_state(46, phase="done"))
    assert "right       +0.1000 N·m on average, standard deviation 0.0000, within ± 10% for 100% of the time" in text


def truth_that_falls_at(t_s: float, for_s: float) -> TorqueSeries:
    times = np.arange(0.0, 44.0, 0.1)
    torque = np.where(times < 13.0, 0.0, 0.1) - 0.03 * ((times >= t_s) & (times < t_s + for_s))
    return TorqueSeries(times * S, torque)


def test_the_summary_measures_a_disturbance_without_the_next_one():
    t_s = np.arange(0.0, 44.0, 0.1)
    fallen = 0.015 * ((t_s >= 20) & (t_s < 21)) + 0.08 * ((t_s >= 30) & (t_s < 33))
    truth = TorqueSeries(t_s * S, np.where(t_s < 13.0, 0.0, 0.1) - fallen)
    text = summary_of_hold(truth, [(20 * S, "first"), (30 * S, "second")])
    assert "(first): 0.015 N·m off, back within ± 10% after" in text
    assert "(second): 0.080 N·m off, back within ± 10% after" in text


def test_the_summary_of_a_hold_has_true_torque_and_recovery_from_a_disturbance():
    text = summary_of_hold(truth_that_falls_at(26.0, 5.5), [(26 * S, "kick -0.03")])
    assert "'hold' was done, after 44 s" in text
    assert "  step 1 of 3  identify       10.0 s   stiffness" in text
    assert "  step 2 of 3  hold_torque    34.0 s\n" in text
    assert "set point +0.100 N·m, held for 30 s; torque source: right; true torque: of the emulated tool" in text
    assert "stiffness 0.750 N·m/rad, delay 0.80 s" in text
    assert "right       +0.0980 N·m on average" in text
    # 5.5 of 30 s were out of the band.
    assert "true torque +0.0945 N·m on average, standard deviation 0.0116, within ± 10% for 82% of the time" in text
    assert "within ± 10% 3.0 s after the set point changed, by true torque" in text
    assert "disturbed after 12.0 s (kick -0.03): 0.030 N·m off, back within ± 10% after 5.5 s" in text
    assert "1 of 61 torques of right was not valid and not used, most often: no grip" in text
    # The torque was held, and no fault has held the wrist.
    assert "  the wrist was never held by a fault\n" in f"{text}\n"


def test_the_most_frequent_reason_is_whole_and_counted_without_its_numbers():
    reasons = ["right fingertip: 40 channels jumped", "no grip", "right fingertip: 51 channels jumped"]
    refused = [
        {"source": "right", "t_mono_ns": (20 + number) * S, "torque_nm": None, "valid": False, "reason": reason}
        for number, reason in enumerate(reasons)
    ]
    text = summary_of_hold(None, [], *refused)
    assert (
        "4 of 64 torques of right were not valid and not used, most often: right fingertip: … channels jumped" in text
    )


def test_without_a_truth_nothing_is_said_of_it():
    assert "true" not in summary_of_hold(None, [])


@pytest.mark.parametrize("for_s", [100.0, 17.5], ids=["never back", "back at the last moment"])
def test_a_disturbance_that_is_not_overcome_is_said_to_be_none(for_s):
    assert "not back by the end" in summary_of_hold(truth_that_falls_at(26.0, for_s), [(26 * S, "kick")])


@pytest.mark.parametrize(
    ("others", "judge"), [(("left", "load_cell"), "load_cell"), (("left", "combined"), "combined")]
)
def test_without_a_truth_who_judges_is_the_load_cell_and_is_named(others, judge):
    messages = [loop_state(0), loop_state(4, hold=1)]
    for t_s in np.arange(0.0, 20.0, 0.5):
        for source in ("right", *others):
            torque_nm = 0.1 if source != judge or t_s >= 3.0 else 0.0
            reading = {"source": source, "t_mono_ns": round(t_s * S), "torque_nm": torque_nm, "valid": True}
            messages.append(reading)
    text = summary_of(*messages, loop_state(20, phase="done"))
    assert f"    within ± 10% 3.0 s after the set point changed, by {judge}\n" in text


def test_what_the_torque_rests_on_is_said_once():
    note = "the tool's diameter is not known"
    states = [loop_state(0), loop_state(1, torque_note=note), loop_state(2, torque_note=note)]
    assert summary_of(*states, loop_state(3, phase="done", torque_note="")).count(note) == 1
    assert note not in summary_of(loop_state(0), loop_state(3, phase="done"))
    # Before its tare, a run has no torque, and the note says why.
    untared = loop_state(0, torque_nm=None, torque_note="no zero is known")
    assert "no zero" not in summary_of(untared, loop_state(1, torque_note=""), loop_state(3, phase="done"))


def test_holds_are_counted_by_their_kind():
    stale = FaultCode.ESTIMATE_STALE
    faults = f"{stale.text}, {FaultCode.STATE_STALE.text}"
    text = summary_of_hold(
        None,
        [],
        loop_state(20, phase="held", response="hold", faults=faults),
        loop_state(21.5),
        loop_state(23, phase="held", response="hold", faults=stale.text),
        loop_state(24),
    )
    assert f"by faults, the wrist was held for 2.5 s in all: twice {stale.value.kind}\n" in text


def test_each_cause_of_one_hold_is_counted_once():
    lost, other = FaultCode.SENSOR_LOST, FaultCode.TORQUES_DISAGREE
    causes = (lost, other, lost, other)
    held = [loop_state(20 + n, phase="held", response="hold", faults=code.text) for n, code in enumerate(causes)]
    text = summary_of_hold(None, [], *held, loop_state(24))
    reasons = f"once {lost.value.kind}; once {other.value.kind}"
    assert f"by faults, the wrist was held for 4.0 s in all: {reasons}\n" in text


def test_an_experiment_that_was_stopped_says_why():
    stopped = loop_state(5, phase="stopped", activity="the operator said stop")
    assert summary_of(loop_state(0), stopped).splitlines()[1:3] == [
        "What happened: 'hold' was STOPPED before its end, after 5 s.",
        "  the operator said stop",
    ]


@pytest.mark.parametrize("phase", ["done", "stopped", "idle"])
def test_a_run_that_was_not_heard_from_its_beginning_has_no_summary(phase):
    assert summary_of(loop_state(0, phase=phase)) == ""


def test_the_summary_shows_the_operators_pause_beside_the_steps_duration():
    paused = {"phase": "paused", "hold": 1}
    text = summary_of_hold(None, [], loop_state(20, **paused), loop_state(23, **paused), loop_state(26.3, hold=1))
    assert "hold_torque    34.0 s   6.3 s of them paused" in text


def skin_that_does_not_move(set_nm: float, half_nm: float) -> list[dict[str, Any]]:
    """Return what a skin says whose friction hides each change, beside a load cell that follows the set point."""
    told = []
    for t_s in np.arange(10.0, 40.0, 0.5):
        shear = {"torque_nm": set_nm, "torque_low_nm": set_nm - half_nm, "torque_high_nm": set_nm + half_nm}
        told.append({"source": "skin", "t_mono_ns": round(t_s * S), "valid": True, **shear})
    return told


def test_a_torque_whose_interval_is_wider_than_its_spread_has_no_spread_and_judges_nothing():
    """The skin's torque stays the same within its friction band: it was said to be within ± 10 % for 100 %."""
    told = [loop_state(10), loop_state(12, hold=1), *skin_that_does_not_move(0.1, 0.02)]
    text = summary_of(*told, loop_state(40, phase="done"))
    assert "skin        +0.1000 N·m on average, its interval is +0.0800 to +0.1200\n" in text
    assert "by skin" not in text
    narrow = [loop_state(10), loop_state(12, hold=1), *skin_that_does_not_move(0.1, 0.001)]
    assert "within ± 10% for 100% of the time" in summary_of(*narrow, loop_state(40, phase="done"))


def test_a_set_point_that_stays_is_not_said_to_have_changed():
    truth = TorqueSeries(np.arange(0.0, 60.0, 0.1) * S, np.full(600, 0.1))
    states = [loop_state(10, step=1), loop_state(12, step=1, hold=1), loop_state(30, step=2), loop_state(31, hold=1)]
    again = summary_of(*states, loop_state(50, phase="done", steps=2), truth=truth)
    assert again.count("after the set point changed") == 1
    other = [*states[:2], *(loop_state(one["t_mono_ns"] / S, hold=one["hold"], set_point_nm=0.2) for one in states[2:])]
    moved = TorqueSeries(truth.t_ns, np.where(truth.t_ns < 31 * S, 0.1, 0.2))
    changed = summary_of(*other, loop_state(50, phase="done", steps=2), truth=moved)
    assert changed.count("after the set point changed") == 2


def test_a_set_point_within_the_noise_has_no_band_and_is_not_zero():
    truth = TorqueSeries(np.arange(0.0, 60.0, 0.1) * S, np.full(600, 0.001))
    states = [loop_state(10, set_point_nm=1e-6), loop_state(12, hold=1, set_point_nm=1e-6)]
    text = summary_of(*states, loop_state(50, phase="done", set_point_nm=1e-6), truth=truth)
    assert "set point +1e-06 N·m" in text
    assert "within" not in text


def test_steps_that_take_no_time_and_angles_without_a_hold_are_told():
    states = [loop_state(10, step=1, steps=4, step_name="twist"), loop_state(12, step=3, steps=4, step_name="release")]
    text = summary_of(*states, loop_state(14, step=3, steps=4, phase="done"))
    assert "angles held" not in text
    assert re.findall(r"step (\d) of 4  (.+?)  +([\d.]+) s", text) == [
        ("1", "twist", "2.0"),
        ("2", "at once", "0.0"),
        ("3", "release", "2.0"),
        ("4", "at once", "0.0"),
    ]


def test_a_set_point_of_nothing_has_no_band():
    states = [loop_state(t_s, hold=1, set_point_nm=0.0) for t_s in (10, 14)]
    readings = [{"source": "right", "t_mono_ns": t_s * S, "torque_nm": 0.001, "valid": True} for t_s in range(15, 40)]
    text = summary_of(*states, *readings, loop_state(44, phase="done", set_point_nm=0.0), sent=[(20 * S, "kick")])
    assert "right       +0.0010 N·m on average, standard deviation 0.0000\n" in text
    assert "within ±" not in text


def test_the_summary_of_a_tightening_has_the_angle_and_the_final_and_largest_torque():
    truth = TorqueSeries(np.array([10.0, 11.0, 12.0]) * S, np.array([-0.05, -0.18, -0.119]))
    turning = {"step_name": "tighten", "torque_source": "load_cell", "set_point_nm": None}
    messages = [loop_state(10, **turning)]
    for t_s, wrist_rad, torque_nm in ((10.0, 0.4, -0.05), (11.0, 0.2, -0.176), (12.0, -0.1, -0.121)):
        messages.append({"source": "robot", "wrist_rad": wrist_rad})
        messages.append({"source": "load_cell", "t_mono_ns": round(t_s * S), "torque_nm": torque_nm})
    text = summary_of(*messages, loop_state(12.1, phase="done", **turning), truth=truth)
    assert "    turned by -0.500 rad; torque source: load_cell; true torque: of the emulated tool" in text
    assert "    true torque -0.1190 N·m at the end, -0.1800 at most" in text
    assert "    load_cell   -0.1210 N·m at the end, -0.1760 at most" in text


def test_a_torque_that_was_measured_long_before_the_end_of_a_tightening_says_so():
    turning = {"step_name": "tighten", "torque_source": "right", "set_point_nm": None}
    measured = [
        {"source": "right", "t_mono_ns": round(t_s * S), "torque_nm": -0.01 * t_s} for t_s in (10.2, 10.7, 11.2)
    ]
    for end_s, when in ((11.9, "at the end"), (17.0, "5.8 s before the end, and none since")):
        text = summary_of(loop_state(10, **turning), *measured, loop_state(end_s, phase="stopped", **turning))
        assert f"    right       -0.1120 N·m {when}, -0.1120 at most" in text


@pytest.mark.parametrize(
    ("code", "detail", "shown"),
    [
        (FaultCode.STATE_STALE, "the robot last reported its state 0.31 s ago", True),
        (FaultCode.ESTIMATE_STALE, "the last torque of right came 3.4 s ago", True),
        (FaultCode.ROBOT_UNCONTROLLED, "The control program on the robot does not run.", True),
        (FaultCode.ROBOT_BLOCKED, "Torque is 6.81 N m, beyond the hard limit of 6.5 N m.", False),
        (FaultCode.STEP_OVERDUE, "step 3 (twist) has taken 5.0 s of at most 5 s", False),
        (FaultCode.TORQUE_LIMIT, "right measured +0.300 N·m, the limit is 0.25 N·m", False),
    ],
)
def test_a_late_stop_of_an_emulated_rig_names_the_busy_computer(code, detail, shown):
    sentence = Fault(code, detail).sentence
    stopped = loop_state(5, phase="stopped", activity=f"{sentence} And more.", cause=sentence, faults=code.text)
    text = summary_of(loop_state(0), stopped)
    assert text.lstrip().startswith("Unless a device was unplugged, this computer was too busy") == shown
    assert text.count(sentence) == 1
    assert "And more" not in text
    on_a_rig = RunSummary(out := StringIO())
    for content in (loop_state(0), stopped):
        on_a_rig("loop.state", content)
    assert "too busy" not in out.getvalue()


@pytest.mark.parametrize(
    ("codes", "shown"),
    [
        ((FaultCode.HELD_TOO_LONG, FaultCode.ESTIMATE_INVALID, FaultCode.LOOP_LATE), True),
        ((FaultCode.HELD_TOO_LONG, FaultCode.ESTIMATE_INVALID), False),
        ((FaultCode.TORQUE_LIMIT, FaultCode.STATE_STALE), False),
    ],
)
def test_what_followed_from_another_cause_is_not_blamed_on_the_computer(codes, shown):
    faults = ", ".join(code.text for code in codes)
    stopped = loop_state(5, phase="stopped", cause="it stopped", activity="it stopped", faults=faults)
    assert ("too busy" in summary_of(loop_state(0), stopped)) is shown


@pytest.mark.parametrize(("late_s", "shown"), [(16.0, True), (1.0, False)])
def test_holds_of_a_busy_computer_that_are_over_at_the_stop_are_named(late_s, shown):
    def held(t_s: float, code: FaultCode) -> dict[str, Any]:
        return loop_state(t_s, phase="held", response="hold", faults=code.text)

    faults = f"{FaultCode.HELD_TOO_LONG.text}, {FaultCode.ESTIMATE_INVALID.text}"
    stopped = loop_state(61, phase="stopped", cause="it stopped", activity="it stopped", faults=faults)
    held_in_turn = held(1, FaultCode.ESTIMATE_STALE), held(1 + late_s, FaultCode.ESTIMATE_INVALID)
    assert ("too busy" in summary_of(loop_state(0), *held_in_turn, stopped)) is shown


@pytest.mark.parametrize("code", [FaultCode.OPERATOR_STOP, FaultCode.DAEMON_ENDED])
def test_a_stop_that_was_asked_for_is_no_error(code):
    faults = f"{code.text}, {FaultCode.STATE_STALE.text}"
    said = {"activity": "the operator stopped it", "cause": Fault(code, "the wrist stands").sentence, "faults": faults}
    text = summary_of(loop_state(0), loop_state(5, phase="stopped", **said))
    assert "'hold' was stopped as asked, after 5 s.\n  the operator stopped it\n" in text
    assert "STOPPED" not in text


def test_a_pause_of_the_daemon_counts_as_held_though_it_is_known_only_at_its_end():
    """The loop was late by a second, and the wrist was held until its next decision, 8 ms later."""
    late = FaultCode.LOOP_LATE
    told = (
        loop_state(0),
        loop_state(5.0),
        loop_state(6.0, phase="held", response="hold", faults=late.text, held_s=1.0),
        loop_state(6.008, held_s=1.008),
        loop_state(9.0, phase="stopped", faults=FaultCode.HELD_TOO_LONG.text, held_s=1.008),
    )
    text = summary_of(*told)
    assert f"by faults, the wrist was held for 1.0 s in all: once {late.value.kind}\n" in text
    assert "too busy" in text


@pytest.mark.parametrize(
    ("phase", "code", "as_asked"),
    [
        ("done", "", True),
        ("stopped", FaultCode.OPERATOR_STOP.text, True),
        ("stopped", FaultCode.TORQUE_LIMIT.text, False),
        ("stopped", f"{FaultCode.TORQUE_LIMIT.text}, {FaultCode.OPERATOR_STOP.text}", False),
    ],
)
def test_a_run_ended_as_asked_only_if_it_was_done_or_an_operator_stopped_it(phase, code, as_asked):
    summary = RunSummary()
    assert summary.ended_as_asked
    for content in (loop_state(0), loop_state(5, phase=phase, faults=code)):
        summary("loop.state", content)
    assert summary.ended_as_asked is as_asked


def test_the_times_of_a_stop_follow_the_summary():
    times = {"decided_after_s": 0.004, "sent_after_s": 0.006, "stands_after_s": None}
    stop = {"source": "stop", "t_mono_ns": 5 * S, **times}
    text = summary_of(loop_state(0), loop_state(5, phase="stopped"), stop)
    sentence = "The stop, from its cause: decided after 0.004 s, sent after 0.006 s, no standstill measured."
    assert text.index("STOPPED before its end") < text.index(sentence)


SET_NM, HOLD_S, END_S = 0.1, 14.25, 44.0


def back_after(t_s: np.ndarray, torque_nm: np.ndarray) -> float | None:
    """Return the first of the times from which the torque is within 10 % for a second, tried one after the other."""
    inside = [abs(value - SET_NM) <= 0.1 * SET_NM for value in torque_nm]
    for at, begin_s in enumerate(t_s):
        near = [inside[i] for i in range(at, len(t_s)) if t_s[i] < begin_s + 1.0]
        if all(near) and t_s[-1] >= begin_s + 1.0:
            return float(begin_s)
    return None


def in_text(pattern: str, text: str) -> list[tuple[str, ...]]:
    found = re.findall(pattern, text)
    assert found, f"{pattern!r} is not in:\n{text}"
    return [one if isinstance(one, tuple) else (one,) for one in found]


@pytest.mark.parametrize("seed", range(6))
def test_each_number_of_a_hold_follows_from_the_messages(seed):
    random = np.random.default_rng(seed)
    kicks = [(20.0, "first"), (26.5, "second"), (38.0, "third")]
    rates_hz = {"right": 1.85, "load_cell": 10.9, "true torque": 25.0}
    series: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, rate_hz in rates_hz.items():
        t_ns = np.round((np.arange(1.0, END_S + 2.0, 1 / rate_hz) + random.uniform(0, 0.01)) * S)
        t_s = t_ns / S
        torque_nm = SET_NM * (1 - np.exp(-np.maximum(t_s - 10.0, 0) / random.uniform(0.5, 1.5)))
        for kick_s, _ in kicks:
            torque_nm -= 0.05 * np.where(t_s >= kick_s, np.exp(-(t_s - kick_s) / random.uniform(0.3, 3)), 0)
        # So much that the torque leaves its band again and again.
        series[name] = t_ns, torque_nm + random.normal(0, 0.004, len(t_s))
    # States of the loop: twice held by a fault, at times that no other message has.
    first = {"step": 1, "step_name": "identify", "set_point_nm": None}
    held = {"phase": "held", "response": "hold", "faults": FaultCode.ESTIMATE_STALE.text, "hold": 1}
    states = [loop_state(0.5, **first), loop_state(9.75), loop_state(HOLD_S, hold=1)]
    states += [loop_state(21.125, **held), loop_state(21.9, **held), loop_state(22.75, hold=1)]
    states += [loop_state(30.0, **held), loop_state(31.3, hold=1), loop_state(END_S, phase="done")]
    invalid_at = set(random.choice(len(series["load_cell"][0]), 37, replace=False).tolist())
    readings = []
    for name in ("right", "load_cell"):
        for number, (t_ns, torque_nm) in enumerate(zip(*series[name], strict=True)):
            valid = name == "right" or number not in invalid_at
            said = {"torque_nm": torque_nm, "valid": valid, "reason": "" if valid else "a spike: 3 times the others"}
            readings.append({"source": name, "t_mono_ns": int(t_ns), **said})
    every = sorted([*states, *readings], key=lambda one: one["t_mono_ns"])
    heard = [one for one in every if 0.5 * S <= one["t_mono_ns"] <= END_S * S]
    truth = TorqueSeries(*series["true torque"])
    text = summary_of(*heard, truth=truth, sent=[(round(t_s * S), name) for t_s, name in kicks])

    # What the messages say, one by one.
    taken = {
        name: [
            (one["t_mono_ns"] / S, one["torque_nm"])
            for one in heard
            if one["source"] == name and one.get("valid") and one["t_mono_ns"] / S <= END_S
        ]
        for name in ("right", "load_cell")
    }
    taken["true torque"] = [(t_ns / S, value) for t_ns, value in zip(*series["true torque"], strict=True)]
    lines = in_text(r"    (\S+|true torque) +(\S+) N·m on average, standard deviation (\S+), .* for (\d+)%", text)
    assert sorted(line[0] for line in lines) == ["load_cell", "right", "true torque"]
    for name, mean, deviation, share in lines:
        # A sensor's torque counts if its whole acquisition lies in the hold.
        half_s = 0.0 if name == "true torque" else 0.5 / rates_hz[name]
        during = [value for t_s, value in taken[name] if HOLD_S + half_s <= t_s <= END_S - half_s]
        average = sum(during) / len(during)
        assert float(mean) == pytest.approx(average, abs=0.51e-4), name
        squares = sum((value - average) ** 2 for value in during)
        assert float(deviation) == pytest.approx((squares / len(during)) ** 0.5, abs=0.51e-4), name
        near = sum(abs(value - SET_NM) <= 0.1 * SET_NM for value in during)
        assert float(share) == pytest.approx(100 * near / len(during), abs=0.51), name
    ((set_point, lasted),) = in_text(r"set point (\S+) N·m, held for (\d+) s", text)
    assert float(set_point) == SET_NM
    assert float(lasted) == pytest.approx(END_S - HOLD_S, abs=0.51)
    ((took,),) = in_text(r"was done, after (\d+) s", text)
    assert float(took) == pytest.approx(END_S - 0.5, abs=0.51)
    steps = in_text(r"step (\d) of 3 +(\w+) +(\S+) s", text)
    assert steps == [("1", "identify", f"{9.75 - 0.5:.1f}"), ("2", "hold_torque", f"{END_S - 9.75:.1f}")]
    # The first hold lasts from 21.125 to 22.75 s, the second from 30 to 31.3 s.
    kind = FaultCode.ESTIMATE_STALE.value.kind
    assert f"held for {22.75 - 21.125 + 31.3 - 30.0:.1f} s in all: twice {kind}" in text
    heard_loads = [one for one in heard if one["source"] == "load_cell"]
    refused = [one for one in heard_loads if not one["valid"]]
    assert f"{len(refused)} of {len(heard_loads)} torques of load_cell were not valid and not used" in text
    # The way in and the ways back are judged by the true torque.
    t_s, torque_nm = map(np.array, zip(*taken["true torque"], strict=True))
    step = (t_s >= 9.75) & (t_s <= END_S)
    ((reached,),) = in_text(r"within ± 10% (\S+) s after the set point changed, by true torque", text)
    assert float(reached) == pytest.approx(back_after(t_s[step], torque_nm[step]) - 9.75, abs=0.051)
    told = in_text(r"disturbed after (\S+) s \((\w+)\): (\S+) N·m off, (.*)", text)
    for (after, name, off, back), (kick_s, kick), end_s in zip(told, kicks, (26.5, 38.0, END_S), strict=True):
        assert name == kick
        assert float(after) == pytest.approx(kick_s - HOLD_S, abs=0.051)
        part = (t_s >= kick_s) & (t_s <= END_S if end_s == END_S else t_s < end_s)
        assert float(off) == pytest.approx(max(abs(torque_nm[part] - SET_NM)), abs=0.51e-3)
        expected = back_after(t_s[part], torque_nm[part])
        if expected is None:
            assert back.startswith("not back by the ")
        else:
            ((back_s,),) = in_text(r"back within ± 10% after (\S+) s", back)
            assert float(back_s) == pytest.approx(expected - kick_s, abs=0.051)


def test_a_stop_whose_cause_nothing_measured_has_no_time_of_its_decision():
    stop = {"source": "stop", "decided_after_s": None, "sent_after_s": 0.006, "stands_after_s": 0.12}
    text = summary_of(loop_state(0), loop_state(5, phase="stopped"), stop)
    told = "The stop, from its decision, because nothing measured its cause: sent after 0.006 s, standstill after 0.120"
    assert told in text


def test_the_times_of_a_stop_are_those_of_its_message():
    times = dict(zip(("decided_after_s", "sent_after_s", "stands_after_s"), (0.0123, 0.0456, 1.7894), strict=True))
    text = summary_of(loop_state(0), loop_state(5, phase="stopped"), {"source": "stop", "t_mono_ns": 5 * S, **times})
    ((decided, sent, stands),) = in_text(r"decided after (\S+) s, sent after (\S+) s, standstill after (\S+) s\.", text)
    assert (float(decided), float(sent), float(stands)) == pytest.approx((0.012, 0.046, 1.789))


def test_each_unit_of_the_summary_is_that_of_a_messages_key(monkeypatch):
    marked = {topic: {key: f"<{topic} {key}>" for key in messages.units(topic)} for topic in messages.TOPICS}
    monkeypatch.setattr(messages, "units", lambda topic: marked[topic])
    text = summary_of_hold(truth_that_falls_at(26.0, 5.5), [(26 * S, "kick")])
    assert "stiffness 0.750 <loop.state stiffness_nm_per_rad>, delay 0.80 <loop.state delay_s>, " in text
    assert "noise of one torque 0.0120 <loop.state noise_nm>" in text
    turning = {"step_name": "tighten", "set_point_nm": None}
    robot = [{"source": "robot", "wrist_rad": angle_rad} for angle_rad in (0.4, -0.1)]
    load = {"source": "right", "t_mono_ns": S, "torque_nm": -0.05, "valid": True}
    stop = {"source": "stop", "decided_after_s": 0.004, "sent_after_s": 0.006, "stands_after_s": None}
    text += summary_of(loop_state(0, **turning), *robot, load, loop_state(5, phase="stopped", **turning), stop)
    assert "turned by -0.500 <robot.state wrist_rad>" in text
    assert "decided after 0.004 <loop.stop decided_after_s>, sent after 0.006 <loop.stop sent_after_s>" in text
    assert not re.search(r"\d (N·m|rad)", text)


@pytest.mark.parametrize(("delay_s", "said"), [(-0.004, "0.00"), (-0.006, "-0.01"), (0.0, "0.00"), (0.8, "0.80")])
def test_a_value_that_rounds_to_zero_has_no_sign(delay_s, said):
    assert with_unit("loop.state", "delay_s", delay_s, ".2f") == f"{said} s"
