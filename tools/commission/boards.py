"""Stage 6: the boards that measure the tool: rate, noise and dead channels, the load cell's scale and lag."""

import asyncio
import contextlib
import math
import statistics
import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from shearloop.daemon.commissioning import Line
from shearloop.daemon.config import FingertipConfig, LoadCellConfig
from shearloop.daemon.sensing.sessions import fingertip_table
from shearloop.drivers.connection import SerialLink
from shearloop.drivers.eit_kit import EitKit, Frame
from shearloop.drivers.load_cell import LoadSample
from shearloop.errors import UserError
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.listening import LoadCellListener
from shearloop.tools.commission.operator import Operator
from shearloop.tools.commission.report import Measured, judged

STAGE: Final = "6 boards"
RATE_TOLERANCE: Final = 0.1
# The converter's step is 0.8 mV; the paper's boards have some steps of noise.
LARGEST_NOISE_V: Final = 0.02
SCALE_TOLERANCE: Final = 0.02
LOAD_SAMPLES: Final = 40
# A torque that is known to 2 % has to be this many standard deviations high.
_LEAST_NM: Final = 0.02
_SLOW: Final = 5.0


def measure(context: Context) -> Measured:
    """Return the stage's lines."""
    config = context.config
    lines: list[Line] = []
    context.operator.act("See that nothing touches the fingertips and that the load cell carries no load")
    for name, fingertip in config.fingertips.items():
        table = fingertip_table(fingertip)
        frames = asyncio.run(_frames(fingertip, table.zero_slots, context.counts.frames))
        lines += judge_frames(name, frames, fingertip.frame_period_s)
    if config.load_cell is not None:
        lines += _load_cell(context.operator, config.load_cell)
    if not lines:
        raise UserError("the configuration has no fingertip and no load cell, so that stage 6 measures nothing")
    return Measured(lines)


async def _frames(fingertip: FingertipConfig, zero_slots: np.ndarray, count: int) -> list[Frame]:
    board = EitKit(SerialLink(**fingertip.device.model_dump()), zero_slots, fingertip.frame_period_s)
    frames: list[Frame] = []
    async with asyncio.timeout(_SLOW * fingertip.frame_period_s * (count + 5)):
        async with contextlib.aclosing(board.readings()) as readings:
            async for frame in readings:
                frames.append(frame)
                if len(frames) > count:
                    break
    return frames


def judge_frames(name: str, frames: Sequence[Frame], period_s: float) -> list[Line]:
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
            f"1 ± {RATE_TOLERANCE:g}",
            "frame_period_s is right",
            passed=abs(rate - 1.0) <= RATE_TOLERANCE,
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


def _load_cell(operator: Operator, config: LoadCellConfig) -> list[Line]:
    with LoadCellListener(config) as load:
        return _weigh(operator, load, config)


def _weigh(operator: Operator, load: LoadCellListener, config: LoadCellConfig) -> list[Line]:
    """Return the lines on the load cell, without and with a known torque."""
    rest = load.wait(time.monotonic_ns(), LOAD_SAMPLES)
    known_nm = operator.number(
        "Load the lever with a known torque and let it rest; its size in N·m (mass × 9.81 × arm)", _LEAST_NM, 5.0
    )
    loaded = load.wait(time.monotonic_ns(), LOAD_SAMPLES)
    operator.act("Take the known torque off")
    return judge_load(rest, loaded, known_nm, config.rate_hz)


def judge_load(rest: Sequence[LoadSample], loaded: Sequence[LoadSample], known_nm: float, rate_hz: float) -> list[Line]:
    """Return the lines on the load cell, at rest and with a known torque. The sign is judged in stage 7."""
    noise_nm = statistics.stdev(sample.torque_nm for sample in rest)
    found_nm = statistics.mean(one.torque_nm for one in loaded) - statistics.mean(one.torque_nm for one in rest)
    scale = abs(found_nm) / known_nm
    rate = (len(rest) - 1) / ((rest[-1].t_arrival_ns - rest[0].t_arrival_ns) / 1e9) / rate_hz
    return [
        judged(
            "rate of the load cell",
            f"{rate:.3f} of the configured one",
            f"1 ± {RATE_TOLERANCE:g}",
            "rate_hz is right",
            passed=abs(rate - 1.0) <= RATE_TOLERANCE,
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
