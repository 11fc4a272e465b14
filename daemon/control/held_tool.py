"""The tool in the gripper, or clamped to the wrist: its grip, its angle, and whether both are known."""

from dataclasses import dataclass, replace
from typing import NamedTuple

from shearloop.daemon.control.experiment_schema import GripStep, Opening
from shearloop.daemon.control.grip import NO_GRIP, Grip, OnJudged
from shearloop.daemon.control.inputs import GripperStatus, LatestInputs
from shearloop.estimation.values import is_another_tool

# Why it is not known yet whether something is held.
GRIPPED_BEFORE = "the gripper has not answered yet, and an earlier daemon had gripped a tool"


class _KnownGrip(NamedTuple):
    """The state before a `grip` step; the fields are as in `HeldTool`."""

    grip: Grip
    is_earlier: bool
    another: str


@dataclass(slots=True)
class HeldTool:
    """The state of the tool; the control loop reports each gripper state, grip, release and start.

    `has_gripper`: our gripper holds the tool. Otherwise the tool is clamped by other means, and its grip has only an
    angle.

    What the answers are, by the gripper's latest state; it is in doubt while its fingers move, and where they stand
    without a sign of an object that may be there. A sentence stands for yes, None for no.

    | answer | no state yet | an object | in doubt | empty |
    |---|---|---|---|---|
    | `held` | no | yes | no | no |
    | `uncertain` | no | no | yes | no |
    | `gripped_tool` | if gripped before | yes | if a grip is known | no |
    | `any_object` | if gripped before | yes | yes; of an inactive gripper that never moved: if a grip is known | no |
    | `may_hold` | if gripped before | yes | yes | no |
    | `is_empty` | no | no | no | yes |
    """

    inputs: LatestInputs
    has_gripper: bool
    # The present grip.
    grip: Grip = NO_GRIP
    # Whether an earlier process closed the fingers. The pendant may have gripped the tool again, to the same width.
    is_earlier: bool = False
    # Why the gripper does not have the last known grip any more.
    another: str = ""
    # The number of known requests of other programs to the gripper. A further one during an experiment is a fault.
    others_requests: int = 0
    # Whether the experiment needs a tool between the fingers.
    expected: bool = False
    # Why a release after a stop did not open the gripper, until the operator acknowledges it.
    release_error: str | None = None
    # Whether the fingers close tighter on a held object. The grip and its angle then continue.
    _tightens: bool = False
    # The state before the present `grip` step, for the case that the step is refused.
    _before_closing: _KnownGrip | None = None
    # Whether the daemon has moved the fingers since the gripper was last known to hold nothing.
    _moved: bool = False
    # Called when the gripper first shows whether it still has the grip of an earlier process.
    _on_judged: OnJudged | None = None

    def restore_grip(self, grip: Grip, on_judged: OnJudged) -> None:
        """Use the grip of an earlier process, until the gripper shows whether it still has this grip."""
        self.grip, self.is_earlier, self._on_judged = grip, True, on_judged

    def restore_clamped(self, origin_rad: float | None) -> None:
        """Use the wrist's angle at which an earlier process began to count the angle of the clamped tool."""
        self.grip = Grip(origin_rad)

    def on_gripper(self, gripper: GripperStatus, *, judges: bool) -> None:
        """Take the gripper's latest state; `judges`: decide whether it still has the grip, as between experiments."""
        self._moved = self._moved and gripper.may_hold
        if self._tightens:
            self.grip = self.grip.pressed(gripper)
        if judges:
            self.judge(gripper)
        if self._on_judged is None:
            self.grip = self.grip.followed(gripper)

    def judge(self, gripper: GripperStatus) -> None:
        """Forget a grip that the gripper does not have any more: the next grip has its own angle."""
        judged = self._on_judged
        why = self.grip.why_another(gripper)
        if gripper.others_requests != self.others_requests:
            self.others_requests = gripper.others_requests
            # The tool may have been exchanged, or gripped tighter.
            why = why or "another program, or the pendant, has commanded it since then"
        if judged is not None and (why or not gripper.moving):
            self._on_judged = None
            judged(why)
        if why and (self.grip.known or judged is not None):
            self.grip, self.another = NO_GRIP, why
        if not (gripper.holding or gripper.moving):
            self.another = ""

    def begin_experiment(self) -> None:
        """Prepare for an experiment; the angle belongs to the grip and continues."""
        gripper = self.inputs.gripper
        # Without our gripper the tool is held by other means. Our gripper may hold a tool already.
        self.expected = not self.has_gripper or (gripper is not None and gripper.holding)
        self._tightens, self._before_closing = False, None

    def count_angle(self, wrist_rad: float) -> float:
        """Return the wrist's angle at which the tool's angle is 0; if no angle counts yet, the present one."""
        if self.grip.origin_rad is None:
            self.grip = replace(self.grip, origin_rad=wrist_rad)
            return wrist_rad
        return self.grip.origin_rad

    @property
    def twisted_rad(self) -> float:
        """How far the wrist has turned since the grip; 0 if no angle counts."""
        arm, origin_rad = self.inputs.arm, self.grip.origin_rad
        return 0.0 if arm is None or origin_rad is None else arm.wrist_rad - origin_rad

    def begin_grip(self, action: GripStep) -> None:
        """Store the state of the tool before the fingers move, and begin a new grip."""
        # If this process dies while the fingers close, the next process finds this force. Fingers that hold nothing do
        # not hold a tool once they open.
        opens_empty = isinstance(action, Opening) and self.is_empty
        force_n = None if opens_empty else max(self.grip.force_n or 0.0, action.force_n)
        self._moved = True
        self._before_closing = _KnownGrip(self.grip, self.is_earlier, self.another)
        self._tightens = not isinstance(action, Opening) and self._has_grip()
        # While the fingers open, their last width on the tool shows whether they have let the tool go.
        keeps_width = self._tightens or isinstance(action, Opening)
        self.grip = Grip(self.grip.origin_rad, force_n, self.grip.width_mm if keeps_width else None)
        self.is_earlier = False
        self.another = ""

    def _has_grip(self) -> bool:
        """Return whether the fingers hold something, or may still hold the tool of the known grip."""
        gripper = self.inputs.gripper
        # An activation opens the fingers before they close.
        if gripper is None or self.activates:
            return False
        was_held = self.grip.width_mm is not None
        return gripper.holding or (was_held and gripper.may_hold)

    def on_grip_ended(self, action: GripStep) -> None:
        """Take the end of a `grip` step; fingers that closed tighter keep the grip and its angle."""
        gripper, arm = self.inputs.gripper, self.inputs.arm
        holding = gripper is not None and gripper.holding
        if isinstance(action, Opening) and not holding:
            self.grip = NO_GRIP
        elif not self._tightens:
            origin_rad = arm.wrist_rad if arm is not None else None
            self.grip = replace(self.grip, origin_rad=origin_rad, force_n=action.force_n)
        self._tightens = False
        # An unexpected object is watched as well.
        self.expected = action.expect_object or holding

    @property
    def was_gripped(self) -> bool:
        """Whether a grip is known, or was before the present `grip` or `release` step."""
        before = self._before_closing
        return (self.grip if before is None else before.grip).force_n is not None

    def on_grip_refused(self) -> None:
        """Restore the grip after the present `grip` step was refused before the fingers moved."""
        if self._before_closing is not None:
            self.grip, self.is_earlier, self.another = self._before_closing
            self._tightens = False

    def on_release_ended(self, error: str | None = None) -> None:
        """Take the end of a release, after a stop or by the operator; `error`: why the gripper did not open."""
        self.release_error = error
        if error is None:
            self.grip = NO_GRIP

    @property
    def held(self) -> str | None:
        """The object between the fingers, with its width and the force of the grip, or None."""
        gripper, force_n = self.inputs.gripper, self.grip.force_n
        if not self.has_gripper or gripper is None or not gripper.holding:
            return None
        known = force_n is not None and gripper.others_requests == self.others_requests
        force = f"with at most {force_n:g} N" if known else "with an unknown force"
        if known and self.is_earlier:
            force += " unless it was gripped again before this daemon began"
        return f"{gripper.fingers}, {force}"

    def why_not_stated(self, stated_mm: float | None) -> str:
        """Return how a width by the maker's figures differs from the tool's stated diameter; empty where it does not.

        The maker's figures are of bare fingers, so the width is no proof of another tool.
        """
        gripper = self.inputs.gripper
        if gripper is None or stated_mm is None or gripper.unmeasured_mm is None:
            return ""
        width = gripper.unmeasured_mm
        if not is_another_tool(stated_mm, width):
            return ""
        return (
            f"the experiment states a tool of {stated_mm:g} mm, and by the maker's figures the gripper's fingers are "
            f"{width.value:.1f} mm apart: either its fingertips make that difference, or it holds another tool; "
            "calibrate the gripper, or correct `tool_mm`"
        )

    @property
    def unknown_grip(self) -> str:
        """Why the present grip is not known; empty if it is known, or if the gripper holds nothing."""
        # Any turn gives a grip an angle, but only a `grip` step gives it a force.
        known = self.grip.force_n is not None
        if self.another or known or self.held is None or self._on_judged is not None:
            return self.another
        return "no experiment of this rig has closed its fingers on it"

    @property
    def uncertain(self) -> str | None:
        """Why the gripper cannot say whether it holds a tool, or None."""
        gripper = self.inputs.gripper
        if not self.has_gripper or gripper is None:
            return None
        if gripper.moving:
            doubt = "are moving"
        elif gripper.uncertain:
            doubt = "stand where a stop, an activation or a lack of power has left them"
        elif gripper.unfelt:
            doubt = "stand at their target, where a tool of that width is not felt"
        else:
            return None
        width = f"{gripper.width_mm:.1f} mm apart"
        return f"the gripper does not know whether it holds a tool: its fingers, {width}, {doubt}"

    @property
    def gripped_tool(self) -> str | None:
        """The object between the fingers, or why the tool of a known grip may still be there; None without both."""
        if self.inputs.gripper is None:
            return GRIPPED_BEFORE if self.may_hold() else None
        if self.held is not None or self.grip.force_n is None:
            return self.held
        return self.uncertain

    @property
    def any_object(self) -> str | None:
        """The object between the fingers, or why one may be there, also if no grip is known; None without both.

        A gripper that was not activated since its power came may hold a tool too. Before it first moves, only a known
        grip speaks for a tool.
        """
        gripper = self.inputs.gripper
        if gripper is None or (gripper.inactive and not self._moved):
            return self.gripped_tool
        return self.held or self.uncertain

    def may_hold(self) -> bool:
        """Return whether the gripper holds something or does not know; a grip of an earlier process counts too."""
        if not self.has_gripper:
            return False
        gripper = self.inputs.gripper
        if gripper is None:
            return self._on_judged is not None or self.grip.force_n is not None
        return gripper.may_hold

    @property
    def is_empty(self) -> bool:
        """Whether our gripper is known to hold nothing; a tool that is held by other means is not known."""
        return self.has_gripper and self.inputs.gripper is not None and not self.may_hold()

    @property
    def may_turn(self) -> bool:
        """Whether a turn of the wrist may turn a tool: one is expected, or the fingers are not known to be empty."""
        return self.expected or self.may_hold()

    def may_be_loaded(self) -> bool:
        """Return whether a tool may load the sensors: a held one, or a clamped one whose angle counts."""
        return self.may_hold() if self.has_gripper else self.grip.origin_rad is not None

    @property
    def awaits_judgement(self) -> bool:
        """Whether the gripper has not shown yet that it still has the grip of an earlier process, or not."""
        return self._on_judged is not None

    @property
    def activates(self) -> bool:
        """Whether the gripper must be activated before its next motion, as after a fault or a loss of power."""
        gripper = self.inputs.gripper
        return gripper is not None and (bool(gripper.fault) or gripper.inactive or gripper.too_hot)
