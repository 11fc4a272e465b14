"""What the daemon says on the wire: one frozen dataclass per topic, and its encoding.

A message is two ZeroMQ frames: the topic, and a msgpack map. Scalars are plain keys; an array is msgpack `bin`
(little-endian float32, C order) with its shape in a key of its own, so that plotting tools pass over it. Every map
has `timestamp` (Unix seconds), `t_mono_ns`, `seq` (per topic and source, without gaps) and `source`.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias

import msgpack
import numpy as np
from numpy.typing import NDArray

Scalar: TypeAlias = float | int | str | bool | None
FloatArray: TypeAlias = NDArray[np.floating]

_WIRE = np.dtype("<f4")


def column(unit: str, meaning: str) -> Any:
    """Declare one key of a message, with its unit (empty for a bare number or a text) and what it means."""
    return field(metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What all messages carry: who says it, and the time that it speaks of."""

    topic: ClassVar[str]
    # Expected messages a second; None where a message is sent on change only. Freshness is judged by it.
    rate_hz: ClassVar[float | None]

    source: str
    t_mono_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EitFrame(Message):
    """One frame of a fingertip as it was received; its time is the middle of the acquisition."""

    topic: ClassVar[str] = "eit.frame"
    rate_hz: ClassVar[float | None] = 1.85

    channels: FloatArray = column("V", "the 896 channels in the order of the channel table")
    line: FloatArray = column("V", "the 1024 values of the raw line")
    frame: int = column("", "number of the frame since the board was connected")
    age_s: float = column("s", "from the middle of the acquisition to the arrival of the last byte")
    saturated: int = column("", "channels at the converter's full scale")
    dead: int = column("", "channels unchanged for many frames")
    repeated: bool = column("", "the line equals the one before it to the last digit")


@dataclass(frozen=True, slots=True, kw_only=True)
class EitEstimate(Message):
    """What one frame says of the tool; torque and diameter are nil unless `valid` is true."""

    topic: ClassVar[str] = "eit.estimate"
    rate_hz: ClassVar[float | None] = 1.85

    torque_nm: float | None = column("N·m", "torque on the tool")
    torque_low_nm: float | None = column("N·m", "lower end of the 95 % interval")
    torque_high_nm: float | None = column("N·m", "upper end of the 95 % interval")
    diameter_mm: float | None = column("mm", "diameter of the tool, from the fingertip alone")
    diameter_low_mm: float | None = column("mm", "lower end of its 95 % interval")
    diameter_high_mm: float | None = column("mm", "upper end of its 95 % interval")
    k: float | None = column("cm", "centre of the best-matching conductivity pattern")
    sigma: float | None = column("cm", "width of the best-matching conductivity pattern")
    score: float | None = column("", "normalised cross-correlation of the best cell, 0 to 1")
    runner_up: float | None = column("", "score of the best cell away from the best one")
    valid: bool = column("", "whether this is an estimate at all")
    why: str = column("", "why it is not valid, in sentences; empty when it is")
    frame: int = column("", "number of the frame that it was made from")
    latency_s: float = column("s", "from the arrival of the frame's last byte to this message")


@dataclass(frozen=True, slots=True, kw_only=True)
class EitHeatmap(Message):
    """The scores of all cells for one frame, NaN at cells that are not valid; sent only while somebody subscribes."""

    topic: ClassVar[str] = "eit.heatmap"
    rate_hz: ClassVar[float | None] = None

    scores: FloatArray = column("", "score of each cell, k by sigma")
    k_low: float = column("cm", "first k of the grid")
    k_high: float = column("cm", "last k of the grid")
    sigma_low: float = column("cm", "first sigma of the grid")
    sigma_high: float = column("cm", "last sigma of the grid")
    model: str = column("", "basis model of the bank, which says what conductivity k and sigma stand for")
    frame: int = column("", "number of the frame that it was made from")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadTorque(Message):
    """One reading of the load cell on the lever; what is not `valid` is no torque, whatever the number."""

    topic: ClassVar[str] = "load.torque"
    rate_hz: ClassVar[float | None] = 10.9

    torque_nm: float = column("N·m", "torque on the lever, after tare and scale")
    raw: float = column("", "the number that the board sent")
    saturated: bool = column("", "whether the converter was at its full scale")
    spike: bool = column("", "whether the reading cannot be true, going by those before it")
    valid: bool = column("", "whether nothing speaks against the reading")
    why: str = column("", "what speaks against it, in a sentence; empty when it is valid")


