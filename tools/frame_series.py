"""Recordings as series of frames, with the tool of each and a check for copies."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from shearloop.bank.arrays import IntArray
from shearloop.daemon.recorder.schema import DIAMETER_NOTE, LARGEST_DIAMETER_MM, LOAD_DOUBT_NOTE, SIDES
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.errors import UserError
from shearloop.estimation import FrameSeries, Measured
from shearloop.estimation.learned_frames import frame_digests
from shearloop.estimation.series import names_of
from shearloop.estimation.values import is_another_tool
from shearloop.tools.recordings.frames import Recording, read_recording
from shearloop.words import counted

Series = TypeVar("Series", bound=FrameSeries)

# Fraction of the time with another grip that does not count as another tool: the fingers met something or gripped
# again.
_MOMENTARY = 0.05
# Fraction of a recording's frames that another may hold too: emulated rigs of one seed begin with the same idle frames.
_MAX_SHARED = 0.5


def read_series(
    path: str | Path, sides: str | Iterable[str] | None = None, tool_mm: float | None = None
) -> list[FrameSeries]:
    """Return the series of a recording, a list of one.

    `sides` selects a side of a recording or several, by default all; `tool_mm` is the diameter of its tool, if the
    recording does not name it. Raises UserError for anything else.
    """
    path = Path(path)
    if path.is_dir():
        raise UserError(
            f"{path} is a folder; name a recording (.mcap, from `shearloop run --record` or "
            "`shearloop recording import`)"
        )
    return [series_of(read_recording(path), None if sides is None else names_of(sides), tool_mm)]


def series_of(recording: Recording, sides: tuple[str, ...] | None = None, tool_mm: float | None = None) -> FrameSeries:
    """Return a recording's frames, several sides paired as in the daemon, at their mean time.

    Times are in seconds since the middle of the recording's first frame of the right side, or of the left one without
    a right side. This does not depend on `sides`.
    """
    known = tuple(side for side in SIDES if side in recording.sides) or tuple(recording.sides)
    wanted = sides or known
    missing = [side for side in wanted if side not in recording.sides]
    if not recording.sides:
        raise UserError(f"{recording.path} has no frames of a fingertip; record or import them with its other data")
    if missing:
        # Only frames of SIDES can be imported.
        cure = "import those files as well" if {*SIDES} >= {*missing} else "name a side that it has"
        raise UserError(
            f"{recording.path} has frames of {' and '.join(recording.sides)}, not of {' and '.join(missing)}; {cure}"
        )
    rows, unpaired = _pairs(recording, wanted)
    times = np.array([recording.sides[side].t_mid_ns[row] for side, row in zip(wanted, rows, strict=True)])
    lines = [recording.sides[side].lines[row] for side, row in zip(wanted, rows, strict=True)]
    moved = [recording.sides[side].fingers_moved[row] for side, row in zip(wanted, rows, strict=True)]
    start = int(recording.sides[known[0]].t_mid_ns[0])
    t_s = (times - start).mean(axis=0) / 1e9
    diameter_mm, gripper_mm = tool_of(recording, recording.sides[wanted[0]].t_mid_ns, tool_mm)
    return FrameSeries(
        wanted,
        t_s,
        np.stack([recording.table.channels_of_line(line) for line in lines], axis=1),
        (recording.torque_t_ns - start) / 1e9,
        recording.torque_nm,
        np.full(len(t_s), diameter_mm),
        gripper_mm,
        recording.table,
        load_doubt=recording.notes.get(LOAD_DOUBT_NOTE, ""),
        left_out=(*recording.left_out, *unpaired),
        emulated=recording.emulated,
        fingers_moved=np.stack(moved, axis=1),
        period_s=recording.periods_s.get(wanted[0], np.inf),
    )


class _FrameOfSide(NamedTuple):
    """A frame by its time and its row among the frames of its side."""

    t_mid_ns: int
    row: int


def _pairs(recording: Recording, sides: tuple[str, ...]) -> tuple[list[IntArray], list[str]]:
    """Return the rows of each side's frames that belong together, and how many frames of each side have no partner."""
    frames = [
        (side, _FrameOfSide(t_mid_ns, row))
        for side in sides
        for row, t_mid_ns in enumerate(recording.sides[side].t_mid_ns.tolist())
    ]
    pairing: FramePairing[_FrameOfSide] = FramePairing(sides, _period_s(recording, sides))
    by_time = sorted(frames, key=lambda one: one[1].t_mid_ns)
    found = [pair for side, frame in by_time if (pair := pairing.add(side, frame)) is not None]
    pairing.end()
    rows = np.array([[frame.row for frame in pair] for pair in found], dtype=np.int64).reshape(-1, len(sides))
    unpaired = [
        f"{counted(number, 'frame')} of the {side} side, without one of the others at that time"
        for side, number in pairing.unpaired.items()
        if number
    ]
    return list(rows.T), unpaired


