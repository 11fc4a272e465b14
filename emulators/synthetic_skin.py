"""A synthetic shear skin: the membrane at finite strain on a finger, pushed or turned by a tool. No I/O, no clock.

The tool touches the skin at `radius_mm` from the wrist's axis, through an elastic contact.
Wrist angle → stretch of contact and membrane in series → shear force → strain of the gauges → resistances.
"""

import math
from random import Random

from shearloop.estimation.skin.membrane import THICK_SECTION, UNSTRETCHED, Membrane

# Real gauges differ, so swapped ones can be recognised.
REST_OHM = (24.6, 25.3)
# A fingertip of elastomer under the tool's edge.
CONTACT_N_PER_MM = 1.0
RADIUS_MM = 15.0
NORMAL_N = 1.0
# The paper's std of the response over an hour; each gauge has half of its variance. The time constant is assumed.
DRIFT_STD, DRIFT_TIME_S = 1.48e-4, 600.0
# The slack gauge's share of the stretched one's change: the 2-D reference at mid-thickness.
SLACK_RATIO = -0.125
# The paper's response to 2 N of normal force alone.
CROSSTALK_PER_N = 1.24e-4 / 2
# Of the balance between contact and membrane: each step leaves at most a third of the error.
TOLERANCE_N, MAX_STEPS = 1e-9, 30


class SyntheticSkin:
    """One skin and the tool on it. Forces in N; positive shear stretches gauge 1."""

    def __init__(
        self,
        *,
        radius_mm: float = RADIUS_MM,
        normal_n: float = NORMAL_N,
        slack_ratio: float = SLACK_RATIO,
        seed: int = 0,
    ) -> None:
        self.membrane = Membrane(THICK_SECTION)
        self.slack_ratio = slack_ratio
        self.radius_mm = radius_mm
        self.normal_n = normal_n
        self.shear_n = 0.0
        self.state = UNSTRETCHED
        self._random = Random(seed)
        self._wander = [self._random.gauss(0.0, DRIFT_STD / math.sqrt(2.0)) for _ in range(2)]

    @property
    def torque_nm(self) -> float:
        """The torque of the shear force about the wrist's axis."""
        return self.shear_n * self.radius_mm * 1e-3

    def push(self, shear_n: float) -> None:
        """Set the shear force."""
        self.shear_n = shear_n
        self.state = self.membrane.step(self.state, shear_n, self.normal_n)

    def turn(self, angle_rad: float) -> float:
        """Turn the tool to an angle, counted from its first contact; return the shear force.

        Contact and membrane stretch together. While the skin sticks only the contact yields.
        """
        way_mm, outer_mm = angle_rad * self.radius_mm, self.membrane.section.outer_radius_mm
        sticking_mm_per_n = 1.0 / CONTACT_N_PER_MM
        slipping_mm_per_n = sticking_mm_per_n + math.pi / 2 * outer_mm * self.membrane.sheet_per_n
        shear_n = self.shear_n
        for _ in range(MAX_STEPS):
            state = self.membrane.step(self.state, shear_n, self.normal_n)
            beyond_mm = way_mm - sticking_mm_per_n * shear_n - outer_mm * self.membrane.turned_rad(state)
            slips = state.net_tension_n != self.state.net_tension_n
            change_n = beyond_mm / (slipping_mm_per_n if slips else sticking_mm_per_n)
            shear_n += change_n
            if abs(change_n) < TOLERANCE_N:
                break
        self.push(shear_n)
        return shear_n

    def press(self, jump_nm: float) -> float:
        """Push the tool so that its torque jumps; return the angle in rad by which that turns it."""
        before_mm = self._way_mm()
        self.push(self.shear_n + jump_nm * 1e3 / self.radius_mm)
        return (self._way_mm() - before_mm) / self.radius_mm

    def _way_mm(self) -> float:
        """Return how far the tool has moved since its first contact."""
        return self.shear_n / CONTACT_N_PER_MM + self.membrane.section.outer_radius_mm * self.membrane.turned_rad(
            self.state
        )

    def rest(self, seconds: float) -> None:
        """Advance the gauges' drift, which stays within the paper's range."""
        keep = math.exp(-seconds / DRIFT_TIME_S)
        std = DRIFT_STD / math.sqrt(2.0) * math.sqrt(1.0 - keep * keep)
        self._wander = [keep * wander + self._random.gauss(0.0, std) for wander in self._wander]

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ now, without measurement noise."""
        response = self.membrane.response(self.state)
        stretched = abs(response) / (1.0 - self.slack_ratio)
        slack = self.slack_ratio * stretched
        changes = (stretched, slack) if response >= 0 else (slack, stretched)
        changes = changes[0] + CROSSTALK_PER_N * self.normal_n, changes[1]
        r1, r2 = (
            rest * (1.0 + change + wander) for rest, change, wander in zip(REST_OHM, changes, self._wander, strict=True)
        )
        return r1, r2
