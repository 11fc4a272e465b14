"""Kinematics of a UR5e, and the emulated arm with its motions, one control cycle at a time.

The Denavit-Hartenberg table is Universal Robots' own ("DH Parameters for calculations of kinematics and dynamics").
Poses are UR's: position and rotation vector of the flange.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.load_cell_calibration import STANDARD_GRAVITY

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

A_M = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
D_M = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
ALPHA_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
# Elbow up, the tool pointing straight down.
HOME_RAD = np.array([0.0, -1.0, 1.0, -1.0, -1.0, 0.0]) * (math.pi / 2)
# Data sheet of the UR5e: 180 degrees per second. A straight move that needs more, near a singularity, ends in a
# protective stop.
JOINT_SPEED_LIMIT_RAD_PER_S = math.pi
# UR's forum: a CB3 estimates forces to ± 10 N and ± 5 N·m. Data sheet of the UR5e: its sensor's precision is 3.5 N and
# 0.2 N·m. The components, so that their norm is within that.
CURRENTS_ERROR = np.array([10.0, 10.0, 10.0, 5.0, 5.0, 5.0]) / math.sqrt(3)
SENSOR_ERROR = np.array([3.5, 3.5, 3.5, 0.2, 0.2, 0.2]) / math.sqrt(3)
# The axes after x, y and z, and those after them.
_NEXT, _AFTER_NEXT = [1, 2, 0], [2, 0, 1]


def link_frames(q_rad: Vector) -> list[Matrix]:
    """Return the seven frames (4, 4) from the base to the flange, in base coordinates."""
    frames = [np.eye(4)]
    for theta, a, d, alpha in zip(q_rad, A_M, D_M, ALPHA_RAD, strict=True):
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        link = np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
        frames.append(frames[-1] @ link)
    return frames


def tool_frames(q_rad: Vector, tool: Matrix) -> list[Matrix]:
    """Return the frames of `link_frames`, with the tool centre point's in the place of the flange's."""
    frames = link_frames(q_rad)
    frames[-1] = frames[-1] @ tool
    return frames


def frame_of_pose(pose: Sequence[float] | Vector) -> Matrix:
    """Return the frame (4, 4) of a pose (6,): position and rotation vector."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation_matrix(pose[3:]), pose[:3]
    return frame


def _pose_of_frame(frame: Matrix) -> Vector:
    """Return the pose (6,) of a frame (4, 4)."""
    return np.array([*frame[:3, 3].tolist(), *rotation_vector(frame[:3, :3])])


def rotation_matrix(vector: Sequence[float] | Vector) -> Matrix:
    """Return the rotation (3, 3) by a rotation vector (3,) in rad (Rodrigues' formula)."""
    x, y, z = map(float, vector)
    angle_rad = math.hypot(x, y, z)
    # sin(a)/a and (1 − cos(a))/a² are 1 and 1/2 at 0.
    sine = math.sin(angle_rad) / angle_rad if angle_rad else 1.0
    versine = 2.0 * (math.sin(angle_rad / 2) / angle_rad) ** 2 if angle_rad else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sine * cross + versine * (cross @ cross))


