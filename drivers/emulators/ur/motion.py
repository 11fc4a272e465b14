"""How the emulated arm moves: one object per kind of motion, advanced one control cycle at a time."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from shearloop.drivers.emulators.ur.kinematics import (
    Matrix,
    Vector,
    jacobian,
    link_frames,
    rotation_matrix,
    rotation_vector,
)

# The fastest that the joints of a UR5e turn (data sheet: 180 degrees per second); a linear move that asks for more,
# as it does near a singularity, ends in a protective stop.
JOINT_SPEED_LIMIT_RAD_PER_S = math.pi


class Advanced(NamedTuple):
    """Where the arm is after a cycle."""

    q_rad: Vector
    qd_rad_per_s: Vector
    finished: bool


class PathError(Exception):
    """A path that the arm cannot follow; the controller answers with a protective stop."""


class Motion(Protocol):
    """A motion under way."""

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:
        """Return joints (6,), speeds (6,) and whether the motion is over, one cycle of `dt_s` later."""


@dataclass
class Speed:
    """speedJ: turn towards `target_rad_per_s`, every joint no faster than `acceleration`; never over by itself."""

    target_rad_per_s: Vector
    acceleration_rad_per_s2: float

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:
        """Return the arm one cycle later."""
        step = self.acceleration_rad_per_s2 * dt_s
        qd = qd_rad_per_s + np.clip(self.target_rad_per_s - qd_rad_per_s, -step, step)
        return Advanced(q_rad + 0.5 * (qd + qd_rad_per_s) * dt_s, qd, finished=False)


@dataclass
class Halt:
    """stopJ, stopL, speedStop and the end of a program: slow every joint down to rest."""

    deceleration_rad_per_s2: float

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:
        """Return the arm one cycle later."""
        slowed = Speed(np.zeros(6), self.deceleration_rad_per_s2).advance(q_rad, qd_rad_per_s, dt_s)
        return slowed._replace(finished=not slowed.qd_rad_per_s.any())


@dataclass
class Line:
    """A trapezoid of speed along a length: the clockwork of moveJ and moveL."""

    length: float
    speed: float
    acceleration: float
    done: float = 0.0
    rate: float = 0.0

    def advance(self, dt_s: float) -> float:
        """Return the part of the length covered, 0 to 1, one cycle later."""
        left = self.length - self.done
        self.rate = min(self.speed, self.rate + self.acceleration * dt_s, math.sqrt(2 * self.acceleration * left))
        # The last cycle of a discrete trapezoid would creep for ever.
        if left <= max(self.rate * dt_s, 1e-9):
            self.done, self.rate = self.length, 0.0
        else:
            self.done += self.rate * dt_s
        return 1.0 if self.length <= 0 else self.done / self.length

    @property
    def finished(self) -> bool:
        """Whether the end is reached."""
        return self.done >= self.length


@dataclass
class JointMove:
    """moveJ: straight in joint space; the joint with the longest way has the speed asked for."""

    start_rad: Vector
    target_rad: Vector
    speed: float
    acceleration: float
    line: Line = field(init=False)

    def __post_init__(self) -> None:
        """Lay the way out."""
        self.line = Line(float(np.abs(self.target_rad - self.start_rad).max()), self.speed, self.acceleration)

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:  # noqa: ARG002 - on its own rails
        """Return the arm one cycle later."""
        q = self.start_rad + self.line.advance(dt_s) * (self.target_rad - self.start_rad)
        return _arrived(q) if self.line.finished else Advanced(q, (q - q_rad) / dt_s, finished=False)


@dataclass
class LinearMove:
    """moveL: the tool goes straight, its orientation turning evenly; joints follow by the inverse Jacobian."""

    start: Matrix
    target: Matrix
    speed: float
    acceleration: float
    tool_length_m: float
    line: Line = field(init=False)

    def __post_init__(self) -> None:
        """Lay the way out; a move that only turns is measured in radians."""
        way_m = float(np.linalg.norm(self.target[:3, 3] - self.start[:3, 3]))
        self._turn = rotation_vector(self.start[:3, :3].T @ self.target[:3, :3])
        self.line = Line(way_m if way_m > 1e-6 else float(np.linalg.norm(self._turn)), self.speed, self.acceleration)

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:  # noqa: ARG002 - on its own rails
        """Return the arm one cycle later; `PathError` where no joint speed within the limits follows the line."""
        part = self.line.advance(dt_s)
        frames = link_frames(q_rad, self.tool_length_m)
        here = frames[-1]
        where = self.start[:3, 3] + part * (self.target[:3, 3] - self.start[:3, 3])
        turned = self.start[:3, :3] @ rotation_matrix(part * self._turn)
        error = np.concatenate([where - here[:3, 3], rotation_vector(turned @ here[:3, :3].T)])
        try:
            step = np.linalg.solve(jacobian(frames), error)
        except np.linalg.LinAlgError as singular:
            raise PathError("the line leads through a singularity") from singular
        if np.abs(step).max() > JOINT_SPEED_LIMIT_RAD_PER_S * dt_s:
            raise PathError("the line asks a joint for more than its largest speed")
        return _arrived(q_rad + step) if self.line.finished else Advanced(q_rad + step, step / dt_s, finished=False)


def _arrived(q_rad: Vector) -> Advanced:
    return Advanced(q_rad, np.zeros(6), finished=True)