@dataclass(frozen=True, slots=True, kw_only=True)
class SkinShear(Message):
    """What one reading of the shear skin says; the force and its interval are nil unless `valid` is true."""

    topic: ClassVar[str] = "skin.shear"
    rate_hz: ClassVar[float | None] = 10.0

    shear_n: float | None = column("N", "shear force on the skin; positive where it stretches gauge 1")
    shear_low_n: float | None = column("N", "lower end of the interval: 95 %, and all that friction leaves open")
    shear_high_n: float | None = column("N", "upper end of the interval")
    torque_nm: float | None = column("N·m", "shear force times the tool's radius; nil where that is not configured")
    response: float | None = column("", "normalised response, change of gauge 1 less change of gauge 2")
    response_1: float | None = column("", "relative change of gauge 1 since its zero")
    response_2: float | None = column("", "relative change of gauge 2 since its zero")
    r1_ohm: float | None = column("Ω", "resistance of gauge 1")
    r2_ohm: float | None = column("Ω", "resistance of gauge 2")
    deadband: bool = column("", "whether the interval holds zero: the response does not tell the force from none")
    direction: str = column("", "loading, unloading, or unknown while friction hides which")
    valid: bool = column("", "whether this is a measurement at all")
    why: str = column("", "why it is not valid, in sentences; empty when it is")
    sample: int = column("", "number of the reading since the daemon began")
    missed: int = column("", "readings that are missing right before this one")
    latency_s: float = column("s", "from the reading's arrival to this message")


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotStateMessage(Message):
    """What the robot's controller says of itself."""

    topic: ClassVar[str] = "robot.state"
    rate_hz: ClassVar[float | None] = 25.0

    joints_rad: tuple[float, ...] = column("rad", "the six joint angles, base to wrist 3")
    tcp_pose: tuple[float, ...] = column("m, rad", "position and rotation vector of the tool centre in the base frame")
    wrench: tuple[float, ...] = column("N, N·m", "force and torque at the tool centre")
    wrist_rad: float = column("rad", "angle of wrist 3, about which the tool twists")
    wrist_speed_rad_per_s: float = column("rad/s", "its speed")
    wrist_torque_nm: float = column("N·m", "torque about the tool's axis, from the wrench")
    robot_mode: int = column("", "the controller's robot mode, 7 when running")
    safety_mode: int = column("", "the controller's safety mode, 1 when normal")
    speed_scaling: float = column("", "share of the commanded speed that the controller allows")
    protective_stop: bool = column("", "whether it is in a protective stop")
    emergency_stop: bool = column("", "whether an emergency stop is pressed")
    blocked: str = column("", "why motion is refused at present; empty when it is allowed")
    age_s: float = column("s", "since the controller made the sample, by its own clock against ours")


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperStateMessage(Message):
    """What the gripper says of itself; the width at which it stops on an object is a diameter measurement."""

    topic: ClassVar[str] = "gripper.state"
    rate_hz: ClassVar[float | None] = 10.0

    width_mm: float = column("mm", "distance between the fingertips")
    diameter_mm: float | None = column("mm", "the same while an object is held, else nil")
    diameter_std_mm: float | None = column("mm", "its standard deviation")
    tool_diameter_mm: float | None = column("mm", "diameter from gripper and fingertips, weighted by their variances")
    tool_diameter_std_mm: float | None = column("mm", "its standard deviation")
    current_ma: float | None = column("mA", "motor current")
    current_age_s: float = column(
        "s", "how long before the rest that was asked for: up to 0.5 where it stands and is reached by the controller"
    )
    object: str = column("", "moving, contact opening, contact closing or at target")
    fault: int = column("", "fault code, 0 for none")
    fault_text: str = column("", "the fault in a sentence; empty for none")


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopState(Message):
    """Where the closed loop stands: what is wanted, what is sent, and every reason for holding."""

    topic: ClassVar[str] = "loop.state"
    rate_hz: ClassVar[float | None] = 1.0

    phase: str = column("", "idle, running, paused, held, done or stopped")
    experiment: str = column("", "name of the experiment; empty when there is none")
    step: int = column("", "number of the step, from 1")
    steps: int = column("", "number of steps")
    step_name: str = column("", "what kind of step it is, as it is written in the experiment")
    hold: int = column("", "number of the angle or torque of the step that is held now, from 1; 0 while none is")
    slices: str = column("", "what its holds are kept as with `shearloop run --slices`: torque, diameter, or nothing")
    doing: str = column("", "what is being done or waited for")
    progress: float = column("", "share of the experiment that is done, 0 to 1")
    remaining_s: float = column("s", "about how long it will still take")
    tool_mm: float | None = column("mm", "diameter of the tool, where the experiment names it")
    driving: str = column("", "the torque that drives the loop")
    torque_nm: float | None = column("N·m", "its latest valid value")
    set_point_nm: float | None = column("N·m", "the torque that is wanted at the end of the ramp")
    ramp_nm: float | None = column("N·m", "the torque that is wanted now")
    expected_nm: float | None = column("N·m", "the torque that the controller expects now")
    stiffness_nm_per_rad: float | None = column("N·m/rad", "the tool's, as it was identified")
    delay_s: float | None = column("s", "age of the driving torque when it is known, as it was identified")
    noise_nm: float | None = column("N·m", "standard deviation of one driving torque, as it was identified")
    speed_wanted_rad_per_s: float = column("rad/s", "the wrist speed that was wanted")
    speed_sent_rad_per_s: float = column("rad/s", "the wrist speed that was sent, after clipping")
    response: str = column("", "what safety makes of it all")
    reasons: str = column("", "every reason for holding or stopping, in sentences")


