"""The table of topics: one frozen dataclass per message, and the encoding of a message.

A message has two ZeroMQ frames: the topic and a msgpack map. Scalars are plain keys. An array is msgpack `bin`
(little-endian float32, C order), and its shape has a key of its own, so that plotting tools ignore it. Every map has
`timestamp` (Unix seconds), `t_mono_ns`, `seq` (per topic and source, without gaps) and `source`.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, TypeAlias, TypeVar, dataclass_transform

import msgpack
import numpy as np
from numpy.typing import NDArray

Scalar: TypeAlias = float | int | str | bool | None

# A message older than this many periods of its topic is stale.
STALE_AFTER_PERIODS = 2.5
# Keys of every map.
ENVELOPE = frozenset({"timestamp", "t_mono_ns", "seq", "source"})
_FLOAT32 = np.dtype("<f4")


def column(unit: str, meaning: str) -> Any:
    """Declare one key of a message with its unit (empty if it has none) and meaning."""
    return field(metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """Keys of all messages: the source, and the time of the measurement."""

    topic: ClassVar[str]
    # Expected messages per second; None for a message that is sent on change only.
    rate_hz: ClassVar[float | None]
    # Whether several sources send it, as both fingertips do; a recording has a topic for each of them.
    per_source: ClassVar[bool]

    source: str
    t_mono_ns: int


M = TypeVar("M", bound=Message)

# By topic, in the order of this file.
TOPICS: dict[str, type[Message]] = {}


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(column,))
def message(topic: str, *, rate_hz: float | None, per_source: bool) -> Callable[[type[M]], type[M]]:
    """Declare the dataclass of a topic."""

    def declare(kind: type[M]) -> type[M]:
        kind = dataclass(frozen=True, slots=True, kw_only=True)(kind)
        kind.topic, kind.rate_hz, kind.per_source = topic, rate_hz, per_source
        TOPICS[topic] = kind
        return kind

    return declare


@message("eit.frame", rate_hz=1.85, per_source=True)
class EitFrame(Message):
    """One frame of a fingertip; its time is the middle of the acquisition."""

    channels: NDArray[np.floating] = column("V", "the channels in the order of the channel table")
    line: NDArray[np.floating] = column("V", "the values of the raw line")
    frame: int = column("", "number of the frame since the daemon began")
    age_s: float = column("s", "time from the middle of the acquisition to the arrival of the last byte")
    saturated: int = column("", "channels at the converter's full scale")
    dead: int = column("", "channels that read 0, or the same for 200 frames")
    repeated: bool = column("", "whether the line is exactly equal to the previous line")


@message("eit.estimate", rate_hz=1.85, per_source=True)
class EitEstimate(Message):
    """The estimate from one frame; torque and diameter are nil unless `valid` is true."""

    torque_nm: float | None = column("N·m", "torque on the tool")
    torque_low_nm: float | None = column("N·m", "lower end of its 95 % interval")
    torque_high_nm: float | None = column("N·m", "upper end of its 95 % interval")
    diameter_mm: float | None = column("mm", "diameter of the tool, from the fingertip alone")
    diameter_low_mm: float | None = column("mm", "lower end of its 95 % interval")
    diameter_high_mm: float | None = column("mm", "upper end of its 95 % interval")
    k: float | None = column(
        "", "k of the best-matching cell, in cm; in rad/cm with the basis model modulated_gaussian"
    )
    sigma: float | None = column("cm", "σ of the best-matching cell")
    score: float | None = column("", "normalised cross-correlation of the best cell, 0 to 1")
    runner_up: float | None = column("", "score of the best cell away from the best one")
    valid: bool = column("", "whether the estimate can be used; false if the gripper's fingers moved during the frame")
    reason: str = column("", "why it is not valid, in sentences; empty when it is")
    frame: int = column("", "number of the frame")
    latency_s: float = column("s", "time from the arrival of the frame's last byte to this message")


@message("eit.adapted", rate_hz=None, per_source=True)
class EitAdapted(Message):
    """A correction of a fingertip's gain by a known torque, valid until the next grip or tare."""

    reference: str = column("", "source of the known torque: load_cell or wrench")
    twists: int = column("", "number of twists since the grip that gave the correction")
    factor: tuple[float, ...] = column("", "factor on the torque of each fingertip of the calibration")
    factor_std: tuple[float, ...] = column("", "their standard errors")
    offset_nm: float = column("N·m", "the correction that is added to the torque")
    gain_before: float = column("", "mean estimate over the known torque under load, before the correction")
    gain_after: float = column("", "the same after it")
    rmse_before_nm: float = column("N·m", "root mean square error under load, before the correction")
    rmse_after_nm: float = column("N·m", "the same after it")
    spread_before: float = column("", "standard deviation of ln gain that the intervals allow for, before")
    spread_after: float = column("", "the same after it")
    frame: int = column("", "number of the first frame with the correction")


