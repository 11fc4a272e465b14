"""The summary of an experiment, made from the daemon's own messages at its end.

An emulated rig adds the true torque and the disturbances.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, TextIO

import numpy as np

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging.messages import stop_times, with_unit
from shearloop.daemon.run_record import Run, StepSummary, TorqueSeries, elapsed_s
from shearloop.printable import printable

if TYPE_CHECKING:
    from shearloop.daemon.logs import NonBlockingWriter

# Topics with a torque.
TORQUES = ("eit.estimate", "load.torque", "skin.shear")
_ENDS = ("done", "stopped")
# Of a hold for too long, from this fraction of the time with a fault of a busy computer on.
_LATE_FRACTION = 0.1
_TOO_BUSY = (
    "Unless a device was unplugged, this computer was too busy for the emulated rig: close other programs and run it "
    "again."
)
_ASKED_FOR = frozenset(code.text for code in FaultCode if code.value.asked_for)
_BY_BUSY_COMPUTER = frozenset(code.text for code in FaultCode if code.value.by_busy_computer)


class EmulatedTruth(Protocol):
    """An emulated rig; `sent` holds the disturbances, with their times in ns."""

    sent: list[tuple[int, str]]

    def torques(self) -> TorqueSeries | None:
        """Return the true torque so far, None if it is unknown."""


class RunSummary:
    """Collects every message of a daemon; `text` is the summary of the last experiment that ended, or empty."""

    def __init__(
        self,
        out: "TextIO | NonBlockingWriter | None" = None,
        emulated: EmulatedTruth | None = None,
        *,
        heading: str = "",
    ) -> None:
        """Take the output for each summary, if any, an emulated rig, which adds its true torque, and a first line."""
        self._heading = heading
        self.text = ""
        # Whether no experiment has been stopped by anything but a person.
        self.ended_as_asked = True
        self.out = out
        self._emulated = emulated
        self._run: Run | None = None

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Handle one message."""
        if topic == "loop.state":
            self._on_loop_state(content)
        elif topic == "loop.stop":
            self.add(f"The stop, {stop_times(content)}.")
        elif self._run is not None:
            _on_sample(self._run, topic, content)

    def _on_loop_state(self, content: Mapping[str, Any]) -> None:
        run, phase = self._run, content["phase"]
        if phase == "idle" or (run is None and phase in _ENDS):
            return
        if run is None:
            run = self._run = Run(content, {**content, "phase": "", "response": ""})
        _update(run, content)
        if phase in _ENDS:
            self._run = None
            self.ended_as_asked = phase == "done" or _was_asked_for(content)
            rig = self._emulated
            # Loaded once an experiment has ended.
            from shearloop.daemon.summary_text import lines_of

            truth, sent = (rig.torques(), rig.sent) if rig is not None else (None, [])
            lines = list(lines_of(run, truth, sent, asked_for=_was_asked_for(content)))
            if rig is not None and phase != "done" and _may_be_late(run, content):
                lines.insert(0, _TOO_BUSY)
            if self._heading:
                lines.insert(0, self._heading)
            self.text = ""
            self.add("\n".join(lines))

    def add(self, text: str) -> None:
        """Append to the summary, and write it to the output, if there is one."""
        self.text = f"{self.text}\n{text}".lstrip("\n")
        if self.out is not None:
            self.out.write(f"\n{printable(text)}\n\n")


def _was_asked_for(content: Mapping[str, Any]) -> bool:
    """Return whether a person stopped the experiment of a `loop.state`."""
    return bool(_ASKED_FOR.intersection(_codes(content)[:1]))


def _may_be_late(run: Run, content: Mapping[str, Any]) -> bool:
    """Return whether a busy computer can be the cause of a stop; a consequence of another fault does not count."""
    codes = _codes(content)
    if FaultCode.HELD_TOO_LONG.text not in codes[:1]:
        return bool(_BY_BUSY_COMPUTER.intersection(codes[:1]))
    # Several holds together have no cause among them, and those that were before may be gone.
    return bool(_BY_BUSY_COMPUTER.intersection(codes)) or 0.0 < _LATE_FRACTION * content["held_s"] <= run.late_s


def _codes(content: Mapping[str, Any]) -> list[str]:
    """Return the codes of the faults of a `loop.state`, the cause's first."""
    return list(filter(None, content["faults"].split(", ")))


def _on_sample(run: Run, topic: str, content: Mapping[str, Any]) -> None:
    source, step = content["source"], run.steps[-1] if run.steps else None
    if topic == "robot.state" and step is not None:
        step.wrist_to_rad = content["wrist_rad"]
        step.wrist_from_rad = step.wrist_to_rad if step.wrist_from_rad is None else step.wrist_from_rad
    if topic in TORQUES:
        run.times_ns[source].append(content["t_mono_ns"])
    if topic in TORQUES and content.get("torque_nm") is not None and content.get("valid", True):
        low_nm, high_nm = (content.get(f"torque_{end}_nm") for end in ("low", "high"))
        bounds_nm = (np.nan, np.nan) if low_nm is None or high_nm is None else (low_nm, high_nm)
        run.torques.setdefault(source, []).append((content["t_mono_ns"], content["torque_nm"], *bounds_nm))
    elif topic in TORQUES and not content.get("valid", True):
        run.invalid[source].add(content["reason"])


def _update(run: Run, content: Mapping[str, Any]) -> None:
    now_ns = content["t_mono_ns"]
    # A late decision was held before it is known.
    holding = run.last if run.last["phase"] == "held" else content
    if _BY_BUSY_COMPUTER.intersection(_codes(holding)):
        run.late_s += content["held_s"] - run.last["held_s"]
    if run.last["phase"] == "paused" and run.steps:
        run.steps[-1].paused_s += elapsed_s(run.last, content)
    if content["response"] == "hold":
        if run.last["response"] != "hold":
            run.kinds_of_hold.clear()
        # The cause can change while the wrist is held.
        kind = FaultCode.of_text(_codes(content)[0]).value.kind
        if kind not in run.kinds_of_hold:
            run.kinds_of_hold.add(kind)
            run.hold_reasons[kind] += 1
    run.last = content
    if content.get("torque_nm") is not None:
        run.torque_note = content.get("torque_note") or run.torque_note
    if run.steps:
        run.steps[-1].to_ns = now_ns
    if content["phase"] in _ENDS:
        if content["phase"] == "done":
            _add_passed(run, content["steps"] + 1, now_ns)
        return
    if not run.steps or run.steps[-1].number != content["step"]:
        _add_passed(run, content["step"], now_ns)
        run.steps.append(StepSummary(content["step"], content["step_name"], now_ns, now_ns))
    step = run.steps[-1]
    step.holds = max(step.holds, content["hold"])
    if content["set_point_nm"] is not None and content["step_name"] == "hold_torque":
        step.set_point_nm = content["set_point_nm"]
        if content["hold"] and step.held_from_ns is None:
            step.held_from_ns = now_ns
    found = (
        ("stiffness", "stiffness_nm_per_rad", ".3f"),
        ("delay", "delay_s", ".2f"),
        ("noise of one torque", "noise_nm", ".4f"),
    )
    if all(content[key] is not None for _, key, _ in found):
        named = (f"{name} {with_unit('loop.state', key, content[key], form)}" for name, key, form in found)
        run.identified = f"   {', '.join(named)}"


def _add_passed(run: Run, next_number: int, now_ns: int) -> None:
    """Add the steps that took no time, such as `wait: 0`: no message has them."""
    while run.steps and run.steps[-1].number + 1 < next_number:
        run.steps.append(StepSummary(run.steps[-1].number + 1, "", now_ns, now_ns))