def rotation_vector(rotation: Matrix) -> tuple[float, float, float]:
    """Return the rotation vector of a rotation (3, 3): SciPy's number in little time.

    By way of the quaternion, from its largest component (Shepperd's method), with a positive real part.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    trace = xx + yy + zz
    largest = max(xx, yy, zz, trace)
    if largest == xx:
        x, y, z, w = 1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz
    elif largest == yy:
        x, y, z, w = yx + xy, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx
    elif largest == zz:
        x, y, z, w = zx + xz, zy + yz, 1.0 - trace + 2.0 * zz, yx - xy
    else:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1.0 + trace
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    if (w, x, y, z) < (0.0, 0.0, 0.0, 0.0):
        x, y, z, w = -x, -y, -z, -w
    angle_rad = 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), w)
    if angle_rad <= 1e-3:
        # angle / sin(angle / 2) as a series.
        square = angle_rad * angle_rad
        factor = 2.0 + square / 12.0 + 7.0 * square * square / 2880.0
    else:
        factor = angle_rad / math.sin(angle_rad / 2.0)
    return factor * x, factor * y, factor * z


def joints_within(
    lower_rad: Sequence[float],
    upper_rad: Sequence[float],
    lower_m: Sequence[float],
    upper_m: Sequence[float],
    tcp_offset: Sequence[float],
) -> Vector | None:
    """Return joints (6,) near HOME_RAD with the tool centre point inside a box; None if the arm cannot reach it.

    The tool keeps its direction. The point keeps a quarter of the box from each face, or as far as HOME_RAD is.
    """
    # It takes long to import, and an emulated rig needs it in a given workspace only.
    from scipy.optimize import least_squares

    tool = frame_of_pose(tcp_offset)
    box, home = np.array([lower_m, upper_m]), tool_frames(HOME_RAD, tool)[-1]
    quarter = (box[1] - box[0]) / 4
    target = np.clip(home[:3, 3], box[0] + quarter, box[1] - quarter)

    def error(q_rad: Vector) -> Vector:
        frame = tool_frames(q_rad, tool)[-1]
        return np.concatenate([frame[:3, 3] - target, frame[:3, 2] - home[:3, 2]])

    low, high = np.asarray(lower_rad), np.asarray(upper_rad)
    found = least_squares(error, np.clip(HOME_RAD, low, high), bounds=(low, high)).x
    return np.asarray(found) if float(np.abs(error(found)).max()) < 1e-3 else None


def jacobian(frames: list[Matrix]) -> Matrix:
    """Return the geometric Jacobian (6, 6): joint speeds to the tool's linear and angular velocity in the base."""
    axes = np.array([frame[:3, 2] for frame in frames[:-1]])
    arms = frames[-1][:3, 3] - np.array([frame[:3, 3] for frame in frames[:-1]])
    # As np.cross(axes, arms), in little time.
    crossed = axes[:, _NEXT] * arms[:, _AFTER_NEXT] - axes[:, _AFTER_NEXT] * arms[:, _NEXT]
    return np.hstack([crossed, axes]).T


# The arm after a cycle: joints (6,), speeds (6,), and whether the motion is over.
Advanced: TypeAlias = tuple[Vector, Vector, bool]


class PathError(Exception):
    """A path that the arm cannot follow; the controller answers with a protective stop."""


@dataclass
class Speed:
    """speedJ: turn towards `target_rad_per_s`, each joint within `acceleration`; `halts`: it is over at rest."""

    target_rad_per_s: Vector
    acceleration_rad_per_s2: float
    halts: bool = False
    # No joint gets slower than at this rate, (6,); finite with worn brakes.
    braking_rad_per_s2: Vector = field(default_factory=lambda: np.full(6, math.inf))

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:
        """Return the arm one cycle later."""
        slower = np.abs(self.target_rad_per_s) < np.abs(qd_rad_per_s)
        largest = np.minimum(self.acceleration_rad_per_s2, np.where(slower, self.braking_rad_per_s2, math.inf))
        step = largest * dt_s
        qd = qd_rad_per_s + np.clip(self.target_rad_per_s - qd_rad_per_s, -step, step)
        return q_rad + 0.5 * (qd + qd_rad_per_s) * dt_s, qd, self.halts and not qd.any()