@message("eit.heatmap", rate_hz=None, per_source=True)
class EitHeatmap(Message):
    """The scores of all cells for one frame, NaN for invalid cells; sent while there is a subscriber, or always."""

    scores: NDArray[np.floating] = column("", "score of each cell, k by sigma")
    k_low: float = column("", "first k of the grid, in cm; in rad/cm with the basis model modulated_gaussian")
    k_high: float = column("", "last k of the grid, in the same unit")
    sigma_low: float = column("cm", "first sigma of the grid")
    sigma_high: float = column("cm", "last sigma of the grid")
    model: str = column("", "basis model of the bank, which defines k and sigma")
    frame: int = column("", "number of the frame")


@message("load.torque", rate_hz=10.9, per_source=False)
class LoadTorque(Message):
    """One reading of the load cell on the lever; the torque can be used only if `valid` is true."""

    torque_nm: float = column("N·m", "torque on the lever, after tare and scale")
    raw: float = column("", "the number that the board sent")
    saturated: bool = column("", "whether the converter was at its full scale")
    spike: bool = column("", "whether the reading is implausible after the previous readings")
    valid: bool = column("", "whether the reading can be used")
    reason: str = column("", "why it is not valid, in a sentence; empty when it is")


@message("skin.shear", rate_hz=10.0, per_source=False)
class SkinShear(Message):
    """One reading of the shear skin; the force and its interval are nil unless `valid` is true."""

    shear_n: float | None = column("N", "shear force on the skin; positive if it stretches gauge 1")
    shear_low_n: float | None = column("N", "lower end of the interval: 95 %, plus the range that friction leaves open")
    shear_high_n: float | None = column("N", "upper end of the interval")
    torque_nm: float | None = column("N·m", "shear force times the tool's radius; nil if that is not configured")
    torque_low_nm: float | None = column("N·m", "lower end of its interval")
    torque_high_nm: float | None = column("N·m", "upper end of its interval")
    response: float | None = column("", "normalised response: change of gauge 1 minus change of gauge 2")
    response_1: float | None = column("", "relative change of gauge 1 since its zero")
    response_2: float | None = column("", "relative change of gauge 2 since its zero")
    r1_ohm: float | None = column("Ω", "resistance of gauge 1")
    r2_ohm: float | None = column("Ω", "resistance of gauge 2")
    deadband: bool = column("", "whether the interval contains zero force")
    direction: str = column("", "loading, unloading, or unknown while friction hides it")
    valid: bool = column("", "whether the measurement can be used")
    reason: str = column("", "why it is not valid, in sentences; empty when it is")
    sample: int = column("", "number of the reading since the daemon started")
    missed: int = column("", "readings found missing since the message before; `health` has their sum")
    latency_s: float = column("s", "time from the reading's arrival to this message")


