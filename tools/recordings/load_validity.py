"""Validity of recorded load values: those of a damaged line, of a line that hung, or of another unit are invalid."""

from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.drivers.defaults import LOAD_CELL_RATE_HZ
from shearloop.drivers.load_cell import CAPACITY_NM, SLEW_NM_PER_S, STUCK_AFTER
from shearloop.drivers.serial_sensor import SETTLE_VALUES, StepFilter
from shearloop.errors import UserError
from shearloop.estimation.twists import runs
from shearloop.words import counted

# A cable damages fewer values than this fraction: the two recorded cases are one load value in a hundred.
MAX_DAMAGED = 0.1
# Damaged values occur singly. This number in a row is a twist, in another unit.
_MAX_IN_A_ROW = 4
# The rig may be knocked. It does not jump more often than this to another torque.
_MAX_STEPS = 3
# The quietest recorded cell has a noise of 14 µN·m. Its values stand 20 times in a row if they are rounded to 50 µN·m,
# and at most 3 times if they are rounded to 20 µN·m.
_COARSE_NM = 2.5e-5
# Differences of rounded values are multiples of the step, within this fraction of it and but for this fraction of them.
_OFF_GRID, _MAX_OFF_GRID, _CANDIDATES = 0.05, 0.1, 5
# Values that differ by less were rounded to the same one.
_SAME_NM = 1e-9
# A line that hung goes on at another torque, further away than the load changes elsewhere between two values.
_HUNG_JUMP = 2.0
# A stray value differs from the values around it by more than this number of standard deviations of the noise, of
# steps of the values around it, and of steps of rounding, and by more than the last number in N·m.
_STRAY_NOISE, _STRAY_STEPS, _STRAY_ROUNDING, _STRAY_NM = 40.0, 4.0, 2.5, 5e-4
STRAY = "leave the values around them and come back at once: spikes of a damaged line"
# Steps on either side that show how fast the load moves.
_STEPS_AROUND = 4
# Values further apart than this number of periods are no neighbours.
_NEIGHBOUR_PERIODS = 3.0
# In a longer time the rig can turn to another torque and back.
_LONGEST_STRAY_S = 0.5


def valid_load(path: Path, unix_s: FloatArray, torque_nm: FloatArray) -> tuple[IntArray, list[str]]:
    """Return the rows of valid values by rising time, and clauses that count the others by cause.

    Raises UserError for values of another unit.
    """
    n = counted(len(torque_nm), "load value")
    left_out: list[str] = []

    def leave_out(rows: IntArray, invalid: BoolArray, why: str) -> IntArray:
        if invalid.any():
            left_out.append(f"{np.count_nonzero(invalid)} of {n} {why}")
        return rows[~invalid]

    _check_unit(path, torque_nm)
    rows = np.arange(len(torque_nm))
    rows = leave_out(rows, np.abs(torque_nm) > CAPACITY_NM, f"beyond {CAPACITY_NM:g} N·m, which a damaged line sends")
    period_s = float(np.median(np.diff(np.sort(unix_s)))) if len(unix_s) > 1 else 0.0
    # A stream that is faster than the cell repeats each of its values. The daemon counts alike.
    in_time = round(STUCK_AFTER / (period_s * LOAD_CELL_RATE_HZ)) if period_s > 0.0 else 0
    stuck_after = max(STUCK_AFTER, in_time)
    hung = f"that stood {stuck_after} times or more in a row: the load cell's line or board hung"
    if len(torque_nm) and (torque_nm == torque_nm[0]).all():
        hung = f"that are all {torque_nm[0]:g} N·m: the load cell's line or board hung, or no load was on it"
    rows = leave_out(rows, stuck_values(torque_nm, stuck_after)[rows], hung)
    rows = rows[np.argsort(unix_s[rows], kind="stable")]
    spikes = np.array(_spikes(unix_s[rows], torque_nm[rows], period_s), dtype=np.bool_)
    _check_spikes(path, torque_nm[rows], spikes)
    rows = leave_out(rows, spikes, f"that jump by more than {SLEW_NM_PER_S:g} N·m/s: spikes of a damaged line")
    stray = stray_values(unix_s[rows], torque_nm[rows])
    rows = leave_out(rows, stray, f"that {STRAY}")
    return rows, left_out


def rounding_step_nm(torque_nm: FloatArray) -> float:
    """Return the step in N·m to which (n,) values are rounded, 0 without one above the cell's noise."""
    apart_nm = np.diff(np.unique(torque_nm))
    apart_nm = apart_nm[apart_nm > _SAME_NM]
    # The smallest differences may be of damaged values.
    for step_nm in np.unique(np.round(apart_nm, 9))[:_CANDIDATES]:
        multiples = apart_nm / step_nm
        off_grid = float(np.mean(np.abs(multiples - np.maximum(np.round(multiples), 1.0)) > _OFF_GRID))
        if step_nm > _COARSE_NM and off_grid <= _MAX_OFF_GRID:
            return float(step_nm)
    return 0.0


