"""The operator's commands: why each one is refused at present, and which question comes before it.

The questions before a release and an unlock are here, so that they are loaded with the rig. A way out must not depend
on files that an upgrade in place has replaced.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from shearloop.daemon.control.experiment import Experiment
from shearloop.daemon.control.experiment_schema import ApproachStep, ExperimentFile
from shearloop.daemon.control.fault_detection import source_fault
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.held_tool import GRIPPED_BEFORE, HeldTool
from shearloop.daemon.control.inputs import LatestInputs
from shearloop.daemon.control.known_tool import UNTURNED_RAD, KnownTool, known_at_start
from shearloop.daemon.control.safety import SafetyMonitor
from shearloop.daemon.control.step_motions import (
    first_grip,
    first_measured,
    first_motion_before_grip,
    first_release,
    first_turn_before_tare,
)
from shearloop.daemon.torques import CONFIRM_TARE, SensorLoad, TorqueSource, load_of

# The way out for a clamped tool, also without a known zero.
CLAMPED_CURE = (
    "turn it back (a step `turn_to` needs no zero; if a limit stops it, at the pendant), or loosen its clamp; once "
    "nothing loads it, `shearloop command release --yes` lets its angle count from 0"
)

# A width that is asked for may be one count of the gripper, at most 0.7 mm, from the one that is reached.
SAME_WIDTH_MM = 1.0


def activation_sentence(what: str) -> str:
    """Return a sentence on an activation after a fault; `what` is the object in the gripper."""
    return f"after its fault the gripper is activated again, which opens its fingers, and a tool in it drops; {what}"


@dataclass(frozen=True, slots=True)
class OperatorView:
    """Answers from the control loop's present state; nothing here moves or changes anything.

    `zero_known` says for each source whether its zero is known. `running_experiment` returns it, or None.
    """

    inputs: LatestInputs
    tool: HeldTool
    safety: SafetyMonitor
    sources: Mapping[str, TorqueSource]
    zero_known: Mapping[str, bool]
    running_experiment: Callable[[], Experiment | None]

    def start_refusal(self) -> str | None:
        """Return why no experiment can begin, or None."""
        if (reason := self.running_refusal()) is not None:
            return reason
        if refusing := self.safety.refusing:
            first, *others = refusing
            also = f" Also: {'; '.join(fault.cause for fault in others)}." if others else ""
            return f"{first.sentence}{also}"
        return None

    def running_refusal(self) -> str | None:
        """Return the running experiment as the reason of a refusal, or None."""
        running = self.running_experiment()
        return f"the experiment {running.file.name!r} is running; stop it first" if running is not None else None

    def tare_refusal(self, *, confirmed: bool = False) -> str | None:
        """Return why no zero may be taken at present, or None; `confirmed`: by the operator, nothing is loaded."""
        if (running := self.running_experiment()) is not None:
            return (
                f"the experiment {running.file.name!r} is running, and a new zero would change its "
                "torques; stop it first, or give it a step `tare`"
            )
        if (held := self.tool.held) is not None:
            return f"{held}, and its torque would become the zero; open the gripper first (`shearloop command release`)"
        if self.inputs.gripper is None and self.tool.may_hold():
            return f"{GRIPPED_BEFORE}: wait until it answers"
        if confirmed:
            return None
        if (uncertain := self.tool.uncertain) is not None:
            release = "look, and secure a tool: `shearloop command release --yes` opens the gripper and makes it known"
            return f"{uncertain}; {release}; if it holds nothing, confirm it with `shearloop command tare --yes`"
        if (loaded := self._load()) is not None:
            return f"{loaded.sentence}, which would become the zero; {loaded.cure}"
        if turned := self._turned():
            return f"{turned}, and its load would become the zero; {CONFIRM_TARE}"
        return None

    def why_no_tare_step(self) -> str | None:
        """Return why a step `tare` cannot take a zero at present, or None; no operator confirms a step."""
        if (reason := self.tool.held or self.tool.uncertain) is not None:
            return f"{reason}; put a `release` before it"
        if (loaded := self._load()) is not None:
            cure = "take the load off: turn the tool back, or free it"
            if loaded.may_be_drift:
                cure += "; only if nothing touches the sensor, take the zero before the start: "
                cure += "`shearloop command tare --yes`"
            return f"{loaded.sentence}, which would become the zero; {cure}"
        if turned := self._turned():
            return f"{turned}, and its load would become the zero; {CLAMPED_CURE}"
        return None

    def _load(self) -> SensorLoad | None:
        """Return a sensor's load beyond the usual drift, or None."""
        # A skin without a radius is no source of torques, but has a load.
        uncounted = {name for name, source in self.sources.items() if source.from_robot}
        if self.tool.has_gripper and self.inputs.gripper is not None:
            # Empty fingers of the gripper do not load a fingertip, so its torque is drift.
            uncounted.update(name for name, source in self.sources.items() if source.warm_up_s)
        # Of a sensor that is lost, the last torque says nothing of the present.
        uncounted.update(self.inputs.lost)
        return load_of(latest for name, latest in self.inputs.torques.items() if name not in uncounted)

    def known_tool(self) -> KnownTool:
        """Return the known angle and torque of the tool, and where the wrist stands, at a start."""
        wrist_rad = self.inputs.arm.wrist_rad if self.inputs.arm is not None else None
        loaded, twisted_rad = self.tool.may_be_loaded(), self.tool.twisted_rad
        return known_at_start(loaded=loaded, twisted_rad=twisted_rad, wrist_rad=wrist_rad)

    def _turned(self) -> str:
        """Return how far a clamped tool is turned, which may load the sensors; empty where it is not.

        Its angle says so without an error that adds up. A torque below a load's bound would, from zero to zero.
        """
        angle_rad = self.tool.twisted_rad
        if self.tool.has_gripper or abs(angle_rad) <= UNTURNED_RAD:
            return ""
        return f"the clamped tool is turned by {angle_rad:+.3f} rad"

    def release_refusal(self) -> str | None:
        """Return why the operator cannot open the gripper at present, or None; the state of the arm does not count."""
        if (reason := self.running_refusal()) is not None:
            return reason
        if not self.tool.has_gripper:
            return None
        gripper = self.inputs.gripper
        if gripper is None or "gripper" in self.inputs.lost:
            reason = self.inputs.lost.get("gripper", "it has not answered yet")
            return f"the gripper is not connected: {reason.removesuffix('.')}; `shearloop doctor CONFIG` examines it"
        return None

    def why_another_stop(self, named: int | None) -> str:
        """Return why an unlock names another stop than the one that waits; empty if it names this stop or none.

        So no operator acknowledges a stop that was not shown.
        """
        stop = self.safety.waiting
        if stop is None or named in (None, stop.number):
            return ""
        return f"the stop that waits is not the one that was shown: {stop.causes}"

    def drop_sentence(self, file: ExperimentFile) -> str:
        """Return which step lets go of what the fingers hold now, or may hold; empty if none does."""
        number, what = first_release(file), self.tool.any_object
        if number is None or what is None:
            return ""
        return f"step {number} (release) opens the gripper, and a tool in it drops; {what}"

    def why_not_begun(self, file: ExperimentFile) -> str | None:
        """Return why a tool in the gripper, a silent sensor or an unknown zero forbids an experiment, or None."""
        reason = self._why_no_activation(file) or self._why_no_grip(file) or self._why_no_sensor(file)
        if reason := reason or self._why_no_zero(file):
            return reason
        number, uncertain = first_motion_before_grip(file), self.tool.uncertain
        if number is None:
            return None
        step = file.steps[number - 1]
        straight = isinstance(step, ApproachStep)
        # Limits watch a turn of a held tool, but nothing watches a straight move with it.
        why = uncertain or (f"the gripper is closed: {self.tool.held}" if straight and self.tool.held else None)
        if why is None:
            return None
        motion = f"step {number} ({step.do}), which {'moves the arm' if straight else 'turns the wrist'}"
        return f"{why}; put a `grip` or a `release` before {motion}"

    def _why_no_activation(self, file: ExperimentFile) -> str | None:
        """Return why a gripper that has to be activated refuses a `grip`, or None.

        An activation opens the fingers, and a tool in them drops. Only a release activates.
        """
        first = first_grip(file)
        if first is None or not self.tool.activates:
            return None
        number, _ = first
        held = f"{what}; " if (what := self.tool.any_object) is not None else ""
        if self.inputs.gripper is not None and self.inputs.gripper.too_hot:
            return f"{held}the gripper is too hot for step {number} (grip): let it cool down"
        return (
            f"{held}step {number} (grip) needs an active gripper, and its activation opens the fingers, so that a tool "
            "in them drops: take it out with `shearloop command release --yes`, or put a `release` before it"
        )

    def _why_no_grip(self, file: ExperimentFile) -> str | None:
        """Return why a `grip` before any release would open the fingers on what they hold, or may hold, or None.

        The gripper's task refuses it too, in the middle of the experiment. A later grip is no wider than the first one.
        """
        gripper, first, held = self.inputs.gripper, first_grip(file), self.tool.any_object
        if gripper is None or first is None or held is None:
            return None
        number, step = first
        if step.width_mm <= gripper.width_mm + SAME_WIDTH_MM:
            return None
        return (
            f"{held}; step {number} (grip) to {step.width_mm:g} mm would open them and drop it: put a `release` before "
            "it, or correct `width_mm`"
        )

    def _why_no_sensor(self, file: ExperimentFile) -> str | None:
        """Return which sensors are gone or silent, if a step needs them, or None; as they were at the latest tick.

        A torque that is not valid refuses nothing: it may be valid once a tool is gripped.
        """
        if first_measured(file, holds=self.tool.may_hold()) is None:
            return None
        sensors = (source for source in self.sources.values() if not source.from_robot)
        faults = (source_fault(self.inputs, sensor, self.inputs.ticked_ns) for sensor in sensors)
        missing = [fault for fault in faults if fault is not None and fault.code is not FaultCode.ESTIMATE_INVALID]
        return self.inputs.why_refused(missing, self.inputs.ticked_ns)

    def _why_no_zero(self, file: ExperimentFile) -> str | None:
        """Return why the driving torque needs a zero first, or None: without one, every limit would be wrong."""
        number = first_turn_before_tare(file, holds=self.tool.may_hold())
        if number is None:
            return None
        driving = self.sources[file.torque_source]
        if not driving.needs_zero or self.zero_known.get(driving.name, False):
            return None
        # The command tares only sensors. A step `tare` also tares the robot's wrench.
        command = "" if driving.from_robot else ", or send `shearloop command tare` with nothing gripped"
        tare = "a `release` and a `tare`" if self.tool.may_hold() else "a `tare`"
        return (
            f"no zero of the {driving.name} is known: none was taken since this daemon began, the last tare failed, or "
            "the connection was lost. Its torques and limits may be off by any load: "
            f"put {tare} before step {number} ({file.steps[number - 1].do}){command}"
        )