@message("robot.state", rate_hz=25.0, per_source=False)
class RobotStateMessage(Message):
    """The state of the robot's controller."""

    joints_rad: tuple[float, ...] = column("rad", "the six joint angles, base to wrist 3")
    tcp_pose: tuple[float, ...] = column("m, rad", "position and rotation vector of the tool centre in the base frame")
    tcp_speed_m_per_s: float = column("m/s", "speed of the tool centre")
    wrench: tuple[float, ...] = column(
        "N, N·m",
        "force and torque from the controller, relative to its last zero; without a tare it may be off by any load",
    )
    wrist_rad: float = column("rad", "angle of wrist 3, about which the tool twists")
    wrist_speed_rad_per_s: float = column("rad/s", "its speed")
    wrist_torque_nm: float | None = column(
        "N·m",
        "wrench about the tool's axis, mean over 0.2 s, which takes 16 states, else nil; the torque on the tool is its "
        "negative; it can be used only if `wrist_torque_valid` is true",
    )
    wrist_torque_valid: bool = column("", "whether that torque can be used: it is known, and its zero was taken")
    wrist_torque_reason: str = column("", "why it cannot be used, in a sentence; empty when it can")
    robot_mode: int = column("", "the controller's robot mode, 7 when running")
    safety_mode: int = column("", "the controller's safety mode, 1 when normal")
    speed_scaling: float = column(
        "", "fraction of the commanded speed that the arm carries out: slider times the controller's own scaling"
    )
    payload_kg: float = column("kg", "payload at the pendant; NaN before PolyScope 3.12 and 5.5.1")
    payload_cog_m: tuple[float, ...] = column("m", "its centre of gravity from the flange")
    tcp_offset: tuple[float, ...] = column("m, rad", "tool centre point at the pendant, from the flange")
    protective_stop: bool = column("", "whether it is in a protective stop")
    emergency_stop: bool = column("", "whether an emergency stop is pressed")
    blocked: str = column("", "why motion is refused at present; empty when it is allowed")
    age_s: float = column("s", "age of the sample when it was read, by the controller's clock against ours")


@message("gripper.state", rate_hz=10.0, per_source=False)
class GripperStateMessage(Message):
    """The state of the gripper; its width when it stops on an object is a diameter measurement."""

    width_mm: float = column("mm", "distance between the fingertips")
    diameter_mm: float | None = column("mm", "the same distance while an object is held, else nil")
    diameter_std_mm: float | None = column("mm", "its standard deviation")
    tool_diameter_mm: float | None = column("mm", "diameter from gripper and fingertips, weighted by their variances")
    tool_diameter_std_mm: float | None = column("mm", "its standard deviation")
    current_ma: float | None = column("mA", "motor current")
    object: str = column(
        "", "moving, contact opening, contact closing, at target, or unknown without a requested motion"
    )
    fault: int = column("", "fault code, 0 for none")
    fault_text: str = column("", "the fault in a sentence; empty for none")


RESPONSES = "the safety response: note, refuse start, hold, stop and keep grip, or stop and release"


@message("loop.state", rate_hz=1.0, per_source=False)
class LoopState(Message):
    """The state of the closed loop: set points, the command that was sent, and every reason for holding."""

    phase: str = column("", "idle, running, paused, held, done or stopped")
    run: int = column("", "number of the experiment since the daemon began, from 1; 0 before the first")
    experiment: str = column("", "name of the experiment; empty when there is none")
    step: int = column("", "number of the step, from 1")
    steps: int = column("", "number of steps")
    step_name: str = column("", "kind of the step, as the experiment names it")
    hold: int = column("", "number of the step's angle or torque that is held at present, from 1; 0 without one")
    slices: str = column(
        "", "kind of slice that `recording export` makes of a held angle: torque, diameter, or nothing"
    )
    activity: str = column("", "what the loop does or waits for")
    progress: float = column("", "fraction of the experiment that is done, 0 to 1")
    remaining_s: float = column("s", "estimated time to the end")
    tool_mm: float | None = column("mm", "diameter of the tool, if the experiment names it")
    torque_source: str = column("", "source of the torque that the loop controls")
    torque_note: str = column(
        "",
        "why it has no zero; or what it rests on that nothing checks, such as a tool of unknown diameter, or a stated "
        "one that does not fit the width of an uncalibrated gripper; empty without one",
    )
    torque_nm: float | None = column("N·m", "its latest value; nil if that is not valid, or stale")
    torque_limit_nm: float | None = column("N·m", "the experiment stops beyond plus or minus this torque")
    set_point_nm: float | None = column("N·m", "the set point at the end of the ramp")
    ramp_nm: float | None = column("N·m", "the present set point")
    filtered_torque_nm: float | None = column("N·m", "the present torque, from measurements, wrist angle and stiffness")
    filtered_torque_std_nm: float | None = column("N·m", "its standard deviation by noise and the stiffness's error")
    stiffness_nm_per_rad: float | None = column("N·m/rad", "the tool's identified stiffness")
    delay_s: float | None = column("s", "identified delay of the torque")
    noise_nm: float | None = column("N·m", "identified standard deviation of one torque")
    speed_command_rad_per_s: float = column("rad/s", "the commanded wrist speed, before the worker's clipping")
    speed_sent_rad_per_s: float = column("rad/s", "the wrist speed that was sent, after the worker's clipping")
    response: str = column("", RESPONSES)
    held_s: float = column("s", "how long faults have held the wrist since the experiment began")
    stop: int = column("", "number of the stop that waits for `unlock`, larger after each further cause; 0 without one")
    cause: str = column("", "the first reason, which may have caused the others; empty without a reason")
    faults: str = column("", "codes of the reasons, separated by commas, the cause's first; see faults.md")
    reasons: str = column("", "every reason for holding or stopping, in sentences")


