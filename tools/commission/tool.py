"""Stage 7: a tool on a known spring: signs, stiffness and delay, slip, and how well a grip repeats."""

import asyncio
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from shearloop.daemon.commissioning import Line, Supplied
from shearloop.daemon.config import GripperConfig
from shearloop.daemon.rig import gripper_calibration, make_gripper_client, patience_of
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperCommand
from shearloop.drivers.ur.messages import tool_axis
from shearloop.errors import UserError
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.listening import LoadCellListener
from shearloop.tools.commission.motion import TURN_RAD
from shearloop.tools.commission.report import Measured, judged
from shearloop.tools.commission.wrench import read

STAGE: Final = "7 tool and spring"
STIFFNESS_TOLERANCE: Final = 0.1
# What remains of the torque after the twists, as a fraction of the largest one.
LARGEST_SLIP: Final = 0.15
REPEATS_MM: Final = 1.0
_GRIP_N: Final = 60.0
_FINGERS_MM_PER_S: Final = 60.0
_SLOWLY_RAD_PER_S: Final = 0.1
_HELD_S: Final = 1.0
_SETTLES_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Held:
    """The wrist's angle, the load cell's torque, and the torque of the robot's wrench about the tool's axis."""

    wrist_rad: float
    load_nm: float
    wrench_nm: float


def measure(context: Context) -> Measured:
    """Return the stage's lines and the largest torque that they cover."""
    cell, hand = context.config.load_cell, context.config.gripper
    if cell is None:
        raise UserError("stage 7 needs a load cell on the tool: add `load_cell` to the configuration, or leave it out")
    operator = context.operator
    spring = operator.number(
        "Mount the tool on a spring of known stiffness; that of spring and pads together in N·m/rad", 0.05, 50.0
    )
    lines = asyncio.run(_grips(context, hand)) if hand is not None else []
    with LoadCellListener(cell) as load:
        context.ready()
        turned = _signs(context, load)
        held, delays_s = _twists(context, load)
    lines += [*turned, *judge_twists(held, spring)]
    delay_s = statistics.median(delays_s)
    lines.append(Line(what="torque behind the angle", value=f"{1e3 * delay_s:.0f} ms (median)", count=len(delays_s)))
    largest_nm = max(abs(one.load_nm - held[0].load_nm) for one in held)
    passed = all(line.verdict != "failed" for line in lines)
    return Measured(lines, Supplied(torque_nm=round(largest_nm, 4)) if passed else Supplied())


async def _grips(context: Context, config: GripperConfig) -> list[Line]:
    """Grip the tool several times, and leave it gripped."""
    hand = RobotiqGripper(make_gripper_client(config, patience_of(context.config)), gripper_calibration(config))
    count = context.counts.starts
    await asyncio.to_thread(
        context.operator.allow,
        f"the fingers close onto the tool {count} times at {_FINGERS_MM_PER_S:g} mm/s with at most {_GRIP_N:g} N, and "
        "stay closed",
    )
    diameters_mm = []
    try:
        await hand.connect()
        await hand.activate()
        for _ in range(count):
            opened = GripperCommand(hand.model.stroke_mm, _FINGERS_MM_PER_S, _GRIP_N)
            await hand.finish(await hand.move(opened))
            closed = await hand.finish(await hand.move(GripperCommand(0.0, _FINGERS_MM_PER_S, _GRIP_N)))
            if closed.diameter_mm is None:
                raise UserError("the gripper holds nothing: put the tool between its fingers, and run the stage again")
            diameters_mm.append(closed.diameter_mm)
    finally:
        await hand.close()
    spread_mm = max(diameters_mm) - min(diameters_mm)
    return [
        judged(
            "width of repeated grips",
            f"{spread_mm:.2f} mm apart",
            f"at most {REPEATS_MM:g} mm",
            "a grip repeats",
            passed=spread_mm <= REPEATS_MM,
            count=count,
        )
    ]


def _hold(context: Context, load: LoadCellListener) -> Held:
    """Return the measurements at a wrist that stands."""
    load_nm = load.mean_nm(_HELD_S)
    outputs = context.observer.latest().outputs
    reading = read(context)
    # The sign of the loop's torques: what the wrist puts into the tool.
    axis = tool_axis(outputs.tcp_pose)
    wrench_nm = -sum(one * other for one, other in zip(axis, reading.mean[3:], strict=True))
    return Held(context.observer.latest().wrist_rad, load_nm, wrench_nm)


def _turn(context: Context, by_rad: float) -> None:
    """Turn to an angle from the pose."""
    here_rad = context.observer.latest().wrist_rad
    target_rad = context.pose_rad + by_rad
    way = 1.0 if target_rad > here_rad else -1.0
    context.mover.move("turn", rad_per_s=way * _SLOWLY_RAD_PER_S, to_rad=target_rad)


