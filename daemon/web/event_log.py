"""The events of a daemon as lines: steps, holds, faults, stops, commands and their senders. No I/O."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging.messages import DaemonEnd, cause_of, stop_times

# The page shows at most this many.
MAX_EVENTS = 200
ACTIVE = frozenset({"running", "paused", "held"})


@dataclass(slots=True)
class EventLog:
    """The latest events of a daemon, each a map of number, timestamp (Unix s), kind and text.

    A command whose sender has named its request also has `request_id` and `reason`.
    """

    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    # The latest message of each topic with events.
    _before: dict[str, Mapping[str, Any]] = field(default_factory=dict)

    def add(self, topic: str, content: Mapping[str, Any], number: int) -> None:
        """Add the events between the previous message of `topic` and this one; `number` is the message's."""
        if topic not in _EVENTS_OF:
            return
        before = self._before.get(topic, {})
        # What the first state shows began earlier, at an unknown time.
        earlier = " (since before this time)" if topic in _STATES and not before else ""
        if topic != DaemonEnd.topic:
            self._before.pop(DaemonEnd.topic, None)
        self._before[topic] = content
        # By these two a page finds the end of its own request.
        own = {key: content[key] for key in ("request_id", "reason") if content.get("request_id")}
        for kind, text in _EVENTS_OF[topic](before, content):
            self.events.append(
                {"number": number, "timestamp": content["timestamp"], "kind": kind, "text": f"{text}{earlier}", **own}
            )

    def after(self, number: int) -> list[dict[str, Any]]:
        """Return the events of messages numbered after `number`, oldest first."""
        return [event for event in self.events if event["number"] > number]


# Topics that repeat a state, which has begun before the first message of it.
_STATES = frozenset({"loop.state", "health", "robot.state", "gripper.state"})
# Kind and text of each event.
Events = Iterator[tuple[str, str]]


def _loop(before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    phase, was = now.get("phase"), before.get("phase")
    experiment, cause = now.get("experiment", ""), cause_of(now)
    begun = phase in ACTIVE and (was not in ACTIVE or before.get("run") != now.get("run"))
    if begun:
        yield "step", f"{experiment} runs"
    if phase in ACTIVE and (begun or before.get("step") != now.get("step")):
        yield "step", f"step {now.get('step')} of {now.get('steps')}: {now.get('step_name') or now.get('activity')}"
    if phase == was:
        return
    if phase == "held":
        yield "hold", f"holding: {cause}"
    elif phase == "paused":
        yield "hold", "paused"
    elif phase == "running" and was in ("held", "paused"):
        yield "step", "continues"
    elif phase == "stopped":
        why = cause or now.get("activity")
        if str(now.get("faults")).split(", ")[0] == FaultCode.OPERATOR_STOP.text:
            yield "step", f"stopped as asked: {why}"
        else:
            yield "stop", f"STOPPED, {now.get('response')}: {why}"
    elif phase == "done":
        yield "step", f"{experiment} is done"
    elif phase == "idle" and was == "stopped":
        yield "step", "the stop is acknowledged"


def _stop(before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    if before and all(before.get(key) == now.get(key) for key in ("t_mono_ns", "experiment", "stands_after_s")):
        return
    yield "stop", f"the stop, {stop_times(now)}"
    if now.get("refusal"):
        yield "fault", f"the stop was not sent: {now['refusal']}"


def _command(_before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    subject = f" {now['subject']}" if now.get("subject") else ""
    answer = "" if now.get("accepted") else f", REFUSED: {now.get('reason')}"
    yield "command" if now.get("accepted") else "refusal", f"{now.get('command')}{subject}, by {now.get('by')}{answer}"


def _health(before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    earlier = before.get("tasks") or {}
    for name, facts in (now.get("tasks") or {}).items():
        was = earlier.get(name, {})
        dead, error = _dead(facts), facts.get("error") or ""
        if dead and not _dead(was):
            yield "fault", f"{name} is dead: {facts.get('last_error') or error or 'no reason is known'}"
        elif not dead and _dead(was):
            yield "step", f"{name} runs again"
        if error and not was.get("error"):
            yield "fault", f"{name}: {error}"


def _dead(facts: Mapping[str, Any]) -> bool:
    return facts.get("alive") is False and not facts.get("done")


def _robot(before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    if now.get("blocked") and not before.get("blocked"):
        # Before the first start, motion is only not enabled.
        stopped = now.get("protective_stop") or now.get("emergency_stop")
        yield "fault" if stopped else "step", str(now["blocked"])


def _gripper(before: Mapping[str, Any], now: Mapping[str, Any]) -> Events:
    if now.get("fault_text") and not before.get("fault_text"):
        yield "fault", str(now["fault_text"])


def _end(before: Mapping[str, Any], _now: Mapping[str, Any]) -> Events:
    if not before:
        yield "stop", "the daemon has ended"


# By topic, what happened between a message and the one before it, which is empty for the first.
_EVENTS_OF: Mapping[str, Callable[[Mapping[str, Any], Mapping[str, Any]], Events]] = {
    "loop.state": _loop,
    "loop.stop": _stop,
    "daemon.command": _command,
    "health": _health,
    "robot.state": _robot,
    "gripper.state": _gripper,
    "daemon.end": _end,
}
