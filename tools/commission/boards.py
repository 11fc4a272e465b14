"""Stage 6: the boards that measure the tool: rate, noise and dead channels, the load cell's scale and lag, clocks."""

import math
import statistics
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Final

import numpy as np

from shearloop.daemon.commissioning import Line
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.sensing.sessions import fingertip_table
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.load_cell import LoadSample
from shearloop.errors import UserError
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.fingers import FINGERS_MM_PER_S, GRIP_N, close_fingers, open_fingers
from shearloop.tools.commission.limits import REAL
from shearloop.tools.commission.listening import SILENT_S
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged
from shearloop.tools.commission.tap import frame_step_s, judge_clocks, load_step_s, robot_step_s

STAGE: Final = "6 boards"
# The converter's step is 0.8 mV; the paper's boards have some steps of noise.
LARGEST_NOISE_V: Final = 0.02
SCALE_TOLERANCE: Final = 0.02
LOAD_SAMPLES: Final = 40
# Of an emulated tool.
_TOOL_MM: Final = 20.0
# A torque that is known to 2 % has to be this many standard deviations high.
_MIN_NM: Final = 0.02
# Three times the noise of an e-Series' wrench in one sample: the moment is found to 20 ms.
_PRESS_NM: Final = 0.2
# Before and after a press each device has to show a level.
_LEVEL_S: Final = 1.5
_LEVEL_FRAMES: Final = 6


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    config = context.config
    if not config.fingertips and config.load_cell is None:
        return Measured(unmeasured(config))
    lines: list[Line] = []
    context.operator.act("See that nothing touches the fingertips and that the load cell carries no load")
    with ExitStack() as opened:
        fingertips = {name: opened.enter_context(context.rig.fingertip(name)) for name in config.fingertips}
        load = opened.enter_context(context.rig.load_cell()) if config.load_cell is not None else None
        for name, board in fingertips.items():
            period_s = config.fingertips[name].frame_period_s
            lines += judge_frames(
                name,
                board.take(context.counts.frames + 1, SILENT_S + period_s),
                period_s,
                context.limits.rate_tolerance,
            )
        if load is not None and config.load_cell is not None:
            lines += _weigh(context, load, config.load_cell.rate_hz)
        if not config.fingertips and not context.settings.facts.zeroes_wrench:
            # Forces that are estimated from the joints' currents are too noisy, and nothing else sees the press.
            why = f"the wrench of {context.settings.facts.name} is too noisy, and there is no fingertip"
            lines.append(Line(what="lag of the load cell", value=f"not measured: {why}"))
        else:
            lines += _clocks(context, fingertips, load)
        return Measured([*lines, *unmeasured(config)])


def unmeasured(config: DaemonConfig) -> list[Line]:
    """Return the lines on devices that no press shows, and on boards that are not configured."""
    lines: list[Line] = []
    if not config.fingertips:
        lines.append(Line(what="fingertips", value="none is configured"))
    if config.load_cell is None:
        lines.append(Line(what="load cell", value="none is configured"))
    if config.gripper is not None:
        why = "a press on the tool moves no finger"
        bound = "its error is at most the time of an exchange, which stage 2 measures, and the delay of a URCap"
        lines.append(Line(what="clock of the gripper", value=f"not measured: {why}; {bound}"))
    if config.skin is not None:
        cure = "`shearloop doctor` examines its instruments, and `shearloop skin calibrate` makes its scale"
        lines.append(Line(what="skin", value=f"not measured by a commissioning; {cure}"))
    return lines


def put_between(context: Context) -> Played:
    """Return how a tool comes between emulated fingers; without a gripper it is clamped to the wrist."""
    if context.config.gripper is None:
        return Played("the tool is clamped to the wrist")
    return Played(f"a tool of {_TOOL_MM:g} mm is put there for you", (f"object {_TOOL_MM:g}",))


def _clocks(
    context: Context, fingertips: Mapping[str, Arrivals[Frame]], load: Arrivals[LoadSample] | None
) -> list[Line]:
    """Return the lines on the clocks, with a tool in the grip that the operator presses."""
    context.operator.act("Put the tool on the load cell's lever, between the open fingers", put_between(context))
    with ExitStack() as opened:
        gripper = opened.enter_context(context.gripper()) if context.config.gripper is not None else None
        if gripper is not None:
            context.operator.allow(
                f"the fingers close onto the tool at {FINGERS_MM_PER_S:g} mm/s with at most {GRIP_N:g} N, and open "
                "after the press"
            )
            gripper.activate()
            if close_fingers(gripper, GRIP_N).diameter_mm is None:
                raise UserError("the gripper holds nothing: put the tool between its fingers, and run the stage again")
        lines = _press(context, fingertips, load)
        if gripper is not None:
            open_fingers(gripper, GRIP_N)
    return lines


