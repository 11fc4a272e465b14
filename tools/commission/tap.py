"""Compares the clocks of all devices by one press on the tool: each device sees the same step of the torque."""

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from shearloop.bank.channels import ChannelTable
from shearloop.daemon.commissioning_report import Line
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.load_cell import LoadSample
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.drivers.ur.poses import tool_axis
from shearloop.tools.commission.curves import scanned_step_s, step_s
from shearloop.tools.commission.limits import REAL
from shearloop.tools.commission.observer import Seen
from shearloop.tools.commission.report import judged

# HX711 data sheet, settling time: four conversions.
LONGEST_LAG_CONVERSIONS: Final = 4.0
# A press by hand takes a tenth of a second; the load cell's filter another 0.4 s.
_PRESS_S: Final = 0.1
# A moment is known where this many standard errors of it are within the limit.
_SIGMAS: Final = 3.0
RISE_S: Final = 0.6
_UNSEEN: Final = "the press is not seen"


def robot_step_s(samples: Sequence[Seen]) -> float | None:
    """Return when the torque about the tool's axis changed, in the wrench of the robot."""
    curve = [(seen.made_ns, _axial_nm(seen)) for seen in samples]
    return step_s(curve, RISE_S)


def why_hidden(samples: Sequence[Seen], at_s: float, clocks_s: float = REAL.clocks_s) -> str:
    """Return why the noise of the robot's wrench hides the moment of a weak press; empty where it does not."""
    levels = [
        [_axial_nm(seen) for seen in samples if way * (seen.made_ns / 1e9 - at_s) > 0.5 * RISE_S] for way in (-1.0, 1.0)
    ]
    before_nm, after_nm = map(statistics.fmean, levels)
    noise_nm, change_nm = max(map(statistics.stdev, levels)), abs(after_nm - before_nm)
    period_s = (samples[-1].made_ns - samples[0].made_ns) / 1e9 / (len(samples) - 1)
    # The standard error of the middle of a straight rise in white noise.
    error_s = noise_nm / change_nm * math.sqrt(_PRESS_S * period_s)
    if _SIGMAS * error_s <= clocks_s:
        return ""
    return (
        f"in the noise of the robot's wrench, {noise_nm:.2g} N·m, a press of {change_nm:.2g} N·m is known to "
        f"{1e3 * _SIGMAS * error_s:.0f} ms; a higher `rate_hz` in the robot's settings makes it more exact"
    )


def load_step_s(samples: Sequence[LoadSample]) -> float | None:
    """Return when the load cell's torque changed."""
    return step_s([(sample.t_mid_ns, sample.torque_nm) for sample in samples], RISE_S)


def resistances(samples: Sequence[SkinSample]) -> list[tuple[int, tuple[float, float]]]:
    """Return the times in ns and both resistances in Ω of a skin's readings that have no fault."""
    return [
        (sample.t_mid_ns, (sample.r1_ohm, sample.r2_ohm))
        for sample in samples
        if sample.r1_ohm is not None and sample.r2_ohm is not None
    ]


def skin_step_s(samples: Sequence[SkinSample]) -> float | None:
    """Return when the ratio of the gauges' resistances changed."""
    return step_s([(t_ns, math.log(r1_ohm / r2_ohm)) for t_ns, (r1_ohm, r2_ohm) in resistances(samples)], RISE_S)


def frame_step_s(frames: Sequence[Frame], table: ChannelTable) -> float | None:
    """Return when the channels of a fingertip changed: a frame measures one injection after the other."""
    if len(frames) < 4:
        return None
    fractions = (table.electrodes[:, 0] + 0.5) / table.n_electrodes
    begun_s = np.array([frame.t_begin_ns for frame in frames]) / 1e9
    took_s = np.array([2 * (frame.t_mid_ns - frame.t_begin_ns) for frame in frames]) / 1e9
    times_s = begun_s[:, None] + took_s[:, None] * fractions
    return scanned_step_s(times_s, np.array([frame.channels for frame in frames]))


def _axial_nm(seen: Seen) -> float:
    axis = tool_axis(seen.outputs.tcp_pose)
    return sum(one * other for one, other in zip(axis, seen.outputs.wrench[3:], strict=True))


def judge_clocks(
    reference: tuple[str, float | None],
    boards: Mapping[str, float | None],
    load_s: float | None,
    rate_hz: float,
    clocks_s: float = REAL.clocks_s,
) -> list[Line]:
    """Return the lines on when the devices saw a press, compared with a reference device.

    `boards` are those without a lag, by their names.
    """
    name, at_s = reference
    lines = [
        judged(
            f"clock of {board}",
            _offset(found_s, at_s, name),
            f"within {1e3 * clocks_s:g} ms",
            "measurements of one moment are compared",
            passed=found_s is not None and at_s is not None and abs(found_s - at_s) <= clocks_s,
        )
        for board, found_s in boards.items()
    ]
    if rate_hz > 0:
        longest_s = LONGEST_LAG_CONVERSIONS / rate_hz + clocks_s
        lines.append(
            judged(
                "lag of the load cell",
                _offset(load_s, at_s, name),
                f"{-1e3 * clocks_s:g} to {1e3 * longest_s:.0f} ms, {LONGEST_LAG_CONVERSIONS:g} conversions and "
                f"{1e3 * clocks_s:g} ms",
                "its filter alone delays its torques",
                passed=load_s is not None and at_s is not None and -clocks_s <= load_s - at_s <= longest_s,
            )
        )
    return lines


def _offset(found_s: float | None, at_s: float | None, name: str) -> str:
    if at_s is None:
        return f"{_UNSEEN} by {name}"
    return _UNSEEN if found_s is None else f"{1e3 * (found_s - at_s):+.0f} ms behind {name}"
