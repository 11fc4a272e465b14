"""Stage 6: the boards that measure the tool: rate, noise and dead channels, the load cell's scale and lag, clocks."""

import math
import statistics
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

import numpy as np

from shearloop.daemon.commissioning_report import Line
from shearloop.daemon.config import DaemonConfig, SkinConfig
from shearloop.daemon.sensing.skin_task import tool_radius_m
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.load_cell import CAPACITY_NM, LoadSample
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.errors import UserError
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.fingers import FINGERS_MM_PER_S, GRIP_N, close_fingers, open_fingers
from shearloop.tools.commission.limits import REAL
from shearloop.tools.commission.listening import SILENT_S
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged
from shearloop.tools.commission.skin import (
    SKIN,
    judge_pressed,
    judge_skin,
    largest_shear_n,
    read_at_rest,
    why_not_timed,
)
from shearloop.tools.commission.tap import (
    frame_step_s,
    judge_clocks,
    load_step_s,
    robot_step_s,
    skin_step_s,
    why_hidden,
)
from shearloop.tools.fingertip_table import fingertip_table

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


@dataclass(frozen=True, slots=True)
class Boards:
    """The boards that show the moment of a press on the tool."""

    fingertips: Mapping[str, Arrivals[Frame]]
    load: Arrivals[LoadSample] | None
    skin: Arrivals[SkinSample] | None

    @property
    def without_lag(self) -> list[str]:
        """The names of the devices with a judged clock: all but the load cell, because its filter delays it."""
        return [*self.fingertips, *([SKIN] if self.skin is not None else [])]

    @property
    def lines(self) -> list[str]:
        """The names of the lines on their moments."""
        lag = ["lag of the load cell"] if self.load is not None else []
        return [*(f"clock of {name}" for name in self.without_lag), *lag]


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    config = context.config
    lines: list[Line] = []
    context.operator.act(f"See that {' and that '.join(_unloaded(config))}")
    with ExitStack() as opened:
        fingertips = {name: opened.enter_context(context.rig.fingertip(name)) for name in config.fingertips}
        load = opened.enter_context(context.rig.load_cell()) if config.load_cell is not None else None
        skin = opened.enter_context(context.rig.skin()) if config.skin is not None else None
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
        if skin is not None and config.skin is not None:
            at_rest, why = _feel(context, skin, config.skin)
            lines += at_rest
            if why:
                lines.append(Line(what=f"clock of {SKIN}", value=f"not measured: {why}"))
                skin = None
        seen_by = Boards(fingertips, load, skin)
        facts = context.settings.facts
        if seen_by.lines and (facts.zeroes_wrench or (seen_by.without_lag and len(seen_by.lines) > 1)):
            lines += _clocks(context, seen_by)
        else:
            # Forces that are estimated from the joints' currents are too noisy, and no other device sees the press.
            why = f"not measured: the wrench of {facts.name} is too noisy, and no other clock is there to compare with"
            lines += [Line(what=what, value=why) for what in seen_by.lines]
        return Measured([*lines, *unmeasured(config)])


def _unloaded(config: DaemonConfig) -> list[str]:
    """Return what the operator has to see before the boards are measured at rest."""
    untouched = []
    if config.fingertips:
        untouched.append("the fingertips")
    if config.skin is not None:
        untouched.append("the skin")
    seen = []
    if untouched:
        seen.append(f"nothing touches {' and '.join(untouched)}")
    if config.load_cell is not None:
        seen.append("the load cell carries no load")
    return seen


def unmeasured(config: DaemonConfig) -> list[Line]:
    """Return the lines on devices that no press shows, and on boards that are not configured."""
    lines: list[Line] = []
    if not config.fingertips:
        lines.append(Line(what="fingertips", value="none is configured"))
    if config.load_cell is None:
        lines.append(Line(what="load cell", value="none is configured"))
    if config.skin is None:
        lines.append(Line(what="skin", value="none is configured"))
    if config.gripper is not None:
        why = "a press on the tool moves no finger"
        bound = "its error is at most the time of an exchange, which stage 2 measures, and the delay of a URCap"
        lines.append(Line(what="clock of the gripper", value=f"not measured: {why}; {bound}"))
    return lines


def put_between(context: Context) -> Played:
    """Return how a tool comes between emulated fingers; without a gripper it is clamped to the wrist."""
    if context.config.gripper is None:
        return Played("the tool is clamped to the wrist")
    return Played(f"a tool of {_TOOL_MM:g} mm is put there for you", (f"object {_TOOL_MM:g}",))