def _press(
    context: Context, fingertips: Mapping[str, Arrivals[Frame]], load: Arrivals[LoadSample] | None
) -> list[Line]:
    """Ask for one press on the tool, and return the lines on the moments at which the devices saw it."""
    config = context.config
    slowest_s = max([fingertip.frame_period_s for fingertip in config.fingertips.values()], default=0.0)
    level_s = _LEVEL_S + _LEVEL_FRAMES * slowest_s
    context.operator.say(f"Keep away from the tool for {level_s:.0f} s.")
    context.observer.forget()
    begun_ns = context.clock.now_ns()
    context.observer.listen(level_s)
    context.operator.act(
        f"Press the tool about the wrist's axis, quickly and by about {_PRESS_NM:g} N·m, and keep the pressure until "
        "the next line",
        Played("it is pressed for you", (f"kick {_PRESS_NM:g}",)),
    )
    context.observer.listen(level_s)
    found = {
        name: frame_step_s(board.since(begun_ns), fingertip_table(config.fingertips[name]))
        for name, board in fingertips.items()
    }
    load_s = load_step_s(load.since(begun_ns)) if load is not None else None
    reference = "the robot's wrench", robot_step_s(context.observer.since(begun_ns))
    if not context.settings.facts.zeroes_wrench:
        name = next(iter(found))
        reference = name, found.pop(name)
    rate_hz = config.load_cell.rate_hz if config.load_cell is not None else 0.0
    return judge_clocks(reference, found, load_s, rate_hz, context.limits.clocks_s)


def judge_frames(
    name: str, frames: Sequence[Frame], period_s: float, tolerance: float = REAL.rate_tolerance
) -> list[Line]:
    """Return the lines on the frames of one fingertip that nothing touches."""
    span_s = (frames[-1].t_arrival_ns - frames[0].t_arrival_ns) / 1e9
    rate = (len(frames) - 1) / span_s * period_s
    channels = np.array([frame.channels for frame in frames])
    noise_v = float(np.median(channels.std(axis=0)))
    dead = sorted({int(number) for frame in frames for number in np.flatnonzero(frame.dead)})
    return [
        judged(
            f"rate of {name}",
            f"{rate:.3f} of the configured one",
            f"1 ± {tolerance:g}",
            "frame_period_s is right",
            passed=abs(rate - 1.0) <= tolerance,
            count=len(frames),
        ),
        judged(
            f"noise of {name}",
            f"{1e3 * noise_v:.2f} mV",
            f"at most {1e3 * LARGEST_NOISE_V:g} mV",
            "frames can be matched",
            passed=noise_v <= LARGEST_NOISE_V,
            count=len(frames),
        ),
        judged(
            f"dead channels of {name}",
            ", ".join(map(str, dead[:10])) or "none",
            "none",
            "every electrode is connected",
            passed=not dead,
            count=channels.shape[1],
        ),
    ]


def _weigh(context: Context, load: Arrivals[LoadSample], rate_hz: float) -> list[Line]:
    """Return the lines on the load cell, without and with a known torque."""
    operator = context.operator
    rest = load.take(LOAD_SAMPLES, SILENT_S)
    known_nm = operator.number(
        "Load the lever with a known torque and let it rest; its size in N·m (mass × 9.81 × arm)",
        *(_MIN_NM, 5.0),
        Played("the torque that you type is put on it for you, for instance 0.1", ("weigh {}",)),
    )
    loaded = load.take(LOAD_SAMPLES, SILENT_S)
    operator.act("Take the known torque off", Played("it is taken off for you", ("weigh 0",)))
    return judge_load(rest, loaded, known_nm, rate_hz, context.limits.rate_tolerance)


def judge_load(
    rest: Sequence[LoadSample],
    loaded: Sequence[LoadSample],
    known_nm: float,
    rate_hz: float,
    tolerance: float = REAL.rate_tolerance,
) -> list[Line]:
    """Return the lines on the load cell, at rest and with a known torque. The sign is judged in stage 7."""
    noise_nm = statistics.stdev(sample.torque_nm for sample in rest)
    rest_nm = statistics.mean(sample.torque_nm for sample in rest)
    found_nm = statistics.mean(sample.torque_nm for sample in loaded) - rest_nm
    scale = abs(found_nm) / known_nm
    rate = (len(rest) - 1) / ((rest[-1].t_arrival_ns - rest[0].t_arrival_ns) / 1e9) / rate_hz
    return [
        judged(
            "rate of the load cell",
            f"{rate:.3f} of the configured one",
            f"1 ± {tolerance:g}",
            "rate_hz is right",
            passed=abs(rate - 1.0) <= tolerance,
            count=len(rest),
        ),
        judged(
            "noise of the load cell",
            f"{1e3 * noise_nm:.2f} mN·m",
            f"at most {1e3 * known_nm * SCALE_TOLERANCE:.2f} mN·m, {SCALE_TOLERANCE:.0%} of the known torque",
            "the scale can be judged",
            passed=noise_nm <= known_nm * SCALE_TOLERANCE,
            count=len(rest),
        ),
        judged(
            "scale of the load cell",
            f"{scale:.4f} of {known_nm:g} N·m",
            f"1 ± {SCALE_TOLERANCE:g}",
            "torques are right",
            passed=math.isclose(scale, 1.0, abs_tol=SCALE_TOLERANCE),
            count=len(loaded),
        ),
    ]