@dataclass
class LinearMove:
    """moveL: the tool goes straight and turns evenly, with a trapezoid of speed; joints by the inverse Jacobian."""

    start: Matrix
    target: Matrix
    speed: float
    acceleration: float
    # From the flange to the tool centre point.
    tool: Matrix = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        """Compute the length; a move that only turns is measured in radians."""
        way_m = float(np.linalg.norm(self.target[:3, 3] - self.start[:3, 3]))
        self._turn = np.array(rotation_vector(self.start[:3, :3].T @ self.target[:3, :3]))
        self._length = self._end = way_m if way_m > 1e-6 else float(np.linalg.norm(self._turn))
        self._done = self._rate = 0.0

    def stop(self, deceleration: float) -> None:
        """End on the way, as early as this deceleration allows."""
        self.acceleration = deceleration
        self._end = min(self._end, self._done + self._rate**2 / (2 * deceleration))

    def advance(self, q_rad: Vector, qd_rad_per_s: Vector, dt_s: float) -> Advanced:  # noqa: ARG002 - on its own rails
        """Return the arm one cycle later; `PathError` where the joints cannot follow within their limits."""
        share = self._advance_trapezoid(dt_s)
        frames = tool_frames(q_rad, self.tool)
        here = frames[-1]
        where = self.start[:3, 3] + share * (self.target[:3, 3] - self.start[:3, 3])
        turned = self.start[:3, :3] @ rotation_matrix(share * self._turn)
        turn = rotation_vector(turned @ here[:3, :3].T)
        error = np.concatenate([where - here[:3, 3], turn])
        try:
            step = np.linalg.solve(jacobian(frames), error)
        except np.linalg.LinAlgError as singular:
            raise PathError("the line leads through a singularity") from singular
        if np.abs(step).max() > JOINT_SPEED_LIMIT_RAD_PER_S * dt_s:
            raise PathError("the line asks a joint for more than its largest speed")
        finished = self._done >= self._end
        return q_rad + step, np.zeros(6) if finished else step / dt_s, finished

    def _advance_trapezoid(self, dt_s: float) -> float:
        """Return the covered fraction of the length one cycle later."""
        left = self._end - self._done
        self._rate = min(self.speed, self._rate + self.acceleration * dt_s, math.sqrt(2 * self.acceleration * left))
        # The last cycle of a discrete trapezoid would creep for ever.
        if left <= max(self._rate * dt_s, 1e-9):
            self._done, self._rate = self._end, 0.0
        else:
            self._done += self._rate * dt_s
        return 1.0 if self._length <= 0 else self._done / self._length


class WristPlant(Protocol):
    """What the wrist turns."""

    def step(self, dt_s: float, wrist_rad: float) -> float:
        """Advance by dt_s with the wrist's angle; return the torque on the tool about its own axis in N·m."""