def _period_s(recording: Recording, sides: tuple[str, ...]) -> float:
    """Return the frame period that the daemon paired by; without a daemon, of the fastest side."""
    if sides[0] in recording.periods_s:
        return recording.periods_s[sides[0]]
    steps_ns = [np.diff(recording.sides[side].t_mid_ns) for side in sides]
    return min((float(np.median(steps)) for steps in steps_ns if len(steps)), default=1.0) / 1e9


def part_of(series: Series, start: float, stop: float) -> Series:
    """Return the frames between two fractions (0 to 1) of a series, in time order; UserError for an empty part."""
    n = len(series.t_s)
    if not n:
        raise UserError("it has no frame that all of its sides share; record for longer")
    first, end = round(start * n), round(stop * n)
    if first == end:
        raise UserError(f"none of {n} frames lies between the fractions {start:g} and {stop:g}; use a longer part")
    return series.between(first, end)


def tool_of(recording: Recording, t_ns: IntArray, given_mm: float | None = None) -> tuple[float, Measured | None]:
    """Return the diameter of a recording's tool in mm, NaN if unnamed, and then the gripper's, if it has one.

    The recording's notes come first, then `given_mm`, then the gripper's width while frames were taken (at t_ns, Unix
    nanoseconds). Raises UserError where the gripper held several tools, or another one than is named, unless
    `given_mm` decides.
    """
    named_mm = _named_mm(recording)
    held = _held_mm(recording, t_ns)
    conflict = ""
    if len(held) > 1:
        conflict = f"the gripper held tools of {' and '.join(f'{tool.value:.1f}' for tool in held)} mm"
    elif held and is_another_tool(named_mm, held[0]):
        conflict = f"it names a tool of {named_mm:g} mm, and the gripper held one of {held[0].value:.1f} mm"
    if conflict and given_mm is None:
        raise UserError(
            f"{recording.path}: {conflict}; record one tool at a time, correct the experiment's `tool_mm`, or give the "
            "tool's diameter (--tool-mm, from Python `tool_mm`) if you know which it was"
        )
    if given_mm is not None and (conflict or np.isnan(named_mm)):
        return given_mm, None
    return named_mm, held[0] if held and np.isnan(named_mm) else None


def _named_mm(recording: Recording) -> float:
    text = recording.notes.get(DIAMETER_NOTE)
    if text is None:
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < LARGEST_DIAMETER_MM:
        raise UserError(f"{recording.path}: its notes give the diameter {text!r}, not a value in mm; record it again")
    return value


def _held_mm(recording: Recording, t_ns: IntArray) -> list[Measured]:
    """Return the tool that the gripper held while frames were taken, or two if it changed."""
    if not recording.tools:
        return []
    tools = [tool for _, tool in recording.tools]
    rows = np.searchsorted([since_ns for since_ns, _ in recording.tools], t_ns, side="right") - 1
    held = [tool for row in rows.tolist() if row >= 0 and (tool := tools[row]) is not None]
    if not held:
        return []
    usual = sorted(held, key=lambda tool: tool.value)[len(held) // 2]
    others = [tool for tool in held if is_another_tool(usual.value, tool)]
    return [usual] if len(others) <= _MOMENTARY * len(held) else [usual, others[len(others) // 2]]


def check_paths_differ(paths: Sequence[Path]) -> None:
    """Raise UserError for a recording or a folder that is named twice, under the same name or another."""
    known: dict[Path, Path] = {}
    for path in paths:
        first = known.setdefault(path.resolve(), path)
        if first is not path:
            also = "" if first == path else f", once as {first}"
            raise UserError(f"{path} is given twice{also}; name it once: a copy adds nothing")


def not_of_tool(series: Sequence[tuple[str, FrameSeries]], tool_mm: float | None) -> list[str]:
    """Return the recordings where a stated diameter does not count, because they name another, and why.

    Raises UserError if it counts nowhere.
    """
    tools = [(name, recording.tool_mm) for name, recording in series]
    if tool_mm is None:
        return []
    others = [(name, tool.value) for name, tool in tools if tool is not None and tool.value != tool_mm]
    if others and len(others) == len(series):
        name, diameter_mm = others[0]
        raise UserError(
            f"{name} names its tool, of {diameter_mm:g} mm, and --tool-mm {tool_mm:g} counts only where nothing names "
            "one: leave it out, or import or record again under the right diameter"
        )
    return [
        f"{name}: --tool-mm {tool_mm:g}, because the recording names its tool, of {diameter_mm:g} mm"
        for name, diameter_mm in others
    ]


def check_no_copies(series: Sequence[tuple[str, FrameSeries]]) -> None:
    """Raise UserError for named recordings that share most of their frames.

    A copy is no second measurement: intervals fitted to it are too narrow, and figures count frames twice.
    """
    known: list[tuple[str, IntArray]] = []
    for name, recording in series:
        digests = frame_digests(recording.channels)
        for other, of_other in known:
            shared = int(np.isin(digests, of_other).any(axis=1).sum())
            if shared > _MAX_SHARED * min(len(digests), len(of_other)):
                raise UserError(
                    f"{shared} of {counted(len(digests), 'frame')} of {name} are in {other} too; give one of the two: "
                    "a frame that counts twice makes intervals too narrow"
                )
        known.append((name, digests))
