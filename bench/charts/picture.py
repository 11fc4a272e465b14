"""What all charts have in common: figures without a window, marks that can be told apart in grey, one way to save."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from daemon.errors import UserError

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


def draw_frontier(axes: Axes, costs: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Mark the frontier of points by a broad pale step: what lies above and right of it, something beats."""
    best = frontier(costs, errors)
    x, y = [costs[i] for i in best], [errors[i] for i in best]
    axes.plot(
        [*x, max(costs)], [*y, y[-1]], drawstyle="steps-post", color="#c8c8c8", linewidth=6, zorder=0,
        solid_capstyle="round", label="frontier: nothing is faster and as accurate",
    )  # fmt: skip
    return best


def save(made: Figure, content: Mapping[str, Any], directory: Path, name: str) -> list[Path]:
    """Write NAME.json, .svg and .png into a directory, and return the paths; UserError where that fails."""
    paths = [directory / f"{name}.{suffix}" for suffix in ("json", "svg", "png")]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(json.dumps(content, indent=1, default=_plain) + "\n", encoding="utf-8")
        for path in paths[1:]:
            made.savefig(path, dpi=130)
    except OSError as error:
        raise UserError(f"{directory}: the chart cannot be written: {error.strerror}") from error
    return paths


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")