@message("loop.stop", rate_hz=None, per_source=False)
class LoopStop(Message):
    """One stop of an experiment, with the times since its cause; its own time is the cause's."""

    run: int = column("", "number of the experiment since the daemon began, from 1")
    experiment: str = column("", "name of the experiment")
    cause: str = column("", "why it stopped, in sentences")
    faults: str = column("", "codes of the faults that stopped it, separated by commas, the cause's first")
    response: str = column("", RESPONSES)
    decided_after_s: float | None = column(
        "s",
        "time from the cause, a measurement or a request, to the decision; from the daemon's last decision if it stood "
        "still before; nil if nothing measured the cause: then all times count from the decision",
    )
    sent_after_s: float | None = column(
        "s", "time until the robot's worker had sent the stop; nil if it did not answer"
    )
    stands_after_s: float | None = column(
        "s", "time until a state of the robot showed the standstill, also before the decision; nil without one in 5 s"
    )
    refusal: str = column("", "why the robot's worker did not send the stop, in sentences; empty when it did")
    blocked_after_s: float | None = column(
        "s", "time until the robot's state showed that it accepts no command; nil unless the stop was refused"
    )


@message("daemon.command", rate_hz=None, per_source=False)
class DaemonCommand(Message):
    """A command to the daemon, except `status`, and its answer."""

    command: str = column("", "name of the command")
    subject: str = column("", "file of the experiment, or the sensor; empty without one")
    by: str = column("", "the sender, as the client says; it is not checked")
    request_id: str = column("", "the sender's own name of this request; empty without one")
    accepted: bool = column("", "whether it was carried out")
    reason: str = column("", "why it was refused, in sentences; empty when it was accepted")


@message("health", rate_hz=1.0, per_source=False)
class Health(Message):
    """The state of the process and of each of its tasks."""

    tasks: Mapping[str, Mapping[str, Scalar | Mapping[str, int]]] = column(
        "", "per task: alive, done, restarts, rate_hz, expected_hz, errors by kind, and the latest error in a sentence"
    )
    host: str = column("", "name of the computer that the daemon runs on")
    process: int = column("", "number of the daemon's process; `status` has it too")
    instance: str = column("", "random text of the daemon's own, another one after a restart; `status` has it too")
    rig: str = column("", "name of the rig: the configuration's `name`, else the name of its file")
    emulated: bool = column("", "whether every device is emulated, by `emulated: true` in the configuration")
    cap: str = column("", "cap on a robot's speeds and torque, and its reason; empty without a cap")
    tare_refusal: str = column("", "why `tare` is refused at present, in a sentence; empty if it is not")
    start_refusal: str = column("", "why `start` is refused at present for every experiment; empty if it is not")
    release_refusal: str = column("", "why `release` is refused at present; empty if it is not")
    loop_lag_s: float = column("s", "the delay with which the event loop woke this message's task")
    memory_mb: float = column("MB", "resident memory")
    cpu_percent: float = column("%", "processor time since the previous message, in percent of one core")


@message("daemon.end", rate_hz=None, per_source=False)
class DaemonEnd(Message):
    """The last message of a daemon that ends on request or with its experiment; a crashed one sends none."""

    finished: bool = column("", "whether the experiment of `stop_when_done` is done; true without one")
    summary: str = column("", "summary of the last experiment, in lines; empty without one")


