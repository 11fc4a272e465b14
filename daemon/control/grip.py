"""What is known of a grip, and whether the gripper still has it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from shearloop.daemon.control.inputs import GripperStatus

# Fingers that moved further since their last known width have another object between them, or have lost the grip. Two
# counts of the widest gripper are 1.3 mm.
SAME_WIDTH_MM = 1.5
# A soft tool gives way slowly. A step of one count is not followed, because each change is written to the disk.
FOLLOWED_MM = 0.7


@dataclass(frozen=True, slots=True)
class Grip:
    """A grip; None for what is not known, and nothing known without a grip."""

    # The wrist's angle at the grip, and the largest force of the fingers.
    origin_rad: float | None = None
    force_n: float | None = None
    # The latest width with the object between the fingers, and the position that the gripper was asked for, in counts.
    width_mm: float | None = None
    requested_counts: int | None = None

    @property
    def known(self) -> bool:
        """Whether angle or force of a grip are known."""
        return self.origin_rad is not None or self.force_n is not None

    def why_another(self, gripper: GripperStatus) -> str:
        """Return why the gripper's state is not of this grip, or an empty string. Fingers that move show nothing."""
        if gripper.moving:
            return ""
        if not (gripper.holding or gripper.uncertain):
            return "its fingers hold nothing"
        if self.width_mm is not None and abs(gripper.width_mm - self.width_mm) > SAME_WIDTH_MM:
            return f"its fingers are {gripper.width_mm:.1f} mm apart, and were {self.width_mm:.1f} mm apart then"
        # An activation or a loss of power changes it, and leaves an object where it is.
        asked, before = gripper.requested_counts, self.requested_counts
        if gripper.holding and None not in (asked, before) and asked != before:
            return f"somebody asked it for the position {asked} since then; that grip had {before}"
        return ""

    def pressed(self, gripper: GripperStatus) -> "Grip":
        """Return this grip with the width of fingers that close tighter: they press a soft tool together."""
        if self.width_mm is None or not (gripper.moving or gripper.uncertain or gripper.holding):
            return self
        return replace(self, width_mm=min(self.width_mm, gripper.width_mm))

    def followed(self, gripper: GripperStatus) -> "Grip":
        """Return this grip with what the gripper's present state shows of it."""
        grip = self
        if gripper.holding and (self.width_mm is None or abs(gripper.width_mm - self.width_mm) > FOLLOWED_MM):
            grip = replace(grip, width_mm=gripper.width_mm)
        if gripper.holding or gripper.moving:
            grip = replace(grip, requested_counts=gripper.requested_counts)
        return grip


NO_GRIP = Grip()

# Takes why a grip of an earlier process is not the present one; an empty string where it is.
OnJudged: TypeAlias = Callable[[str], None]
