"""The list of what happened: one line for each change, whoever asks for it and however often it is said."""

from typing import Any

from shearloop.daemon.web.event_log import MAX_EVENTS, EventLog
from shearloop.daemon.web.message_store import MessageStore


def lines(*told: tuple[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the kinds and texts of the events of these messages, each said twice."""
    log = EventLog()
    for number, (topic, content) in enumerate(told):
        for again in range(2 if topic != "daemon.command" else 1):
            log.add(topic, {"timestamp": float(number), **content}, 2 * number + again + 1)
    return [(event["kind"], event["text"]) for event in log.events]


def loop(phase: str, step: int = 1, **changed: Any) -> tuple[str, dict[str, Any]]:
    state = {"phase": phase, "run": 1, "experiment": "hold", "step": step, "steps": 3, "step_name": "grip"}
    return "loop.state", {**state, "reasons": "", "response": "note", **changed}


def test_the_event_log_lists_each_step_hold_and_stop_once():
    assert lines(
        loop("idle"),
        loop("running"),
        loop("running", 2),
        loop("held", 2, cause="the torque is not valid.", faults="estimate invalid, state stale", reasons="Both."),
        loop("held", 2, cause="the torque is not valid.", faults="estimate invalid", reasons="One."),
        loop("running", 2),
        loop("stopped", 2, cause="the torque is old.", faults="estimate stale", response="stop and keep grip"),
        loop("idle", 2),
        loop("running", run=2),
        loop("stopped", run=2, cause="the operator stopped it.", faults="operator stop", response="stop and keep grip"),
        loop("idle", 2),
        loop("running", run=3),
        loop("done", run=3),
    ) == [
        ("step", "hold runs"),
        ("step", "step 1 of 3: grip"),
        ("step", "step 2 of 3: grip"),
        ("hold", "holding: the torque is not valid. Also: state stale."),
        ("step", "continues"),
        ("stop", "STOPPED, stop and keep grip: the torque is old."),
        ("step", "the stop is acknowledged"),
        ("step", "hold runs"),
        ("step", "step 1 of 3: grip"),
        ("step", "stopped as asked: the operator stopped it."),
        ("step", "the stop is acknowledged"),
        ("step", "hold runs"),
        ("step", "step 1 of 3: grip"),
        ("step", "hold is done"),
    ]


def test_the_event_log_lists_commands_with_their_sender_and_reason_of_refusal():
    sent = {"command": "start", "subject": "hold.yaml", "by": "ann@rig, the live page", "accepted": True, "reason": ""}
    refused = {**sent, "command": "tare", "subject": "", "accepted": False, "reason": "something is held"}
    assert lines(("daemon.command", sent), ("daemon.command", refused), ("daemon.command", refused)) == [
        ("command", "start hold.yaml, by ann@rig, the live page"),
        *[("refusal", "tare, by ann@rig, the live page, REFUSED: something is held")] * 2,
    ]


def test_the_event_log_lists_faults_of_tasks_and_devices_and_the_daemons_end():
    alive, dead = {"alive": True, "error": ""}, {"alive": False, "last_error": "RuntimeError: a bug"}
    times = {"experiment": "hold", "decided_after_s": 0.004, "sent_after_s": 0.006, "stands_after_s": None}
    assert lines(
        ("health", {"tasks": {"loop": alive, "right": alive}}),
        ("health", {"tasks": {"loop": dead, "right": {**alive, "error": "look at the cable"}}}),
        ("health", {"tasks": {"loop": alive, "right": alive}}),
        ("robot.state", {"blocked": ""}),
        ("gripper.state", {"fault_text": ""}),
        ("robot.state", {"blocked": "it is in a protective stop", "protective_stop": True}),
        ("gripper.state", {"fault_text": "no current"}),
        ("loop.stop", times),
        ("daemon.end", {}),
    ) == [
        ("fault", "loop is dead: RuntimeError: a bug"),
        ("fault", "right: look at the cable"),
        ("step", "loop runs again"),
        ("fault", "it is in a protective stop"),
        ("fault", "no current"),
        ("stop", "the stop, from its cause: decided after 0.004 s, sent after 0.006 s, no standstill measured"),
        ("stop", "the daemon has ended"),
    ]


def test_a_robot_whose_motion_is_not_enabled_yet_has_no_fault():
    assert lines(("robot.state", {"blocked": ""}), ("robot.state", {"blocked": "not enabled"})) == [
        ("step", "not enabled")
    ]


def test_what_began_before_the_viewer_is_not_dated_at_its_start():
    since = " (since before this time)"
    assert lines(
        loop("running", 2),
        loop("running", 3),
        ("health", {"tasks": {"loop": {"alive": False, "last_error": "a bug"}}}),
        ("robot.state", {"blocked": "it is in a protective stop", "protective_stop": True}),
        ("gripper.state", {"fault_text": "no current"}),
    ) == [
        ("step", f"hold runs{since}"),
        ("step", f"step 2 of 3: grip{since}"),
        ("step", "step 3 of 3: grip"),
        ("fault", f"loop is dead: a bug{since}"),
        ("fault", f"it is in a protective stop{since}"),
        ("fault", f"no current{since}"),
    ]
    assert lines(loop("stopped", cause="the torque is old.", response="stop and keep grip"))[0][1].endswith(since)


def test_a_standstill_before_the_decision_says_so():
    """As after a pause of the daemon: decided after 5.6 s, and standstill after 2.7 s."""
    times = {"experiment": "hold", "decided_after_s": 5.625, "sent_after_s": 5.627, "stands_after_s": 2.652}
    ((_, said),) = lines(("loop.stop", times))
    assert said.endswith("decided after 5.625 s, sent after 5.627 s, standstill after 2.652 s, before the decision")


def test_the_event_log_says_why_a_stop_was_not_sent():
    times = {"experiment": "hold", "decided_after_s": 0.0, "sent_after_s": None, "stands_after_s": 0.096}
    times |= {"refusal": "Nothing can be sent.", "blocked_after_s": 0.004}
    assert lines(("loop.stop", times)) == [
        (
            "stop",
            "the stop, from its cause: decided after 0.000 s, not sent, because the robot was blocked after 0.004 s, "
            "standstill after 0.096 s, by the robot's own stop",
        ),
        ("fault", "the stop was not sent: Nothing can be sent."),
    ]


def test_a_page_that_is_opened_anew_gets_all_of_them_and_an_open_one_the_new_ones():
    store = MessageStore(4.0)
    content = {"timestamp": 1.0, "seq": 0, "source": "loop", "t_mono_ns": 1}
    store.add("loop.state", {**content, **loop("running")[1]}, 1.0)
    seen = store.number
    store.add("loop.state", {**content, **loop("running", 2)[1]}, 1.1)
    assert "step 1 of 3" in store.batch(0, 2.0)
    assert "step 1 of 3" not in store.batch(seen, 2.0)
    assert "step 2 of 3" in store.batch(seen, 2.0)


def test_only_the_latest_events_are_kept():
    log = EventLog()
    for number in range(MAX_EVENTS + 5):
        log.add("daemon.command", {"timestamp": 0.0, "command": f"c{number}", "accepted": True, "by": "x"}, number)
    assert len(log.events) == MAX_EVENTS
    assert log.events[0]["text"].startswith("c5,")
