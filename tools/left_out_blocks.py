"""The blocks that a fit leaves out: each grip, twist or tool in turn, as rows of the recordings."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from shearloop.bank.arrays import BoolArray
from shearloop.errors import UserError
from shearloop.estimation import FrameSeries
from shearloop.estimation.grips import Grip, find_grips
from shearloop.estimation.series import distinct
from shearloop.estimation.twists import find_twists
from shearloop.estimation.values import Measured
from shearloop.tools.frame_series import Series
from shearloop.words import counted

Kind: TypeAlias = Literal["grips", "twists", "tools"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, slots=True)
class Span:
    """Rows `first` to `stop` of the recording with this number."""

    recording: int
    first: int
    stop: int


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One block left out: its name, the rows (n,) of each recording that are fitted, and the judged spans.

    `timed` are the rows that the stopwatch knows, where these are others. The gain is adapted to the span `adapted`,
    which is neither fitted nor judged.
    """

    name: str
    fitted: tuple[BoolArray, ...]
    judged: tuple[Span, ...]
    timed: tuple[BoolArray, ...] = ()
    adapted: Span | None = None


def find_blocks(kind: Kind, recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return the blocks of a kind; raises UserError for recordings that have fewer than two."""
    if kind == "twists":
        return _twists(recordings, names)
    return _grips(recordings, names) if kind == "grips" else _tools(recordings, names)


def usual_kind(recordings: Sequence[FrameSeries]) -> Kind:
    """Return the widest kind that recordings allow: tools, else grips, else twists."""
    if len(tools_of(recordings)) > 1 and all(recording.tool_mm is not None for recording in recordings):
        return "tools"
    return "grips" if number_of_grips(recordings) > 1 else "twists"


def number_of_grips(recordings: Sequence[FrameSeries]) -> int:
    """Return how many grips the recordings hold together."""
    return sum(len(find_grips(recording)) for recording in recordings)


def _grips(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each grip, with the idle frames around it: a recording, or a part of one."""
    blocks: list[Block] = []
    for number, (series, name) in enumerate(zip(recordings, names, strict=True)):
        grips = find_grips(series)
        if len(grips) == 1:
            blocks.append(_without_recordings(recordings, [number], name))
            continue
        for nth, grip in enumerate(grips, 1):
            span = Span(number, grip.idle.start, grip.released.stop)
            blocks.append(_without_span(recordings, span, f"grip {nth} of {name}"))
    if len(blocks) < 2:
        raise UserError("there is one grip, which leaves nothing to fit; record three, or use --leave-out twists")
    return blocks


def _tools(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each diameter, with all of its recordings."""
    unnamed = [name for name, recording in zip(names, recordings, strict=True) if recording.tool_mm is None]
    if unnamed:
        raise UserError(f"{unnamed[0]} does not name its tool's diameter; name it with --tool-mm")
    sizes = [recording.tool_mm.value for recording in recordings if recording.tool_mm is not None]
    tools = [tool.value for tool in tools_of(recordings)]
    if len(tools) < 2:
        raise UserError(
            f"there is one tool, of {tools[0]:.3g} mm, which leaves nothing to fit; record four tools, or use "
            "--leave-out grips or twists"
        )
    of = [min(tools, key=lambda tool: abs(tool - size)) for size in sizes]
    return [
        _without_recordings(
            recordings, [number for number, nearest in enumerate(of) if nearest == tool], f"the tool of {tool:.3g} mm"
        )
        for tool in tools
    ]


def tools_of(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the known diameters in mm of the recordings' different tools."""
    return distinct([tool for recording in recordings if (tool := recording.tool_mm) is not None])


def _without_recordings(recordings: Sequence[FrameSeries], left_out: Sequence[int], name: str) -> Block:
    fitted = tuple(np.full(len(recording.t_s), number not in left_out) for number, recording in enumerate(recordings))
    return Block(name, fitted, tuple(Span(number, 0, len(recordings[number].t_s)) for number in left_out))


def _without_span(recordings: Sequence[FrameSeries], span: Span, name: str) -> Block:
    fitted = [np.ones(len(recording.t_s), dtype=np.bool_) for recording in recordings]
    fitted[span.recording][span.first : span.stop] = False
    return Block(name, tuple(fitted), (span,))


def _twists(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each twist, from the middle between it and the one before to that between it and the next.

    The first of a grip begins with the grip, the last ends with it. A grip of one twist is left out whole.
    """
    blocks: list[Block] = []
    for number, (series, name) in enumerate(zip(recordings, names, strict=True)):
        grips = find_grips(series)
        each = [_twist_edges(series, grip) for grip in grips]
        nth = itertools.count(1)
        for grip, edges in zip(grips, each, strict=True):
            if len(edges) > 2:
                spans = [Span(number, first, stop) for first, stop in itertools.pairwise(edges)]
                blocks += [_without_span(recordings, span, f"twist {next(nth)} of {name}") for span in spans]
                continue
            rows = (grip.idle.start, grip.released.stop) if len(grips) > 1 else (0, len(series.t_s))
            without = _without_span(recordings, Span(number, *rows), f"twist {next(nth)} of {name}")
            blocks.append(replace(without, judged=(Span(number, edges[0], edges[1]),)))
    if len(blocks) < 2:
        raise UserError("there is one twist, which leaves nothing to fit; record ten")
    return blocks


def _twist_edges(series: FrameSeries, grip: Grip) -> list[int]:
    """Return the rows between which the twists of a grip lie: its begin, the middles of the pauses, its end."""
    part, torque_nm = slice(grip.idle.start, grip.released.stop), np.nan_to_num(series.torque_at_frames())
    twists = find_twists(torque_nm[part], float(np.abs(torque_nm).max(initial=0.0)))
    middles = [(int(before[-1]) + int(after[0]) + 1) // 2 for before, after in itertools.pairwise(twists)]
    return [grip.gripped.start, *(part.start + middle for middle in middles), grip.gripped.stop]


def kept(recordings: Sequence[Series], rows: Sequence[BoolArray]) -> list[Series]:
    """Return the recordings with only these rows and the torques nearest to them; drop recordings without rows."""
    found: list[Series] = []
    for recording, chosen in zip(recordings, rows, strict=True):
        if not chosen.any():
            continue
        middles = recording.t_s[:-1] + np.diff(recording.t_s) / 2
        near = chosen[np.searchsorted(middles, recording.torque_t_s)]
        found.append(
            replace(
                recording,
                t_s=recording.t_s[chosen],
                channels=recording.channels[chosen],
                diameter_mm=recording.diameter_mm[chosen],
                fingers_moved=None if recording.fingers_moved is None else recording.fingers_moved[chosen],
                torque_t_s=recording.torque_t_s[near],
                torque_nm=recording.torque_nm[near],
            )
        )
    return found


class AfterTwists(NamedTuple):
    """Blocks that are judged after the first twists of their grip, and why others have nothing left to be judged."""

    blocks: list[Block]
    not_judged: list[str]


def after_twists(blocks: Sequence[Block], recordings: Sequence[FrameSeries], n_twists: int) -> AfterTwists:
    """Return blocks that are judged after the gain is adapted to the first twists of the grip where they begin.

    These twists are neither fitted nor judged. Raises UserError where nothing remains to be judged.
    """
    grips = [find_grips(recording) for recording in recordings]
    found: list[Block] = []
    not_judged: list[str] = []
    for block in blocks:
        for span in block.judged:
            series = recordings[span.recording]
            grip = [grip for grip in grips[span.recording] if grip.idle.start <= span.first][-1]
            edges = _twist_edges(series, grip)
            n_of_grip = len(edges) - 1
            if n_of_grip <= n_twists:
                which = block.name if len(block.judged) == 1 else f"a recording of {block.name}"
                not_judged.append(
                    f"{which}, because its grip has {counted(n_of_grip, 'twist')} (one ends where the load falls "
                    f"below a tenth), and the gain is adapted to {counted(n_twists, 'twist')}"
                )
                continue
            end = edges[n_twists]
            if end >= span.stop:
                continue
            fitted = [rows.copy() for rows in block.fitted]
            # The idle frames before the grip hold no twist.
            fitted[span.recording][edges[0] : end] = False
            judged, adapted = replace(span, first=max(span.first, end)), Span(span.recording, grip.idle.start, end)
            found.append(replace(block, fitted=tuple(fitted), judged=(judged,), adapted=adapted))
    if not found:
        raise UserError(f"no grip has more than {counted(n_twists, 'twist')}: none remains to be judged; record ten")
    return AfterTwists(found, not_judged)