def _clocks(context: Context, boards: Boards) -> list[Line]:
    """Return the lines on the clocks, with a tool in the grip that the operator presses."""
    config = context.config
    places = [
        *(["on the load cell's lever"] if config.load_cell is not None else []),
        *(["on the skin"] if config.skin is not None else []),
        "between the open fingers" if config.gripper is not None else "in the clamp at the wrist",
    ]
    context.operator.act(f"Put the tool {', '.join(places)}", put_between(context))
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
        lines = _press(context, boards)
        if gripper is not None:
            open_fingers(gripper, GRIP_N)
    return lines


def _press(context: Context, boards: Boards) -> list[Line]:
    """Ask for one press on the tool, and return the lines on when the devices saw it."""
    config = context.config
    periods_s = [fingertip.frame_period_s for fingertip in config.fingertips.values()]
    if config.skin is not None:
        periods_s.append(1.0 / config.skin.daq.rate_hz)
    slowest_s = max(periods_s, default=0.0)
    level_s = _LEVEL_S + _LEVEL_FRAMES * slowest_s
    context.operator.say(f"Keep away from the tool for {level_s:.0f} s.")
    context.observer.forget()
    begun_ns = context.clock.now_ns()
    context.observer.listen(level_s)
    press_nm, bound = _strength(config)
    context.operator.act(
        f"Press the tool about the wrist's axis, quickly and by about {press_nm:.2g} N·m{bound}, and keep the pressure "
        "until the next line",
        Played("it is pressed for you", (f"kick {press_nm:.2g}",)),
    )
    context.observer.listen(level_s)
    found = {
        name: frame_step_s(board.since(begun_ns), fingertip_table(config.fingertips[name]))
        for name, board in boards.fingertips.items()
    }
    load_s = load_step_s(boards.load.since(begun_ns)) if boards.load is not None else None
    lines = []
    if boards.skin is not None and config.skin is not None:
        readings = boards.skin.since(begun_ns)
        found[SKIN] = skin_s = skin_step_s(readings)
        if skin_s is not None:
            lines.append(judge_pressed(readings, skin_s, load_calibration(config.skin.calibration)))
    states = context.observer.since(begun_ns)
    at_s, reference = robot_step_s(states), "the robot's wrench"
    if not context.settings.facts.zeroes_wrench:
        reference = next(iter(found))
        at_s = found.pop(reference)
    elif press_nm < _PRESS_NM and at_s is not None and None not in found.values():
        why = why_hidden(states, at_s, context.limits.clocks_s)
        if why:
            return [*(Line(what=what, value=f"not measured: {why}") for what in boards.lines), *lines]
    rate_hz = config.load_cell.rate_hz if config.load_cell is not None else 0.0
    return [*judge_clocks((reference, at_s), found, load_s, rate_hz, context.limits.clocks_s), *lines]


def _strength(config: DaemonConfig) -> tuple[float, str]:
    """Return the torque of the press in N·m, and in words the largest force on the skin."""
    if config.skin is None:
        return _PRESS_NM, ""
    largest_n = largest_shear_n(load_calibration(config.skin.calibration), config.skin.normal_n)
    radius_m = tool_radius_m(config.skin)
    press_nm = _PRESS_NM if radius_m is None else min(_PRESS_NM, largest_n * radius_m)
    return press_nm, f", with at most {largest_n:.1f} N on the skin"


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


def _feel(context: Context, skin: Arrivals[SkinSample], config: SkinConfig) -> tuple[list[Line], str]:
    """Return the lines on the skin, which nothing touches, and why it does not show the moment of a press."""
    rate_hz, limits = config.daq.rate_hz, context.limits
    readings = read_at_rest(skin, rate_hz)
    lines = judge_skin(readings, rate_hz, load_calibration(config.calibration), limits.rate_tolerance)
    return lines, why_not_timed(readings, rate_hz, limits.clocks_s)


def _weigh(context: Context, load: Arrivals[LoadSample], rate_hz: float) -> list[Line]:
    """Return the lines on the load cell, without and with a known torque."""
    operator = context.operator
    rest = load.take(LOAD_SAMPLES, SILENT_S)
    known_nm = operator.number(
        "Load the lever with a known torque and let it rest; its size in N·m (mass × 9.81 × arm)",
        *(_MIN_NM, CAPACITY_NM),
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
