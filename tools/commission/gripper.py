"""Stage 2: the gripper: activation, the time of an exchange, a table of widths, and the detection of objects."""

import asyncio
import math
import time
from collections.abc import Sequence
from typing import Final

from shearloop.daemon.commissioning import Line, Supplied
from shearloop.daemon.config import GripperConfig
from shearloop.daemon.rig import gripper_calibration, make_gripper_client, patience_of
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.robotiq.gripper import RobotiqGripper, WidthCalibration
from shearloop.drivers.robotiq.messages import GripperCommand, GripperState
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "2 gripper"
LONGEST_EXCHANGE_S: Final = 0.08
WIDTH_MM: Final = 1.0
_GENTLE_N: Final = 20.0
_SPEED_MM_PER_S: Final = 60.0


def measure(context: Context) -> Measured:
    """Return the stage's lines and the table of widths."""
    config = context.config.gripper
    if config is None:
        return Measured([Line(what="gripper", value="none is configured")])
    return asyncio.run(_measure(context, config))


async def _measure(context: Context, config: GripperConfig) -> Measured:
    hand = RobotiqGripper(make_gripper_client(config, patience_of(context.config)), gripper_calibration(config))
    context.operator.allow(
        "the gripper opens and closes its fingers once over the whole stroke, unless it is active already; nothing is "
        "between them"
    )
    try:
        await hand.connect()
        await hand.activate(operator_confirmed=True)
        lines = [await _exchanges(hand, context.counts.exchanges)]
        gauges = await _gauges(context, hand)
        width_line, supplies = judge_widths(gauges, config)
        return Measured([*lines, width_line, *await _objects(context, hand)], supplies)
    finally:
        await hand.close()


async def _exchanges(hand: RobotiqGripper, count: int) -> Line:
    times_s = []
    for _ in range(count):
        begun_s = time.monotonic()
        await hand.read()
        times_s.append(time.monotonic() - begun_s)
    p99_s = sorted(times_s)[math.ceil(0.99 * count) - 1]
    return judged(
        "exchange with the gripper, p99",
        f"{1e3 * p99_s:.1f} ms",
        f"below {1e3 * LONGEST_EXCHANGE_S:g} ms",
        "its state is younger than 0.25 s",
        passed=p99_s < LONGEST_EXCHANGE_S,
        count=count,
    )


async def _gauges(context: Context, hand: RobotiqGripper) -> list[tuple[float, float]]:
    """Return (counts, mm) of gauges that the gripper held."""
    gauges = []
    for number in range(1, context.counts.gauges + 1):
        question = f"Hold gauge {number} of {context.counts.gauges} between the fingers; its width in mm"
        width_mm = await asyncio.to_thread(context.operator.number, question, 0.5, hand.model.stroke_mm)
        state = await _close_and_open(context, hand, f"gauge {number}")
        gauges.append((float(state.position_counts), width_mm))
    return gauges


async def _close_and_open(context: Context, hand: RobotiqGripper, what: str) -> GripperState:
    """Close onto something, open again, and return the closed gripper's state."""
    await asyncio.to_thread(
        context.operator.allow,
        f"the fingers close at {_SPEED_MM_PER_S:g} mm/s with at most {_GENTLE_N:g} N onto {what}, then open",
    )
    closed = await hand.finish(await hand.move(GripperCommand(0.0, _SPEED_MM_PER_S, _GENTLE_N)))
    await hand.finish(await hand.move(GripperCommand(hand.model.stroke_mm, _SPEED_MM_PER_S, _GENTLE_N)))
    return closed


def judge_widths(gauges: Sequence[tuple[float, float]], config: GripperConfig) -> tuple[Line, Supplied]:
    """Return the line on a table of widths through gauges, and the table."""
    limit, promise = f"± {WIDTH_MM:g} mm", "diameters are right"
    try:
        found = WidthCalibration.of_gauges(gauges, config.model)
    except DeviceCalibrationError as error:
        return judged("widths", str(error), limit, promise, passed=False, count=len(gauges)), Supplied()
    error_mm = max(abs(found.width_mm(counts) - width_mm) for counts, width_mm in gauges)
    passed = error_mm <= WIDTH_MM
    line = judged("widths", f"{error_mm:.2f} mm from the table", limit, promise, passed=passed, count=len(gauges))
    return line, Supplied(widths=tuple(gauges)) if passed else Supplied()


async def _objects(context: Context, hand: RobotiqGripper) -> list[Line]:
    """Return the lines on objects that are held, and on nothing that is held."""
    count, seen = context.counts.objects, 0
    for number in range(1, count + 1):
        await asyncio.to_thread(
            context.operator.act,
            f"Hold object {number} of {count} between the fingers: a thin, a thick, a soft, a hard one",
        )
        seen += (await _close_and_open(context, hand, f"object {number}")).diameter_mm is not None
    await asyncio.to_thread(context.operator.act, "Take everything out of the gripper")
    empty = (await _close_and_open(context, hand, "nothing")).diameter_mm is None
    return [
        judged(
            "objects that are detected",
            f"{seen} of {count}",
            "all",
            "a dropped tool stops the experiment",
            passed=seen == count,
            count=count,
        ),
        judged(
            "no object",
            "detected as none" if empty else "an object is reported",
            "none",
            "a grip of nothing is an error",
            passed=empty,
        ),
    ]