def release_question(operator: OperatorView) -> str:
    """Return what a release would do, for the operator who confirms it."""
    if not operator.tool.has_gripper:
        present = f"at present {turned}" if (turned := clamped_turn(operator)) else "no angle counts at present"
        from_zero = "the angle of the clamped tool counts from 0 at the next start"
        return f"nothing opens, because no gripper is configured; {from_zero}; {present}"
    gripper = operator.inputs.gripper
    apart = f"its fingers are {gripper.width_mm:.0f} mm apart" if gripper is not None else "its width is unknown"
    what = operator.tool.held or f"the gripper reports no object, and {apart}"
    renewed = "; it is activated first: the fingers open and close once" if operator.tool.activates else ""
    return f"the gripper opens fully, and a tool in it drops; {what}{renewed}"


def unlock_question(operator: OperatorView) -> str:
    """Return what an unlock would drop, for the operator who confirms it; empty if it drops no tool."""
    gripper = operator.inputs.gripper
    if gripper is None or not gripper.fault or not operator.tool.may_hold():
        return ""
    may_hold = f"its fingers are {gripper.width_mm:.1f} mm apart, and may hold a tool"
    return activation_sentence(operator.tool.held or may_hold)


def release_stakes(operator: OperatorView) -> tuple[str, ...]:
    """Return the facts that a confirmation of `release_question` covers; the width varies and is none of them."""
    held = "held" if operator.tool.held is not None else "nothing held"
    renewed = "renewed" if operator.tool.activates else "as it is"
    # An exchanged tool shows as another request, or as another angle.
    gripper, grip = operator.inputs.gripper, operator.tool.grip
    requests = f"{gripper.requested_counts}, {gripper.others_requests} of others" if gripper is not None else "none"
    return held, renewed, requests, f"{grip.force_n} N from {grip.origin_rad} rad"


def clamped_turn(operator: OperatorView) -> str:
    """Return how far a clamped tool is turned, as a sentence; empty if no angle counts."""
    arm, origin_rad = operator.inputs.arm, operator.tool.grip.origin_rad
    if arm is None or origin_rad is None:
        return ""
    return f"it is turned by {arm.wrist_rad - origin_rad:+.3f} rad"
