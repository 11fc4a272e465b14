"""What all charts have in common: figures without a window, marks that can be told apart in grey, one way to save."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from shearloop.daemon.errors import UserError

MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "p", "h")
LINES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 1, 1, 1)))
# Far apart in lightness as well as in hue, so that a print in grey keeps them apart.
SHADES = ("#111111", "#1f5f99", "#c2571a", "#4b9560", "#8e6bb5", "#9c8b1f", "#7a7a7a", "#d08fa8")


def figure(width: float, height: float) -> Figure:
    """Return an empty figure in inches, drawn without any window or global state."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def look(number: int) -> dict[str, Any]:
    """Return mark, line and shade of the curve of this number: no two of them differ by the shade alone."""
    return {
        "marker": MARKS[number % len(MARKS)],
        "linestyle": LINES[number % len(LINES)],
        "color": SHADES[number % len(SHADES)],
    }


def frontier(costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Return the numbers of the points that no other beats in both cost and error, by rising cost."""
    order = sorted(range(len(costs)), key=lambda i: (costs[i], errors[i]))
    found: list[int] = []
    for i in order:
        if not found or errors[i] < errors[found[-1]]:
            found.append(i)
    return found


def draw_frontier(axes: Axes, costs: Sequence[float], errors: Sequence[float], reach: float) -> list[int]:
    """Mark the frontier of points by a broad pale step, up to the cost `reach`: something beats what lies above it."""
    best = frontier(costs, errors)
    x, y = [costs[i] for i in best], [errors[i] for i in best]
    axes.plot(
        [*x, reach], [*y, y[-1]], drawstyle="steps-post", color="#c8c8c8", linewidth=6, zorder=0,
        solid_capstyle="round", label="frontier: nothing is faster and as accurate",
    )  # fmt: skip
    return best


def lay_out(made: Figure) -> None:
    """Give everything in a figure its place for good: it takes a second, and would be done for each file anew."""
    made.draw_without_rendering()
    made.set_layout_engine("none")


# Where a name may stand beside its point, in points, the first ones liked best.
_NEAR, *_FURTHER = (7, 16, 26, 38)
_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
_CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
_BESIDE = [(_NEAR, 4), (_NEAR, -4), (-_NEAR, 4), (-_NEAR, -4), (0, _NEAR), (0, -_NEAR)]
_BESIDE += [(far * dx, far * dy) for far in _FURTHER for dx, dy in (*_CORNERS, *_SIDES)]
# From a name that does not stand next to its point, lest it be taken for its neighbour's.
_LEADER = {"arrowstyle": "-", "color": "0.5", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3}
_MARK_PX = 7.0
# Between two names, so that they do not read as one.
_GAP_PX = 4.0


def write_names(axes: Axes, points: Sequence[tuple[float, float, str]], fontsize: float = 7) -> None:
    """Write a name beside each point (x, y, name), where it covers neither other names nor marks nor the legend.

    To be done when limits, marks and legend are final, and `lay_out` has been.
    """
    centres = [axes.transData.transform((x, y)) for x, y, _ in points]
    taken = [Bbox([centre - _MARK_PX, centre + _MARK_PX]) for centre in centres]
    legend = axes.get_legend()
    if legend is not None:
        taken.append(legend.get_window_extent().padded(_GAP_PX))
    inside = axes.get_window_extent()
    for x, y, name in sorted(points):
        tried: list[tuple[float, int, Annotation, Bbox]] = []
        for dx, dy in _BESIDE:
            note = _note(axes, (x, y, name), (dx, dy), fontsize)
            box = note.get_window_extent()
            within = Bbox.intersection(box, inside)
            outside = _area(box) - (_area(within) if within is not None else 0.0)
            covered = sum(_area(both) for other in taken if (both := Bbox.intersection(box, other)) is not None)
            tried.append((covered + 10 * outside, len(tried), note, box))
            if tried[-1][0] == 0:
                break
        _, _, chosen, box = min(tried, key=lambda one: one[:2])
        taken.append(box.padded(_GAP_PX))
        for _, _, note, _ in tried:
            if note is not chosen:
                note.remove()
        if max(map(abs, chosen.get_position())) > _NEAR:
            # Only now: the room that a name takes is asked for without its line.
            chosen.remove()
            _note(axes, (x, y, name), chosen.get_position(), fontsize, _LEADER)


def _note(
    axes: Axes,
    point: tuple[float, float, str],
    offset: tuple[float, float],
    fontsize: float,
    line: dict[str, Any] | None = None,
) -> Annotation:
    (x, y, name), (dx, dy) = point, offset
    note = axes.annotate(
        name, (x, y), xytext=(dx, dy), textcoords="offset points", fontsize=fontsize,
        ha="center" if dx == 0 else "left" if dx > 0 else "right",
        va="center" if dx else "bottom" if dy > 0 else "top", arrowprops=line,
    )  # fmt: skip
    note.set_in_layout(False)
    return note


def _area(box: Bbox) -> float:
    return float(box.width * box.height)


def plain_log(axes: Axes) -> None:
    """Make both axes logarithmic, with 1, 2 and 5 of each decade written out."""
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        _plain_ticks(axis)


def _plain_ticks(axis: Axis) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def slug(title: str) -> str:
    """Return the part of a title before its first comma as a part of a file name."""
    return "-".join(title.split(",", maxsplit=1)[0].replace(".", " ").replace("_", " ").split()).lower()


def check_takes_pictures(directory: Path) -> None:
    """Raise UserError, before anything is measured, where no chart can be written into a directory.

    One that has to be made for that is removed again: a recording that cannot be read leaves nothing behind.
    """
    with remove_empty_folders(directory):
        try:
            directory.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=directory):
                pass
        except OSError as error:
            raise _unwritable(directory, error) from error


@contextmanager
def remove_empty_folders(directory: Path) -> Iterator[None]:
    """Remove a directory, and those above it, where they were made in here and hold nothing at the end."""
    absent = [one for one in (directory, *directory.parents) if not one.exists()]
    try:
        yield
    finally:
        for one in absent:
            # What somebody else has put into it meanwhile is theirs.
            with suppress(OSError):
                one.rmdir()


def save(made: Figure, content: Mapping[str, Any], directory: Path, name: str) -> list[Path]:
    """Write NAME.json, .svg and .png into a directory, and return the paths; UserError where that fails."""
    paths = [directory / f"{name}.{suffix}" for suffix in ("json", "svg", "png")]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(json.dumps(content, indent=1, default=_plain) + "\n", encoding="utf-8")
        for path in paths[1:]:
            made.savefig(path, dpi=130)
    except OSError as error:
        raise _unwritable(directory, error) from error
    return paths


def _unwritable(directory: Path, error: OSError) -> UserError:
    return UserError(f"{directory}: the chart cannot be written: {error.strerror}; choose another --out")


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")