@dataclass(frozen=True, slots=True, kw_only=True)
class Health(Message):
    """How the process and each of its tasks are."""

    topic: ClassVar[str] = "health"
    rate_hz: ClassVar[float | None] = 1.0

    tasks: Mapping[str, Mapping[str, Scalar | Mapping[str, int]]] = column(
        "", "per task: alive, done, restarts, rate_hz, expected_hz, errors by kind, and a sentence for what is wrong"
    )
    loop_lag_s: float = column("s", "how late the event loop woke this message's task")
    memory_mb: float = column("MB", "resident memory")
    cpu_percent: float = column("%", "of one core since the message before")


def wire_map(message: Message, timestamp: float, seq: int) -> dict[str, Any]:
    """Return the map that goes on the wire, arrays as little-endian float32 with their shapes beside them."""
    content: dict[str, Any] = {"timestamp": timestamp, "seq": seq}
    for item in dataclasses.fields(message):
        name, value = item.name, getattr(message, item.name)
        if isinstance(value, np.ndarray | tuple):
            # What is too large for float32 goes as infinite.
            with np.errstate(over="ignore"):
                array = np.asarray(value, _WIRE)
            content[name], content[f"{name}_shape"] = array.tobytes(), list(array.shape)
        else:
            content[name] = value
    return content


def encode(content: Mapping[str, Any]) -> bytes:
    """Return the second frame of a message."""
    packed: bytes = msgpack.packb(content)
    return packed


def decode(payload: bytes) -> dict[str, Any]:
    """Return the map of a message with its arrays restored; raises ValueError for what is not a message."""
    try:
        content = msgpack.unpackb(payload)
    except (msgpack.exceptions.UnpackException, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"not a msgpack message: {error}") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError("not a message: its content is not a map with text keys")
    for key in [key for key in content if f"{key}_shape" in content]:
        shape = content.pop(f"{key}_shape")
        try:
            content[key] = np.frombuffer(content[key], "<f4").reshape(shape)
        except (TypeError, ValueError) as error:
            raise ValueError(f"not a message: array {key!r} does not fit its shape {shape!r}") from error
    return content
