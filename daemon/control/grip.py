"""The known facts of a grip, and whether the gripper still has this grip."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from shearloop.daemon.control.inputs import GripperStatus

# If the fingers moved further than this since their last known width, they have another object or have lost the grip.
# Two counts of the widest gripper are 1.3 mm.
SAME_WIDTH_MM = 1.5
# A soft tool yields slowly. The width ignores steps of one count, because each change is written to the disk.
FOLLOWED_MM = 0.7


@dataclass(frozen=True, slots=True)
class Grip:
    """A grip; unknown fields are None, and without a grip all are."""

    # The wrist's angle at the grip, and the largest force of the fingers.
    origin_rad: float | None = None
    force_n: float | None = None
    # The latest width with the object between the fingers, and the requested position of the gripper, in counts.
    width_mm: float | None = None
    requested_counts: int | None = None

    @property
    def known(self) -> bool:
        """Whether angle or force of a grip are known."""
        return self.origin_rad is not None or self.force_n is not None

    def why_another(self, gripper: GripperStatus) -> str:
        """Return why the gripper does not have this grip, or an empty string; moving fingers do not show it."""
        if gripper.moving:
            return ""
        if not (gripper.holding or gripper.uncertain or gripper.unfelt):
            return "its fingers hold nothing"
        if self.width_mm is not None and abs(gripper.width_mm - self.width_mm) > SAME_WIDTH_MM:
            return f"its fingers are {gripper.width_mm:.1f} mm apart, and were {self.width_mm:.1f} mm apart then"
        # An activation or a loss of power changes the request too, and an object can stay. So it counts only with
        # an object that is held, or is not felt at this target.
        asked, before = gripper.requested_counts, self.requested_counts
        if (gripper.holding or gripper.unfelt) and None not in (asked, before) and asked != before:
            return f"it was asked for the position {asked} since then, and that grip had {before}"
        return ""

    def pressed(self, gripper: GripperStatus) -> "Grip":
        """Return this grip with the width of the tighter fingers, which press a soft tool together."""
        if self.width_mm is None or not gripper.may_hold:
            return self
        return replace(self, width_mm=min(self.width_mm, gripper.width_mm))

    def followed(self, gripper: GripperStatus) -> "Grip":
        """Return this grip with the width and the position of the gripper's present state.

        A width is first known from an object that is felt: a later grip tightens on that one alone.
        """
        grip = self
        held_on = gripper.unfelt and self.known
        has_width = gripper.holding or (held_on and self.width_mm is not None)
        if has_width and (self.width_mm is None or abs(gripper.width_mm - self.width_mm) > FOLLOWED_MM):
            grip = replace(grip, width_mm=gripper.width_mm)
        if gripper.holding or gripper.moving or held_on:
            grip = replace(grip, requested_counts=gripper.requested_counts)
        return grip


NO_GRIP = Grip()

# Takes the reason why the gripper does not have the grip of an earlier process; empty if it has it.
OnJudged: TypeAlias = Callable[[str], None]
