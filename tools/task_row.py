"""A task of `health` in words, for `listen`, `command status` and the doctor."""

from collections.abc import Mapping
from typing import Any

from shearloop.words import times

# Errors of a device's connection, which connects again by itself.
LINK_ERRORS = ("unreachable", "silent", "lost")


def task_row(name: str, facts: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Return the name of a task of `health`, its state, its rate, and its notes: restarts, errors, the latest error."""
    down = facts.get("connected") is False
    if facts.get("done"):
        state = "done"
    elif facts.get("alive") is False:
        state = "DEAD"
    else:
        state = "not connected" if down else "alive"
    notes = [f"restarted {times(facts['restarts'])}"] if facts.get("restarts") else []
    errors = dict(facts.get("errors") or {})
    lost = sum(errors.pop(kind, 0) for kind in LINK_ERRORS) or (facts.get("connections") or 1) - 1
    if lost and not down:
        notes.append(f"reconnected {times(lost)}")
    notes += [f"{kind} {times(count)}" for kind, count in errors.items()]
    if error := facts.get("error") or facts.get("last_error") or (down and facts.get("last_loss")):
        notes.append(error)
    return name, state, _rate(facts.get("rate_hz"), facts.get("expected_hz")), ", ".join(notes)


def _rate(rate_hz: float | None, expected_hz: float | None) -> str:
    if rate_hz is None:
        return ""
    return f"{rate_hz:.2f} Hz" if expected_hz is None else f"{rate_hz:.2f} of {expected_hz:.2f} Hz"
