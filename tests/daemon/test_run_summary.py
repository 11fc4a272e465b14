from collections.abc import Sequence
from io import StringIO
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.control.safety import Fault, FaultCode
from shearloop.daemon.run_summary import RunSummary, TorqueSeries

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
        "stiffness_nm_per_rad": 0.75,
        "delay_s": 0.8,
        "noise_nm": 0.012,
        "response": "note",
        "cause": "",
        "faults": "",
        "reasons": "",
        **changes,
    }


def summary_of(
    *messages: dict[str, Any], truth: TorqueSeries | None = None, sent: Sequence[tuple[int, str]] = ()
) -> str:
    """Return what is told of these messages, each of the topic of its source."""
    out = StringIO()
    summary = RunSummary(out, SimpleNamespace(torques=lambda: truth, sent=sent))
    for content in messages:
        summary(TOPICS.get(content["source"], "eit.estimate"), content)
    return out.getvalue()


def summary_of_hold(truth: TorqueSeries | None, happened: list[tuple[int, str]], *more: dict[str, Any]) -> str:
    first = {"step": 1, "step_name": "identify", "set_point_nm": None}
    messages = [loop_state(0, **first), loop_state(10), loop_state(14, hold=1), *more]
    for t_s in np.arange(14.0, 44.0, 0.5):
        values = {"torque_nm": 0.098, "valid": True}
        messages.append({"source": "right", "t_mono_ns": round(t_s * S), **values})
    messages.append({"source": "right", "t_mono_ns": 44 * S, "torque_nm": None, "valid": False, "reason": "no grip"})
    return summary_of(*messages, loop_state(44, phase="done", hold=0), truth=truth, sent=happened)


def truth_that_falls_at(t_s: float, for_s: float) -> TorqueSeries:
    times = np.arange(0.0, 44.0, 0.1)
    torque = np.where(times < 13.0, 0.0, 0.1) - 0.03 * ((times >= t_s) & (times < t_s + for_s))
    return TorqueSeries(times * S, torque)


def test_a_disturbance_is_told_without_the_next_one():
    t_s = np.arange(0.0, 44.0, 0.1)
    fallen = 0.015 * ((t_s >= 20) & (t_s < 21)) + 0.08 * ((t_s >= 30) & (t_s < 33))
    truth = TorqueSeries(t_s * S, np.where(t_s < 13.0, 0.0, 0.1) - fallen)
    text = summary_of_hold(truth, [(20 * S, "first"), (30 * S, "second")])
    assert "(first): 0.015 N·m off, back within ± 10% after" in text
    assert "(second): 0.080 N·m off, back within ± 10% after" in text


def test_what_was_held_is_told_with_its_truth_and_the_way_back_after_a_disturbance():
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
    assert "the wrist was never held" in text


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
    assert f"held for 2.5 s in all: twice {stale.value.kind}\n" in text


def test_an_experiment_that_was_stopped_says_why():
    stopped = loop_state(5, phase="stopped", activity="the operator said stop")
    assert summary_of(loop_state(0), stopped).splitlines()[1:3] == [
        "What happened: 'hold' was STOPPED before its end, after 5 s.",
        "  the operator said stop",
    ]


@pytest.mark.parametrize("phase", ["done", "stopped", "idle"])
def test_nothing_is_told_of_what_was_not_heard_from_its_beginning(phase):
    assert summary_of(loop_state(0, phase=phase)) == ""


def test_where_a_screw_ended_and_what_it_took_is_told():
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


@pytest.mark.parametrize(
    ("code", "detail", "shown"),
    [
        (FaultCode.STATE_STALE, "the robot last reported its state 0.31 s ago", True),
        (FaultCode.ESTIMATE_STALE, "the last torque of right came 3.4 s ago", True),
        (FaultCode.ROBOT_BLOCKED, "The control program on the robot does not run.", True),
        (FaultCode.TORQUE_LIMIT, "right measured +0.300 N·m, the limit is 0.25 N·m", False),
    ],
)
def test_a_late_stop_of_an_emulated_rig_names_the_busy_computer(code, detail, shown):
    sentence = Fault(code, detail).sentence
    stopped = loop_state(5, phase="stopped", activity=f"{sentence} And more.", cause=sentence, faults=code.text)
    text = summary_of(loop_state(0), stopped)
    assert text.lstrip().startswith("This computer was too busy for the emulated rig") == shown
    assert text.count(sentence) == 1
    assert "And more" not in text
    on_a_rig = RunSummary(out := StringIO())
    for content in (loop_state(0), stopped):
        on_a_rig("loop.state", content)
    assert "too busy" not in out.getvalue()


@pytest.mark.parametrize("code", [FaultCode.OPERATOR_STOP, FaultCode.DAEMON_ENDED])
def test_a_stop_that_was_asked_for_is_no_error(code):
    faults = f"{code.text}, {FaultCode.STATE_STALE.text}"
    said = {"activity": "the operator stopped it", "cause": Fault(code, "the wrist stands").sentence, "faults": faults}
    text = summary_of(loop_state(0), loop_state(5, phase="stopped", **said))
    assert "'hold' was stopped as asked, after 5 s.\n  the operator stopped it\n" in text
    assert "STOPPED" not in text


@pytest.mark.parametrize(
    ("phase", "code", "as_asked"),
    [
        ("done", "", True),
        ("stopped", FaultCode.OPERATOR_STOP.text, True),
        ("stopped", FaultCode.TORQUE_LIMIT.text, False),
        ("stopped", f"{FaultCode.TORQUE_LIMIT.text}, {FaultCode.OPERATOR_STOP.text}", False),
    ],
)
def test_the_summary_tells_a_persons_stop_from_a_faults(phase, code, as_asked):
    summary = RunSummary()
    assert summary.ended_as_asked
    for content in (loop_state(0), loop_state(5, phase=phase, faults=code)):
        summary("loop.state", content)
    assert summary.ended_as_asked is as_asked


def test_the_times_of_a_stop_follow_the_summary():
    times = {"decided_after_s": 0.004, "sent_after_s": 0.006, "stands_after_s": None}
    stop = {"source": "stop", "t_mono_ns": 5 * S, **times}
    text = summary_of(loop_state(0), loop_state(5, phase="stopped"), stop)
    sentence = "The stop, from its cause: decided after 0.004 s, sent after 0.006 s, standstill after an unknown time."
    assert text.index("STOPPED before its end") < text.index(sentence)
