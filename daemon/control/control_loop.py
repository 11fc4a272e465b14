"""The control loop: decides at every tick on robot and gripper, from experiment, controllers and safety table.

A plain object without I/O or clock: inputs come in, `ControlOutput` go out, and events report their results.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple

from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.experiment import Action, Experiment, ExperimentPhase, Hold, StepCommand, TrackTorque
from shearloop.daemon.control.experiment_check import not_measured, too_noisy
from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    ExperimentFile,
    ExperimentLimits,
    GripStep,
    IdentifyStep,
    Opening,
    Speeds,
    TareStep,
    first_gripper_step,
    first_motion_before_grip,
    first_turn_before_tare,
)
from shearloop.daemon.control.fault_detection import Grasp, Watched, compared_for_s, detect_faults
from shearloop.daemon.control.grip import NO_GRIP, Grip, OnJudged
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus, LatestInputs
from shearloop.daemon.control.safety import Fault, FaultCode, Response, SafetyDecision, SafetyMonitor
from shearloop.daemon.control.torque_controller import WristCommand
from shearloop.daemon.control.wrist_controller import Compute, WristController, at_once
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import CONFIRM_TARE, TorqueSample, TorqueSource, loaded_sentence

# An `adapt` step compares the fingertip with the torques of this time.
ADAPTED_OVER_S = 600.0
# Why nobody knows yet whether something is held.
GRIPPED_BEFORE = "the gripper has not answered yet, and an earlier daemon had gripped a tool"


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """Commands to the devices; `action` and `release` are set for one tick.

    A straight move that is interrupted continues afterwards.
    """

    wrist_rad_per_s: float = 0.0
    ends_motion: bool = False
    interrupts_motion: bool = False
    action: Action | None = None
    release: bool = False


@dataclass(frozen=True, slots=True)
class LoopStatus:
    """State of the loop, for `loop.state`."""

    phase: str
    activity: str
    velocity: WristCommand
    decision: SafetyDecision


class _KnownGrip(NamedTuple):
    """What was known of a grip; the names are those of `_GrippedTool`."""

    grip: Grip
    is_earlier: bool
    another: str


@dataclass(slots=True)
class _GrippedTool:
    """What the loop knows of the tool between the fingers."""

    grip: Grip = NO_GRIP
    # Whether an earlier process has closed it: the pendant may have gripped the same tool again, as far closed.
    is_earlier: bool = False
    # Why the object is of another grip than the last one that was known.
    another: str = ""
    # What was known as the present `grip` step began, which may be refused.
    before_closing: _KnownGrip | None = None
    # When the latest grip, release or tare ended, until each torque has been measured since, or should have been.
    unmeasured_since_ns: int | None = None
    # Whether a tool should be between the fingers.
    expected: bool = False
    # Whether the fingers close tighter on what they hold already: the grip and its angle stay.
    tightens: bool = False
    # A stop has opened the gripper, or why it did not open, until the operator acknowledges it.
    released: bool = False
    release_error: str | None = None


def activation_sentence(what: str) -> str:
    """Return what an activation does after a fault, and to what."""
    return f"after its fault the gripper is activated again, which opens its fingers, and a tool in it drops; {what}"


class ControlLoop:
    """One closed loop: one arm, one gripper, and one of several torques that drives."""

    def __init__(
        self,
        config: LoopConfig,
        sources: Mapping[str, TorqueSource],
        required: tuple[str, ...],
        creep: Mapping[str, Creep] = MappingProxyType({}),
        dead_tasks: Mapping[str, str] = MappingProxyType({}),
        patience: float = 1.0,
        compute: Compute = at_once,
    ) -> None:
        """Take all torque sources by name, the required devices, and the creep of sources that measure shear.

        Each source that measures torque may drive. `dead_tasks` has the error of each task that is dead at present.
        `patience` is the factor on the deadlines, above 1 on an emulated rig alone. `compute` begins a computation that
        would make the loop late.
        """
        kept_s = max(ADAPTED_OVER_S, compared_for_s(sources.values(), config))
        self.inputs = LatestInputs(kept_s=kept_s, died=dead_tasks)
        self.safety = SafetyMonitor(patience)
        self.experiment: Experiment | None = None
        # How many experiments have begun.
        self.runs = 0
        # Requests of other programs to the gripper that are known; one that comes during an experiment is a fault.
        self._others_requests = 0
        self.status = LoopStatus("idle", "", WristCommand(), SafetyDecision(Response.NOTE))
        self.config = config
        self._sources = sources
        self._creep = creep
        self._wrists = {
            name: WristController(source, config, compute) for name, source in sources.items() if source.measures_torque
        }
        # The wrist's controller for the driving torque, and the faults to watch for.
        self.wrist = next(iter(self._wrists.values()))
        self._watched = Watched(
            driving=self.wrist.source,
            supervising=self._others(self.wrist.source),
            limits=ExperimentLimits(),
            required=required,
            patience=patience,
        )
        self._gripped = _GrippedTool()
        # The causes of the latest stop, once it is acknowledged, until the next start.
        self._acknowledged = ""
        # Of a stop after the experiment's end.
        self._later_stop = ""
        # Awaits the gripper's first state that shows whether a grip of an earlier process is the present one.
        self._on_judged: OnJudged | None = None
        # By source: whether its zero is known, which was taken since this process began or is kept from an earlier one.
        # It is not known once it was lost, or asked for and not taken; a source without an entry had neither.
        self._zero_known: dict[str, bool] = {}
        # Faults that were reported since the latest tick.
        self._reported: list[Fault] = []

    @property
    def warm_up_s(self) -> float:
        """The longest time from a grip to the first torque of a source."""
        return max((one.warm_up_s for one in self._sources.values() if one.measures_torque), default=0.0)

    @property
    def running(self) -> Experiment | None:
        """The experiment while it may still move something."""
        return self.experiment if self.experiment is not None and self.experiment.running else None

    def on_torque(self, torque: TorqueSample) -> None:
        """Accept a torque sample from any source."""
        creep = self._creep.get(torque.source)
        if creep is not None and torque.torque_nm is not None:
            torque = replace(torque, torque_nm=creep.torque_nm(torque.torque_nm, torque.t_mid_ns))
        self.inputs.add_torque(torque)
        if (wrist := self._wrists.get(torque.source)) is not None:
            wrist.on_torque(torque)

    def on_zero(self, source: str, *, known: bool = True) -> None:
        """Take that a source's zero is known from now on, or is not."""
        self._zero_known[source] = known

    def on_restored_zero(self, source: str) -> None:
        """Take that an earlier process's zero is of the present grip, unless it was lost since then."""
        self._zero_known.setdefault(source, True)

    def torques_of(self, source: str) -> tuple[Sequence[int], Sequence[float]]:
        """Return the valid torques of a source that are kept: times of measurement in ns, ascending, and N·m."""
        return self.inputs.history.get(source, ([], []))

    def on_arm(self, arm: ArmStatus) -> None:
        """Take a state of the robot."""
        self.inputs.arm = arm

    def on_gripper(self, gripper: GripperStatus) -> None:
        """Take a state of the gripper, unless it is older than the latest one."""
        known, gripped = self.inputs.gripper, self._gripped
        if known is not None and gripper.t_ns < known.t_ns:
            return
        self.inputs.gripper = gripper
        if gripped.tightens:
            gripped.grip = gripped.grip.pressed(gripper)
        if self.running is None:
            self._judge_grip(gripper)
        if self._on_judged is None:
            gripped.grip = gripped.grip.followed(gripper)

    def _judge_grip(self, gripper: GripperStatus) -> None:
        """Forget a grip that the gripper does not have at present: the next one has an angle of its own."""
        gripped, judged = self._gripped, self._on_judged
        why = gripped.grip.why_another(gripper)
        if gripper.others_requests != self._others_requests:
            self._others_requests = gripper.others_requests
            # The tool may have been exchanged, or gripped tighter.
            why = why or "another program, or the pendant, has commanded it since then"
        if judged is not None and (why or not gripper.moving):
            self._on_judged = None
            judged(why)
        if why and (gripped.grip.known or judged is not None):
            gripped.grip, gripped.another = NO_GRIP, why
        if not (gripper.holding or gripper.moving):
            gripped.another = ""

    def on_link(self, device: str, sentence: str, *, up: bool) -> None:
        """Take the return or the loss of a device, with a sentence."""
        if up:
            self.inputs.lost.pop(device, None)
        else:
            self.inputs.lost[device] = sentence
            # What was unplugged or switched off may come back with another zero.
            for name, source in self._sources.items():
                if name == device or (source.from_robot and device == "robot"):
                    self.on_zero(name, known=False)

    def on_recording_error(self, error: str) -> None:
        """Take the present error of the recording; an empty string ends it."""
        self.inputs.recording_error = error

    def on_fault(self, code: FaultCode, detail: str) -> None:
        """Take a fault that no input shows, for the next tick."""
        self._reported.append(Fault(code, detail))

    def on_action_ended(self, error: str | None = None) -> None:
        """Take the end of the present action, and why it failed, if it did."""
        experiment, arm, gripped = self.experiment, self.inputs.arm, self._gripped
        action = experiment.command.action if experiment is not None else None
        if experiment is None or not experiment.end_action(error):
            return
        if error:
            self.safety.stop(Fault(FaultCode.STEP_FAILED, experiment.stop_reason))
            return
        if isinstance(action, AdaptStep) and action.fingertip == self.wrist.source.name:
            # The stiffness was identified with another gain.
            self.wrist.reset()
        if not isinstance(action, TareStep | GripStep):
            return
        if isinstance(action, TareStep):
            for name, source in self._sources.items():
                if source.from_robot:
                    self.on_zero(name)
        # The tool was identified with another zero, or in another grip.
        self._forget_tool()
        gripped.unmeasured_since_ns = arm.t_ns if arm is not None else None
        if isinstance(action, GripStep):
            self._on_grip_ended(action)

    def _on_grip_ended(self, action: GripStep) -> None:
        """Take what the fingers have done; fingers that closed tighter keep the grip and its angle."""
        gripper, arm, gripped = self.inputs.gripper, self.inputs.arm, self._gripped
        holding = gripper is not None and gripper.holding
        if isinstance(action, Opening) and not holding:
            gripped.grip = NO_GRIP
        elif not gripped.tightens:
            origin_rad = arm.wrist_rad if arm is not None else None
            gripped.grip = replace(gripped.grip, origin_rad=origin_rad, force_n=action.force_n)
        gripped.tightens = False
        # An unexpected object is watched as well.
        gripped.expected = action.expect_object or holding

    def on_grip_refused(self) -> None:
        """Take that the present `grip` step was refused before the fingers moved: what they hold is as it was."""
        gripped, before = self._gripped, self._gripped.before_closing
        if before is not None:
            gripped.grip = before.grip
            gripped.is_earlier = before.is_earlier
            gripped.another = before.another
            gripped.tightens = False

    def on_release_ended(self, error: str | None = None) -> None:
        """Take the end of the release after a stop, and why the gripper did not open, if it did not."""
        self._gripped.release_error = error
        if error is None:
            self._gripped.grip = NO_GRIP

    @property
    def has_gripper(self) -> bool:
        """Whether a gripper of ours holds the tool; without one it is clamped by other means."""
        return "gripper" in self._watched.required

    @property
    def grip(self) -> Grip:
        """What is known of the present grip; of a clamped tool the angle alone."""
        return self._gripped.grip

    def restore_grip(self, grip: Grip, on_judged: OnJudged) -> None:
        """Take the grip that a process before this one has closed, until the gripper shows whether it still has it."""
        self._gripped.grip, self._gripped.is_earlier, self._on_judged = grip, True, on_judged

    def restore_clamped(self, origin_rad: float | None) -> None:
        """Take where a process before this one began to count the angle of the clamped tool."""
        self._gripped.grip = Grip(origin_rad)

    @property
    def held(self) -> str | None:
        """The object between the fingers, with its width and the force of the grip, or None."""
        gripper, force_n = self.inputs.gripper, self._gripped.grip.force_n
        if not self.has_gripper or gripper is None or not gripper.holding:
            return None
        known = force_n is not None and gripper.others_requests == self._others_requests
        force = f"with at most {force_n:g} N" if known else "with an unknown force"
        if known and self._gripped.is_earlier:
            force += " unless it was gripped again before this daemon began"
        return f"{gripper.fingers}, {force}"

    @property
    def _unknown_grip(self) -> str:
        """Why the present grip is not known; empty where it is, or where nothing is held."""
        gripped = self._gripped
        # A turn gives a grip an angle, and only a `grip` step its force.
        known = gripped.grip.force_n is not None
        if gripped.another or known or self.held is None or self._on_judged is not None:
            return gripped.another
        return "no experiment of this rig has closed its fingers on it"

    @property
    def may_still_hold(self) -> str | None:
        """The object between the fingers, or why a tool that was gripped may still be there; None without one."""
        if self.inputs.gripper is None:
            return GRIPPED_BEFORE if self.may_hold() else None
        if self.held is not None or self._gripped.grip.force_n is None:
            return self.held
        return self._why_uncertain()

    def may_hold(self) -> bool:
        """Return whether the gripper holds something, or does not know; a grip of an earlier process counts."""
        if not self.has_gripper:
            return False
        gripper = self.inputs.gripper
        if gripper is None:
            return self._on_judged is not None or self._gripped.grip.force_n is not None
        return gripper.holding or gripper.moving or gripper.uncertain

    def release_refusal(self) -> str | None:
        """Return why the operator cannot open the gripper now, or None; the arm is not asked."""
        if (running := self.running) is not None:
            return f"the experiment {running.file.name!r} is running; stop it first"
        if not self.has_gripper:
            return None
        gripper = self.inputs.gripper
        if gripper is None or "gripper" in self.inputs.lost:
            reason = self.inputs.lost.get("gripper", "it has not answered yet")
            return f"the gripper is not connected: {reason.removesuffix('.')}; `shearloop doctor CONFIG` examines it"
        return None

    def release_question(self) -> str:
        """Return what a release does now, for the operator who confirms it."""
        if not self.has_gripper:
            present = f"at present {turned}" if (turned := self._clamped_turn()) else "no angle counts at present"
            anew = "the angle of the clamped tool counts anew from the next start"
            return f"nothing opens, because no gripper is configured; {anew}; {present}"
        gripper = self.inputs.gripper
        apart = f"its fingers are {gripper.width_mm:.0f} mm apart" if gripper is not None else "its width is unknown"
        what = self.held or f"the gripper reports no object, and {apart}"
        renewed = "; it is activated first: the fingers open and close once" if self._activates() else ""
        return f"the gripper opens fully, and a tool in it drops; {what}{renewed}"

    def unlock_question(self) -> str:
        """Return what an unlock drops, for the operator who confirms it; empty where it opens no fingers on a tool."""
        gripper = self.inputs.gripper
        if gripper is None or not gripper.fault or not self.may_hold():
            return ""
        return activation_sentence(self.held or f"its fingers are {gripper.width_mm:.1f} mm apart, and may hold a tool")

    def release_stakes(self) -> tuple[str, ...]:
        """Return what a confirmation of `release_question` depends on; a width that wavers is not part of it."""
        held = "held" if self.held is not None else "nothing held"
        renewed = "renewed" if self._activates() else "as it is"
        # A tool that was exchanged is held by another request, or from another angle.
        gripper, grip = self.inputs.gripper, self._gripped.grip
        requests = f"{gripper.requested_counts}, {gripper.others_requests} of others" if gripper is not None else "none"
        return held, renewed, requests, f"{grip.force_n} N from {grip.origin_rad} rad"

    def _activates(self) -> bool:
        """Whether the gripper is activated before its next motion, as after a fault or a loss of power."""
        gripper = self.inputs.gripper
        return gripper is not None and (bool(gripper.fault) or gripper.inactive or gripper.too_hot)

    def activation_note(self, file: ExperimentFile) -> str:
        """Return what the first step with the gripper does besides, for the operator who starts; or an empty string."""
        first = first_gripper_step(file)
        if first is None or not self._activates() or not self.may_hold():
            return ""
        return f" Before step {first[0]} the gripper is activated: its fingers open and close once, and a tool drops."

    def _clamped_turn(self) -> str:
        """Return how far a clamped tool is turned, as a sentence; empty where no angle counts."""
        arm, origin_rad = self.inputs.arm, self._gripped.grip.origin_rad
        if arm is None or origin_rad is None:
            return ""
        return f"it is turned by {arm.wrist_rad - origin_rad:+.3f} rad"

    def held_note(self, file: ExperimentFile) -> str:
        """Return what is held as an experiment begins to turn it, for the operator's question; or an empty string."""
        if not self.has_gripper:
            turned = self._clamped_turn()
            anew = "if another tool is clamped, `shearloop command release --yes` lets its angle count anew"
            return f" At present the clamped tool's angle counts on: {turned}; {anew}." if turned else ""
        held, unknown, first = self.held, self._unknown_grip, first_gripper_step(file)
        # A `grip` closes tighter on what is held, and its angle stays as unknown as it is.
        turns = first_motion_before_grip(file) is not None
        turns = turns or bool(unknown and first is not None and isinstance(first[1], GripStep))
        if held is None or not turns:
            return ""
        angle = f" The grip is not known ({unknown}): its angle counts from the start." if unknown else ""
        return f" At present {held}.{angle}"

    def _why_no_activation(self, file: ExperimentFile) -> str | None:
        """Return why an experiment must not activate the gripper, or None: its grip would drop what is held."""
        first, held = first_gripper_step(file), self.may_still_hold
        if first is None or not isinstance(first[1], GripStep) or not self._activates() or held is None:
            return None
        if self.inputs.gripper is not None and self.inputs.gripper.too_hot:
            return f"{held}; the gripper is too hot for step {first[0]} (grip): let it cool down"
        return (
            f"{held}; step {first[0]} (grip) would activate the gripper first, which opens its fingers, and the tool "
            "drops: take it out with `shearloop command release --yes`, or put a `release` before it"
        )

    def _why_no_grip(self, file: ExperimentFile) -> str | None:
        """Return why the first `grip` would open the fingers on what they hold, or None."""
        first, gripper, held = first_gripper_step(file), self.inputs.gripper, self.held
        if first is None or gripper is None or held is None:
            return None
        number, step = first
        if not isinstance(step, GripStep) or step.width_mm <= gripper.width_mm:
            return None
        return (
            f"{held}; step {number} (grip) to {step.width_mm:g} mm would open them and drop it: put a `release` before "
            "it, or correct `width_mm`"
        )

    def _why_no_zero(self, file: ExperimentFile, driving: TorqueSource) -> str | None:
        """Return why no tool can be turned by a torque without a zero, or None: every limit would be off by it."""
        number = first_turn_before_tare(file, holds=self.may_hold())
        if number is None or not driving.needs_zero or self.has_zero(driving.name):
            return None
        # A command tares sensors, and an experiment the robot's wrench, too.
        command = "" if driving.from_robot else ", or send `shearloop command tare` with nothing gripped"
        tare = "a `release` and a `tare`" if self.may_hold() else "a `tare`"
        return (
            f"no zero of the {driving.name} is known since this daemon began, so that its torques and limits may be "
            f"off by any load: put {tare} before step {number} ({file.steps[number - 1].do}){command}"
        )

    def has_zero(self, source: str) -> bool:
        """Return whether a source's zero was taken since this process began, or is kept from the one before."""
        return self._zero_known.get(source, False)

    def tare_refusal(self, *, confirmed: bool = False) -> str | None:
        """Return why no zero may be taken now, or None; `confirmed`: the operator says that nothing is loaded."""
        if (running := self.running) is not None:
            return (
                f"the experiment {running.file.name!r} is running, and a new zero would change its "
                "torques; stop it first, or give it a step `tare`"
            )
        if (held := self.held) is not None:
            return f"{held}, and its torque would become the zero; open the gripper first (`shearloop command release`)"
        if self.inputs.gripper is None and self.may_hold():
            return f"{GRIPPED_BEFORE}: wait until it answers"
        if confirmed:
            return None
        if (uncertain := self._why_uncertain()) is not None:
            return f"{uncertain}; {CONFIRM_TARE}"
        if loaded := self._loaded():
            return f"{loaded}, which would become the zero; {CONFIRM_TARE}"
        return None

    def _why_no_tare_step(self) -> str | None:
        """Return why an experiment cannot take a zero now, or None: nobody is there to confirm it."""
        if (reason := self.held or self._why_uncertain()) is not None:
            return f"{reason}; put a `release` before it"
        if loaded := self._loaded():
            cure = "if nothing is loaded, `shearloop command tare --yes` takes the zero before the start"
            return f"{loaded}, which would become the zero; take the load off ({cure})"
        return None

    def _loaded(self) -> str:
        """Return which sensor measures a load that does not come from its drift, or an empty string."""
        # Fingers that are known to be empty do not load a fingertip: its torque is drift.
        empty = self.has_gripper and self.inputs.gripper is not None
        judged = {
            name: latest.torque_nm
            for name, latest in self.inputs.torques.items()
            if not self._sources[name].from_robot and not (empty and self._sources[name].warm_up_s)
        }
        return loaded_sentence(judged)

    def start_refusal(self) -> str | None:
        """Return why no experiment at all can begin, or None."""
        if (running := self.running) is not None:
            return f"the experiment {running.file.name!r} is still running; stop it first"
        if self.safety.stopped:
            first, *others = self.safety.stop_faults
            also = f" Also: {'; '.join(fault.cause for fault in others)}." if others else ""
            return f"{first.sentence}{also}"
        return None

    def start(self, file: ExperimentFile, t_ns: int) -> str | None:
        """Begin an experiment; return None, or why it cannot begin."""
        if (reason := self.start_refusal()) is not None:
            return reason
        if self.inputs.gripper is not None:
            # What other programs asked for before the start is no fault of this experiment.
            self._judge_grip(self.inputs.gripper)
        if (reason := self._why_no_source(file)) is not None:
            return reason
        driving = self._sources[file.torque_source]
        watched = replace(self._watched, driving=driving, supervising=self._others(driving), limits=file.limits)
        faults = detect_faults(self.inputs, watched, self.config, t_ns)
        refusals = [fault.sentence for fault in faults if fault.rule.response >= Response.REFUSE_START]
        if refusals:
            return " ".join(refusals)
        if (reason := self._why_not_with_tool(file)) is not None:
            return reason
        if self._on_judged is not None:
            return "the fingers move, and an earlier daemon had gripped a tool: wait until they stand still"
        speeds = Speeds(wrist_rad_per_s=self.config.wrist_speed_rad_per_s)
        self.experiment, self._watched = Experiment(file, t_ns, speeds), watched
        self.wrist = self._wrists[file.torque_source]
        # What the last experiment knew of the tool may be wrong by now.
        self.wrist.reset()
        self._gripped = self._gripped_at_start(t_ns)
        self._acknowledged = self._later_stop = ""
        self.runs += 1
        # Until the first tick, the status must not show the end of the previous run.
        phase, activity = self.experiment.phase.value, self.experiment.command.activity
        self.status = LoopStatus(phase, activity, WristCommand(), SafetyDecision(Response.NOTE))
        return None

    def file_refusal(self, file: ExperimentFile) -> str | None:
        """Return why this experiment cannot begin with the tool and the zeros of now, or None."""
        if (reason := self._why_no_source(file) or self._why_not_with_tool(file)) is not None:
            return reason
        if isinstance(file.steps[0], TareStep) and (reason := self._why_no_tare_step()) is not None:
            return f"step 1 (tare): {reason}"
        return None

    def _why_no_source(self, file: ExperimentFile) -> str | None:
        if file.torque_source not in self._wrists:
            known = ", ".join(self._wrists)
            return f"`torque_source: {file.torque_source}` is not a measured torque; choose one of {known}"
        driving = self._sources[file.torque_source]
        if driving.noise_nm >= file.tightest_nm:
            return too_noisy(driving.name, driving.noise_nm, file.tightest_nm)
        unmeasured = next(not_measured(file, driving), None)
        if unmeasured is not None:
            place, why_not = unmeasured
            return f"step {place + 1}: {why_not}"
        return None

    def _why_not_with_tool(self, file: ExperimentFile) -> str | None:
        """Return why the tool that is held, or may be, forbids an experiment, or its torque's zero does."""
        driving = self._sources[file.torque_source]
        if reason := self._why_no_activation(file) or self._why_no_grip(file) or self._why_no_zero(file, driving):
            return reason
        number, uncertain = first_motion_before_grip(file), self._why_uncertain()
        if number is None:
            return None
        step = file.steps[number - 1]
        straight = isinstance(step, ApproachStep)
        # The limits watch a turn of a held tool. Nothing watches what a straight move does to it.
        why = uncertain or (f"the gripper is closed: {self.held}" if straight and self.held else None)
        if why is None:
            return None
        motion = f"step {number} ({step.do}), which {'moves the arm' if straight else 'turns the wrist'}"
        return f"{why}; put a `grip` or a `release` before {motion}"

    def _gripped_at_start(self, t_ns: int) -> _GrippedTool:
        """Return what is known of the tool as an experiment begins."""
        before, gripper = self._gripped, self.inputs.gripper
        return _GrippedTool(
            # The angle belongs to the grip. The gripper's latest state has shown whether it is another one.
            grip=before.grip,
            is_earlier=before.is_earlier,
            another=before.another,
            unmeasured_since_ns=t_ns,
            # Without a gripper of ours the tool is held by other means; with one, it may hold a tool already.
            expected=not self.has_gripper or (gripper is not None and gripper.holding),
            release_error=before.release_error,
        )

    def pause(self) -> str | None:
        """Stand still until `resume`; return None, or why not."""
        return self.experiment.pause() if self.experiment is not None else "no experiment is running"

    def resume(self) -> str | None:
        """Continue after `pause`; return None, or why not."""
        return self.experiment.resume() if self.experiment is not None else "no experiment is paused"

    def stop(self, reason: str, fault: Fault) -> None:
        """End the experiment, if one runs, and stand still until the operator acknowledges the stop."""
        self.safety.stop(fault)
        if self.running is None:
            self._later_stop = reason
        elif self.experiment is not None:
            self.experiment.stop(reason)

    def acknowledge(self) -> None:
        """Clear a stop on the operator's command."""
        self._gripped.release_error = None
        self._later_stop = ""
        if self.safety.stopped:
            causes = "; ".join(fault.cause for fault in self.safety.stop_faults)
            self._acknowledged = f"the stop is acknowledged; its cause was: {causes}"
        self.safety.acknowledge()

    def tick(self, t_ns: int, late_s: float = 0.0, sent_rad_per_s: float | None = None) -> ControlOutput:
        """Return the commands for now; the loop is `late_s` late.

        `sent_rad_per_s` is the wrist speed that the worker accepted last, None while it has not answered.
        """
        if sent_rad_per_s is not None:
            self.wrist.sent(sent_rad_per_s)
        running, arm, gripped = self.running, self.inputs.arm, self._gripped
        self.inputs.late_s = late_s
        watched = self._watched
        if self.experiment is not None:
            watched = replace(watched, limits=self.experiment.limits)
        if running is not None:
            command, controller, origin_rad = running.command, self.wrist.controller, gripped.grip.origin_rad
            grasp = Grasp.HELD if gripped.expected else Grasp.NONE
            grasp = Grasp.CHANGING if isinstance(command.action, GripStep) else grasp
            needed = grasp is Grasp.HELD and _turns(command) and not self._awaited_torques(running, t_ns)
            runs = running.phase is ExperimentPhase.RUNNING
            watched = replace(
                watched,
                grasp=grasp,
                torque_needed=needed and runs,
                twisted_rad=0.0 if arm is None or origin_rad is None else arm.wrist_rad - origin_rad,
                expected_nm=controller.torque_nm if controller is not None else None,
                not_following=controller.filter.not_following if controller is not None and runs else "",
                overdue=running.overdue,
                others_requests=self._others_requests,
            )
        found = [*detect_faults(self.inputs, watched, self.config, t_ns), *self._reported]
        self._reported.clear()
        self.inputs.unjudged.clear()
        if gripped.release_error is not None:
            found.append(Fault(FaultCode.NOT_RELEASED, gripped.release_error))
        if running is None:
            # Nothing moves: faults are reported, and only a stop of an experiment waits for the operator.
            if self.safety.stopped and (gripped_still := self.may_still_hold) is not None:
                found.append(Fault(FaultCode.TOOL_GRIPPED, gripped_still))
            if unknown := self._unknown_grip:
                found.append(Fault(FaultCode.GRIP_UNKNOWN, unknown))
            if arm is not None and arm.enabled_by_start:
                found = [fault for fault in found if fault.code is not FaultCode.ROBOT_BLOCKED]
            return self._ended(self.safety.report(found))
        decision = self.safety.judge(found, t_ns)
        if decision.response >= Response.STOP_AND_KEEP_GRIP:
            running.stop(" ".join(decision.reasons))
        if arm is None or decision.response >= Response.STOP_AND_KEEP_GRIP:
            return self._ended(decision)
        return self._run_step(running, decision, arm.wrist_rad, t_ns)

    def _others(self, driving: TorqueSource) -> tuple[TorqueSource, ...]:
        return tuple(source for source in self._sources.values() if source is not driving)

    def _why_uncertain(self) -> str | None:
        """Return why the gripper cannot say whether it holds a tool, or None."""
        hand = self.inputs.gripper
        if not self.has_gripper or hand is None or not (hand.uncertain or hand.moving):
            return None
        doubt = "are moving" if hand.moving else "stand where a stop, an activation or a lack of power has left them"
        return f"the gripper does not know whether it holds a tool: its fingers, {hand.width_mm:.1f} mm apart, {doubt}"

    def _run_step(self, experiment: Experiment, decision: SafetyDecision, wrist_rad: float, t_ns: int) -> ControlOutput:
        """Let the experiment choose its command, and the wrist's controller a speed."""
        wrist, gripped, held = self.wrist, self._gripped, decision.response is Response.HOLD
        origin_rad = wrist_rad if gripped.grip.origin_rad is None else gripped.grip.origin_rad
        gripped.grip = replace(gripped.grip, origin_rad=origin_rad)
        latest = self.inputs.torques.get(experiment.file.torque_source)
        torque_nm = latest.torque_nm if latest is not None and not held else None
        stands = held or self._awaited_torques(experiment, t_ns) is not None
        experiment.update(t_ns, wrist_rad - origin_rad, torque_nm, gripped_at_rad=origin_rad, held=stands)
        command = experiment.command
        # A tool that the gripper holds is watched. After a stop, the gripper's doubt may arrive only now.
        if _turns(command) and not gripped.expected and (uncertain := self._why_uncertain()):
            self._fail(experiment, f"{uncertain}; put a `grip` or a `release` before it")
        awaited = self._awaited_torques(experiment, t_ns)
        still = held or awaited is not None or experiment.phase is ExperimentPhase.PAUSED
        limit_nm = experiment.limits.torque_nm
        if isinstance(command.wrist, TrackTorque) and not still and not wrist.tracks(command.wrist, limit_nm):
            reason = wrist.close_loop(command.wrist, t_ns, wrist_rad, limit_nm)
            if reason:
                self._fail(experiment, reason)
        if not experiment.running:
            return self._ended(self.safety.report(decision.faults))
        action = command.action if command.action is not None and not still and experiment.begin_action() else None
        if isinstance(action, TareStep) and (reason := self._why_no_tare_step()) is not None:
            self._fail(experiment, reason)
            return self._ended(self.safety.report(decision.faults))
        if isinstance(action, GripStep):
            self._begin_grip(action, origin_rad)
        if isinstance(action, IdentifyStep):
            wrist.begin_identification(action, limit_nm)
            action = None
        if still:
            velocity = wrist.hold()
        elif isinstance(command.action, IdentifyStep) and (excitation := wrist.excitation) is not None:
            velocity = wrist.identify(excitation, t_ns, wrist_rad)
            if excitation.done:
                self.on_action_ended(excitation.failure)
                if not experiment.running:
                    return self._ended(self.safety.report(decision.faults))
        else:
            velocity = wrist.turn(command.wrist, t_ns, wrist_rad, origin_rad)
        phase = "held" if held else experiment.phase.value
        self.status = LoopStatus(phase, awaited or experiment.command.activity, velocity, decision)
        return ControlOutput(velocity.speed_rad_per_s, interrupts_motion=still, action=action)

    def _begin_grip(self, action: GripStep, origin_rad: float) -> None:
        """Note what is known of the tool as the fingers begin to move."""
        gripped = self._gripped
        # A process that dies while the fingers close leaves this force behind.
        force_n = max(gripped.grip.force_n or 0.0, action.force_n)
        gripped.before_closing = _KnownGrip(gripped.grip, gripped.is_earlier, gripped.another)
        gripped.tightens = not isinstance(action, Opening) and self._has_grip()
        # While fingers open, their last width on the tool tells whether they have let it go.
        width_mm = gripped.grip.width_mm if gripped.tightens or isinstance(action, Opening) else None
        gripped.grip = Grip(origin_rad, force_n, width_mm)
        gripped.is_earlier = False
        gripped.another = ""

    def _has_grip(self) -> bool:
        """Return whether the fingers hold something, or may still hold it in the grip that is known."""
        gripper = self.inputs.gripper
        # An activation opens the fingers before they close.
        if gripper is None or self._activates():
            return False
        was_held = self._gripped.grip.width_mm is not None
        return gripper.holding or (was_held and (gripper.uncertain or gripper.moving))

    def _awaited_torques(self, experiment: Experiment, t_ns: int) -> str | None:
        """Return which torques a step that turns the tool waits for after a grip or a tare, or None.

        An estimator needs some frames of the new grip; a source without a torque after its `warm_up_s` is a fault.
        """
        since_ns = self._gripped.unmeasured_since_ns
        if since_ns is None or not (self._gripped.expected and _turns(experiment.command)):
            return None
        awaited, reason = [], ""
        for name, source in self._sources.items():
            latest = self.inputs.torques.get(name)
            measured = latest is not None and latest.torque_nm is not None and latest.t_mid_ns >= since_ns
            due = t_ns - since_ns < source.warm_up_s * 1e9 and name not in self.inputs.lost
            if due and source.measures_torque and not measured:
                awaited.append(name)
                reason = latest.reason if latest is not None else ""
        if not awaited:
            self._gripped.unmeasured_since_ns = None
            return None
        return f"waiting for the first torque of {', '.join(awaited)}{f': {reason}' if reason else ''}"

    def _fail(self, experiment: Experiment, reason: str) -> None:
        """End an experiment with a step that cannot be done; the stop waits for the operator, as each stop does."""
        experiment.fail(reason)
        self.safety.stop(Fault(FaultCode.STEP_FAILED, experiment.stop_reason))

    def _forget_tool(self) -> None:
        self.wrist.reset()
        for creep in self._creep.values():
            creep.reset()

    def _ended(self, decision: SafetyDecision) -> ControlOutput:
        experiment = self.experiment
        phase = experiment.phase.value if experiment is not None else "idle"
        reason = experiment.stop_reason if experiment is not None else ""
        if self._later_stop:
            reason = self._later_stop
        elif experiment is not None and experiment.phase is ExperimentPhase.STOPPED and not self.safety.stopped:
            reason = self._acknowledged or reason
        self.status = LoopStatus(phase, reason, WristCommand(), decision)
        release = decision.response is Response.STOP_AND_RELEASE and not self._gripped.released
        self._gripped.released |= release
        return ControlOutput(ends_motion=True, release=release)


def _turns(command: StepCommand) -> bool:
    return not isinstance(command.wrist, Hold) or isinstance(command.action, IdentifyStep)