def _signs(context: Context, load: LoadCellListener) -> list[Line]:
    """Turn once by a positive angle; the operator says which way the tool turned."""
    context.operator.allow(f"wrist 3 turns the tool by +{TURN_RAD:g} rad at {_SLOWLY_RAD_PER_S:g} rad/s, and back")
    before = _hold(context, load)
    _turn(context, TURN_RAD)
    after = _hold(context, load)
    said = context.operator.ask(
        "Which way did the gripper turn, for an eye that faces it: clockwise or counterclockwise?"
    )
    _turn(context, 0.0)
    return judge_signs(before, after, said)


def judge_signs(before: Held, after: Held, said: str) -> list[Line]:
    """Return the lines on a positive turn: command, wrist, load cell and wrench are positive."""
    found = {
        "command": "positive" if said.lower() == "counterclockwise" else f"negative: the operator said {said!r}",
        "wrist": _sign(after.wrist_rad - before.wrist_rad),
        "load cell": _sign(after.load_nm - before.load_nm),
        "wrench": _sign(after.wrench_nm - before.wrench_nm),
    }
    lines = [
        judged(
            f"sign of the {what}",
            value,
            "positive, counterclockwise for an eye that faces the gripper",
            "the loop turns the right way",
            passed=value == "positive",
        )
        for what, value in found.items()
    ]
    return [*lines, Line(what="sign of a fingertip's estimate", value="not measured by this stage")]


def _sign(change: float) -> str:
    return "positive" if change > 0 else "negative"


def _twists(context: Context, load: LoadCellListener) -> tuple[list[Held], list[float]]:
    """Return what is held at the pose, at each twist's end and at the pose again, and each twist's delay in s."""
    count = context.counts.twists
    context.operator.allow(
        f"wrist 3 turns the tool {count} times by {TURN_RAD:g} rad either way at {_SLOWLY_RAD_PER_S:g} rad/s"
    )
    held, delays_s = [_hold(context, load)], []
    for number in range(count):
        begun_ns = time.monotonic_ns()
        _turn(context, TURN_RAD if number % 2 == 0 else -TURN_RAD)
        context.observer.listen(_SETTLES_S)
        angles = [(seen.made_ns, seen.wrist_rad) for seen in context.observer.since(begun_ns)]
        torques = [(sample.t_mid_ns, sample.torque_nm) for sample in load.since(begun_ns)]
        delays_s.append(middle_s(torques) - middle_s(angles))
        held.append(_hold(context, load))
    _turn(context, 0.0)
    held.append(_hold(context, load))
    return held, delays_s


def middle_s(curve: Sequence[tuple[int, float]]) -> float:
    """Return the middle of a rise in s: where a step of the same area would be. `curve` has times in ns and values.

    A mean over each conversion does not move it, so that curves of different rates can be compared.
    """
    first, last = curve[0][1], curve[-1][1]
    area_s = sum(
        (after_ns - before_ns) / 1e9 * (0.5 * (before + after) - first) / (last - first)
        for (before_ns, before), (after_ns, after) in pairwise(curve)
    )
    return curve[-1][0] / 1e9 - area_s


def judge_twists(held: Sequence[Held], spring: float) -> list[Line]:
    """Return the lines on stiffness and slip; the first and the last were held at the pose."""
    first, *twisted, last = held
    stiffnesses = [
        (one.load_nm - before.load_nm) / (one.wrist_rad - before.wrist_rad)
        for before, one in zip([first, *twisted], twisted, strict=False)
    ]
    found = abs(statistics.fmean(stiffnesses))
    largest_nm = max(abs(one.load_nm - first.load_nm) for one in twisted)
    # The last angle differs a little from the first, and explains a part of the torque; the rest is slip.
    expected_nm = statistics.fmean(stiffnesses) * (last.wrist_rad - first.wrist_rad)
    slip = abs(last.load_nm - first.load_nm - expected_nm) / largest_nm if largest_nm else 1.0
    return [
        judged(
            "stiffness",
            f"{found:.3f} N·m/rad",
            f"{spring:g} N·m/rad ± {STIFFNESS_TOLERANCE:.0%}",
            "torque and angle fit together",
            passed=abs(found / spring - 1.0) <= STIFFNESS_TOLERANCE,
            count=len(twisted),
        ),
        judged(
            "slip in the grip",
            f"{slip:.1%} of {largest_nm:.3f} N·m",
            f"at most {LARGEST_SLIP:.0%}",
            "the grip holds this torque",
            passed=slip <= LARGEST_SLIP,
            count=len(twisted),
        ),
    ]