@cache
def units(topic: str) -> Mapping[str, str]:
    """Return the unit of each key of a topic that has one; empty for an unknown topic."""
    fields = dataclasses.fields(TOPICS[topic]) if topic in TOPICS else ()
    envelope = {"timestamp": "s", "t_mono_ns": "ns"} if topic in TOPICS else {}
    return {**envelope, **{item.name: item.metadata["unit"] for item in fields if item.metadata.get("unit")}}


def with_unit(topic: str, key: str, value: float, form: str) -> str:
    """Return a value of a message's key in a format, with the unit of the key: `+0.100 N·m`."""
    # A small negative value rounds to -0.00.
    shown = value if float(f"{value:{form}}") else 0.0
    return f"{shown:{form}} {units(topic).get(key, '')}".rstrip()


def cause_of(loop_state: Mapping[str, Any]) -> str:
    """Return why the loop of a `loop.state` holds or stopped: the cause, then the codes of all further faults.

    Empty without a reason.
    """
    cause = str(loop_state.get("cause") or loop_state.get("reasons") or "")
    first, *others = str(loop_state.get("faults") or "").split(", ")
    further = ", ".join(dict.fromkeys(code for code in others if code != first))
    return f"{cause} Also: {further}." if further else cause


def stop_times(loop_stop: Mapping[str, Any]) -> str:
    """Return the times of a `loop.stop` in words, from the stop's cause, or from its decision."""

    def after(key: str) -> str | None:
        value = loop_stop.get(key)
        return None if value is None else f"after {with_unit(LoopStop.topic, key, value, '.3f')}"

    sent = f"sent {after('sent_after_s')}" if after("sent_after_s") else "no reply of the robot's worker"
    stands = f"standstill {after('stands_after_s')}" if after("stands_after_s") else "no standstill measured"
    decided_s, stands_s = loop_stop.get("decided_after_s"), loop_stop.get("stands_after_s")
    if decided_s is not None and stands_s is not None and stands_s < decided_s:
        # By a hold, or by the robot's own deadline.
        stands += ", before the decision"
    if loop_stop.get("refusal"):
        blocked = after("blocked_after_s")
        sent = f"not sent, because the robot was blocked {blocked}" if blocked else "refused by the robot's worker"
        stands += ", by the robot's own stop" if after("stands_after_s") else ""
    if decided := after("decided_after_s"):
        return f"from its cause: decided {decided}, {sent}, {stands}"
    return f"from its decision, because nothing measured its cause: {sent}, {stands}"


def stale_after_s(topic: str) -> float:
    """Return the age in seconds that makes a topic's latest message stale.

    Raises KeyError for a topic that is unknown or sent on change only.
    """
    rate_hz = TOPICS[topic].rate_hz
    if rate_hz is None:
        raise KeyError(f"{topic} has no expected rate")
    return STALE_AFTER_PERIODS / rate_hz


def wire_map(message: Message, timestamp: float, seq: int) -> dict[str, Any]:
    """Return a message as the map that is encoded."""
    content = {item.name: getattr(message, item.name) for item in dataclasses.fields(message)}
    return with_packed_arrays({"timestamp": timestamp, "seq": seq, **content})


def with_packed_arrays(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a map with arrays, tuples and lists as bytes of little-endian float32, and their shapes; None is NaN."""
    packed: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, np.ndarray | tuple | list):
            # Values beyond float32 become infinite.
            with np.errstate(over="ignore"):
                array = np.asarray(value, _FLOAT32)
            packed[key], packed[f"{key}_shape"] = array.tobytes(), list(array.shape)
        else:
            packed[key] = value
    return packed


def encode(content: Mapping[str, Any]) -> bytes:
    """Return the second frame of a message; bytes of a path that are not UTF-8 are written as `\\udcff`."""
    packed: bytes = msgpack.packb(content, unicode_errors="backslashreplace")
    return packed


def decode(payload: bytes) -> dict[str, Any]:
    """Return the map of a message, with its arrays restored; raises ValueError for other content."""
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
