"""Common parts of all charts: figures without a window, marks that differ in grey too, names of points, and files."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from shearloop.errors import UserError
from shearloop.tools.outputs import new_folder

MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "p", "h")
LINES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 1, 1, 1)))
# They differ in lightness as well as in hue, for prints in grey.
SHADES = ("#111111", "#1f5f99", "#c2571a", "#4b9560", "#8e6bb5", "#9c8b1f", "#7a7a7a", "#d08fa8")


def figure(width: float, height: float) -> Figure:
    """Return an empty figure in inches, without a window or global state."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def look(number: int) -> dict[str, Any]:
    """Return mark, line and shade of a curve by its number."""
    return {
        "marker": MARKS[number % len(MARKS)],
        "linestyle": LINES[number % len(LINES)],
        "color": SHADES[number % len(SHADES)],
    }


def frontier(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Return the indices of the points that no other beats in both cost and error, by rising cost."""
    found: list[int] = []
    for i in sorted(range(len(costs)), key=lambda i: (costs[i], errors[i])):
        if not found or errors[i] < errors[found[-1]]:
            found.append(i)
    return found


def draw_frontier(axes: Axes, costs: Sequence[float], errors: Sequence[float], reach: float) -> list[int]:
    """Draw the frontier of points as a broad pale step up to the cost `reach`; return its points' indices."""
    best = frontier(costs, errors)
    x, y = [costs[i] for i in best], [errors[i] for i in best]
    axes.plot(
        [*x, reach], [*y, y[-1]], drawstyle="steps-post", color="#c8c8c8", linewidth=6, zorder=0,
        solid_capstyle="round", label="frontier: nothing is faster and as accurate",
    )  # fmt: skip
    return best


def lay_out(made: Figure) -> None:
    """Compute a figure's layout once for all files: it takes a second."""
    made.draw_without_rendering()
    made.set_layout_engine("none")


# Offsets of a name from its point, in points, best first.
_NEAR, *_FURTHER = (7, 16, 26, 38)
_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
_CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_BESIDE = [(_NEAR, 4), (_NEAR, -4), (-_NEAR, 4), (-_NEAR, -4), (0, _NEAR), (0, -_NEAR)]
_BESIDE += [(far * dx, far * dy) for far in _FURTHER for dx, dy in (*_CORNERS, *_SIDES)]
# A line from a name that is not next to its point.
_LEADER = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
_MARK_PX = 7.0
# The gap between two names.
_GAP_PX = 4.0


def write_names(axes: Axes, points: Sequence[tuple[float, float, str]]) -> None:
    """Write a name next to each point (x, y, name), without covering other names, marks or the legend.

    Call it after `lay_out`, when limits, marks and legend are final.
    """
    centres = [axes.transData.transform((x, y)) for x, y, _ in points]
    taken = [Bbox([centre - _MARK_PX, centre + _MARK_PX]) for centre in centres]
    legend = axes.get_legend()
    if legend is not None:
        taken.append(legend.get_window_extent().padded(_GAP_PX))
    inside = axes.get_window_extent()
    for point in sorted(points):
        notes: list[Annotation] = []
        boxes: list[Bbox] = []
        costs: list[float] = []
        for offset in _BESIDE:
            note = _note(axes, point, offset)
            # The text's own extent is without the line.
            box = Text.get_window_extent(note)
            outside = _common_px(box, box) - _common_px(box, inside)
            cost = sum(_common_px(box, other) for other in taken) + 10 * outside
            notes.append(note)
            boxes.append(box)
            costs.append(cost)
            if cost == 0:
                # No later place is better, and each takes a while to measure.
                break
        best = costs.index(min(costs))
        taken.append(boxes[best].padded(_GAP_PX))
        for note in notes[:best] + notes[best + 1 :]:
            note.remove()


def _note(axes: Axes, point: tuple[float, float, str], offset: tuple[float, float]) -> Annotation:
    (x, y, name), (dx, dy) = point, offset
    note = axes.annotate(
        name, (x, y), xytext=(dx, dy), textcoords="offset points", fontsize=7,
        ha="center" if dx == 0 else "left" if dx > 0 else "right",
        va="center" if dx else "bottom" if dy > 0 else "top",
        arrowprops=_LEADER if max(abs(dx), abs(dy)) > _NEAR else None,
    )  # fmt: skip
    note.set_in_layout(False)
    # This places the text.
    note.get_window_extent()
    return note


def _common_px(one: Bbox, other: Bbox) -> float:
    """Return the area that two boxes have in common, in square pixels."""
    both = Bbox.intersection(one, other)
    return float(both.width * both.height) if both is not None else 0.0


def plain_log(axes: Axes) -> None:
    """Make both axes logarithmic, with ticks at 1, 2 and 5 of each decade."""
    axes.set(xscale="log", yscale="log")
    axis: Axis
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def slug(title: str) -> str:
    """Return the part of a title before its first comma as a part of a file name."""
    return "-".join(title.split(",", maxsplit=1)[0].replace(".", " ").replace("_", " ").split()).lower()


@contextmanager
def writing_charts(directory: Path) -> Iterator[None]:
    """Raise UserError where making a folder for charts, or writing into it, raises OSError."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{directory}: the chart cannot be written: {error.strerror}; choose another --out") from error


def save(made: Figure, content: Mapping[str, Any], directory: Path, name: str) -> list[Path]:
    """Write NAME.json, .svg and .png into a directory and return the paths; raises UserError where that fails."""
    paths = [directory / f"{name}.{suffix}" for suffix in ("json", "svg", "png")]
    with writing_charts(directory), new_folder(directory):
        paths[0].write_text(json.dumps(content, indent=1, default=_plain) + "\n", encoding="utf-8")
        for path in paths[1:]:
            made.savefig(path, dpi=130)
    return paths


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")