def stuck_values(torque_nm: FloatArray, stuck_after: int) -> BoolArray:
    """Return which of (n,) values stood this many times in a row because the line hung.

    Rounded values stand in a row while the load rests or moves slowly.
    """
    edges = np.flatnonzero(np.diff(torque_nm)) + 1
    begins, ends = np.append(0, edges), np.append(edges, len(torque_nm))
    is_long = ends - begins >= stuck_after
    if is_long.any() and rounding_step_nm(torque_nm):
        steps_nm = np.abs(np.diff(torque_nm, prepend=torque_nm[0], append=torque_nm[-1]))
        after_long = np.append(False, is_long[:-1])
        usual_nm = steps_nm[begins[~after_long]].max(initial=0.0)
        is_long &= steps_nm[ends] > _HUNG_JUMP * max(usual_nm, rounding_step_nm(torque_nm))
    return np.repeat(is_long, ends - begins)


def stray_values(t_s: FloatArray, torque_nm: FloatArray) -> BoolArray:
    """Return which of (n,) values by rising time leave the values around them and come back at once.

    One value does, or two: the daemon takes three for a new torque.
    """
    n = len(torque_nm)
    is_stray = np.zeros(n, dtype=np.bool_)
    if n < 2 * _STEPS_AROUND:
        return is_stray
    noise_nm = 1.4826 * float(np.median(np.abs(np.diff(torque_nm, 2)))) / np.sqrt(6.0)
    least_nm = max(_STRAY_NOISE * noise_nm, _STRAY_ROUNDING * rounding_step_nm(torque_nm), _STRAY_NM)
    moves_nm = median_filter(np.abs(np.diff(torque_nm)), 2 * _STEPS_AROUND + 1, mode="nearest")
    period_s = float(np.median(np.diff(t_s)))
    for width in range(1, SETTLE_VALUES):
        first = np.arange(1, n - width)
        before, after = torque_nm[first - 1], torque_nm[first + width]
        values = np.array([torque_nm[first + k] for k in range(width)])
        above_nm = values.min(axis=0) - np.maximum(before, after)
        below_nm = np.minimum(before, after) - values.max(axis=0)
        around_nm = _STRAY_STEPS * np.minimum(moves_nm[first - 1], moves_nm[first + width - 1])
        limit_nm = np.maximum(np.maximum(around_nm, least_nm), np.abs(after - before))
        longest_s = min((width + 1) * _NEIGHBOUR_PERIODS * period_s, _LONGEST_STRAY_S)
        are_neighbours = t_s[first + width] - t_s[first - 1] <= longest_s
        for at in first[are_neighbours & (np.maximum(above_nm, below_nm) > limit_nm)]:
            is_stray[at : at + width] = True
    return is_stray


def _check_unit(path: Path, torque_nm: FloatArray) -> None:
    """Raise UserError where (n,) torques have another unit: more are too large for the cell than a cable damages."""
    is_beyond = np.abs(torque_nm) > CAPACITY_NM
    beyond = int(np.count_nonzero(is_beyond))
    in_a_row = max((end - first for first, end in runs(is_beyond)), default=0)
    if beyond > max(2, MAX_DAMAGED * len(torque_nm)) or in_a_row > _MAX_IN_A_ROW:
        raise UserError(
            f"{path}: {beyond} of {counted(len(torque_nm), 'load value')} are beyond {CAPACITY_NM:g} N·m, the capacity "
            "of the rig's load cell, so they have another unit; write them in N·m"
        )


def _check_spikes(path: Path, torque_nm: FloatArray, spikes: BoolArray) -> None:
    """Raise UserError where (n,) torques by rising time jump too often to be spikes of a damaged line."""
    steps = _kept_steps(torque_nm, spikes)
    found = int(np.count_nonzero(spikes))
    if steps <= _MAX_STEPS and found <= max(2, MAX_DAMAGED * len(torque_nm)):
        return
    raise UserError(
        f"{path}: {found} of {counted(len(torque_nm), 'load value')} jump by more than {SLEW_NM_PER_S:g} N·m/s, which "
        f"the rig cannot do, and in {counted(steps, 'place')} the load stays there, so they have another unit or their "
        "times are wrong; write them in N·m, at their times"
    )


def _kept_steps(torque_nm: FloatArray, spikes: BoolArray) -> int:
    """Return how many runs of spikes (n,) are steps: the torque after them is nearer to them than to that before."""
    steps = 0
    for first, end in runs(spikes):
        if first > 0 and end < len(spikes) and end - first >= SETTLE_VALUES - 1:
            before_nm, last_nm, after_nm = torque_nm[first - 1], torque_nm[end - 1], torque_nm[end]
            steps += bool(abs(after_nm - last_nm) < abs(after_nm - before_nm))
    return steps


def _spikes(unix_s: FloatArray, torque_nm: FloatArray, period_s: float) -> list[bool]:
    """Return which values (n,) by rising time are spikes, as the daemon judges them."""
    levels = StepFilter[tuple[float, float]]()

    def is_reachable(before: tuple[float, float], after: tuple[float, float]) -> bool:
        (before_s, before_nm), (after_s, after_nm) = before, after
        # A stream that is faster than the cell shows a change between two measurements in one step.
        elapsed_s = max(after_s - before_s, period_s, 1.0 / LOAD_CELL_RATE_HZ)
        return abs(after_nm - before_nm) <= SLEW_NM_PER_S * elapsed_s

    return [levels.is_spike(value, is_reachable) for value in zip(unix_s.tolist(), torque_nm.tolist(), strict=True)]