class Arm:
    """The arm's joints, what moves them, and the wrench at the tool (6,) in base coordinates."""

    def __init__(
        self, plant: WristPlant | None = None, joints_rad: Sequence[float] | None = None, tool: Matrix | None = None
    ) -> None:
        """Stand at these joints, or at HOME_RAD, with this frame from the flange to the tool centre point."""
        self.q_rad: Vector = HOME_RAD.copy() if joints_rad is None else np.array(joints_rad)
        self._tool = np.eye(4) if tool is None else tool
        self.qd_rad_per_s: Vector = np.zeros(6)
        self.motion: Speed | LinearMove | None = None
        # The pendant's speed slider, a factor on commanded speeds.
        self.speed_slider = 1.0
        # How much the controller slows every motion by itself.
        self.limiter_scaling = 1.0
        # How much of its errors the wrench has.
        self.wrench_error_factor = 1.0
        # Faults: how fast each joint brakes, the noise of its measured speeds, and a force (3,) that nothing exerts.
        self.braking_rad_per_s2 = np.full(6, math.inf)
        self.noise_rad_per_s = 0.0
        self.bias_n = np.zeros(3)
        # Of what hangs on the tool.
        self.hung_kg = 0.0
        self._framed_q_rad, self._last_frames = self.q_rad, tool_frames(self.q_rad, self._tool)
        self._posed_q_rad, self._last_pose = self.q_rad, _pose_of_frame(self._last_frames[-1])
        self._plant = plant
        self.load = np.zeros(6)
        self._wrench_zero = np.zeros(6)
        self._noise, self._random = np.zeros(6), np.random.default_rng(0)

    # Frames and pose only where they are needed: they take longer than all else in a cycle. A motion makes new angles.
    @property
    def _frames(self) -> list[Matrix]:
        if self._framed_q_rad is not self.q_rad:
            self._framed_q_rad, self._last_frames = self.q_rad, tool_frames(self.q_rad, self._tool)
        return self._last_frames

    @property
    def _frame(self) -> Matrix:
        return self._frames[-1]

    @property
    def moving(self) -> bool:
        """Whether a joint turns."""
        return bool(self.qd_rad_per_s.any())

    @property
    def pose(self) -> Vector:
        """The tool's pose (6,)."""
        if self._posed_q_rad is not self.q_rad:
            self._posed_q_rad, self._last_pose = self.q_rad, _pose_of_frame(self._frame)
        return self._last_pose

    @property
    def speed(self) -> Vector:
        """The tool's linear and angular velocity (6,) in base coordinates."""
        return np.asarray(jacobian(self._frames) @ self.qd_rad_per_s)

    @property
    def wrench(self) -> Vector:
        """Force and torque at the tool, relative to the zero."""
        hung_n = np.array([0.0, 0.0, -STANDARD_GRAVITY * self.hung_kg])
        apart = np.concatenate([self.bias_n + hung_n, np.zeros(3)])
        return np.asarray(self.load + self._noise - self._wrench_zero + apart)

    @property
    def measured_rad_per_s(self) -> Vector:
        """The joints' speeds as the controller reports them."""
        if not self.noise_rad_per_s:
            return self.qd_rad_per_s
        return np.asarray(self.qd_rad_per_s + self._random.normal(0.0, self.noise_rad_per_s, 6))

    def brake(self, deceleration_rad_per_s2: float, *, wrist: bool = True) -> None:
        """Slow down no faster than this from now on; without the wrist, its joint brakes as before."""
        self.braking_rad_per_s2 = np.full(6, deceleration_rad_per_s2)
        if not wrist:
            self.braking_rad_per_s2[5] = math.inf

    def mend(self) -> None:
        """End every fault."""
        self.speed_slider = self.limiter_scaling = 1.0
        self.noise_rad_per_s = 0.0
        self.braking_rad_per_s2 = np.full(6, math.inf)
        self.bias_n, self.hung_kg = np.zeros(3), 0.0
        self.wrench_error_factor = 1.0

    @property
    def _scaling(self) -> float:
        return self.speed_slider * self.limiter_scaling

    def turn(self, target_rad_per_s: Vector, acceleration: float) -> None:
        """Turn towards these joint speeds from now on."""
        self.motion = Speed(self._scaling * target_rad_per_s, acceleration, braking_rad_per_s2=self.braking_rad_per_s2)

    def move_to(self, pose: Vector, speed: float, acceleration: float) -> None:
        """Begin a straight move."""
        speed *= self._scaling
        self.motion = LinearMove(self._frame, frame_of_pose(pose), speed, acceleration, self._tool)

    def halt(self, deceleration: float) -> None:
        """Slow every joint down to rest."""
        self.motion = Speed(np.zeros(6), deceleration, True, self.braking_rad_per_s2) if self.moving else None

    def halt_on_line(self, deceleration: float) -> None:
        """Slow a straight move down to rest on its line; anything else as `halt` does."""
        if isinstance(self.motion, LinearMove):
            self.motion.stop(deceleration)
        else:
            self.halt(deceleration)

    def advance(self, dt_s: float) -> None:
        """Move for one cycle; `PathError` where the motion leads nowhere."""
        if self.motion is not None:
            q_rad, self.qd_rad_per_s, finished = self.motion.advance(self.q_rad, self.qd_rad_per_s, dt_s)
            # An arm that is held at rest keeps its angles, and with them its frames and its pose.
            if not np.array_equal(q_rad, self.q_rad):
                self.q_rad = q_rad
            self.motion = None if finished else self.motion

    def feel(self, dt_s: float, error: Vector) -> None:
        """Let the wrist turn its plant for one cycle, and feel its torque about the tool's axis.

        `error`: the largest errors (6,) of the measured force and torque.
        """
        self._noise = self.wrench_error_factor * self._random.uniform(-1.0, 1.0, 6) * error
        if self._plant is not None:
            torque_nm = self._plant.step(dt_s, float(self.q_rad[5]))
            flange_axis = self._frame[:3, :3] @ self._tool[2, :3]
            self.load = np.concatenate([np.zeros(3), torque_nm * flange_axis])

    def zero_wrench(self) -> None:
        """Make the present wrench zero."""
        self._wrench_zero = self.load.copy()
