"""A fingertip described by its measures, and its mesh.

The mesh is a grid of lines parallel to the sides, each cell cut into two triangles. Lines run through both ends of
every electrode, with a spacing of at most `mesh_size_cm` between them. The current is crowded at the boundary, so the
outermost rows are halved twice. The diagonals alternate like a chessboard, so that no direction is preferred.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_ELECTRODES
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.errors import GeometryError

Side = Literal["left", "top", "right", "bottom"]
SIDES: tuple[Side, ...] = ("left", "top", "right", "bottom")

# The outermost rows and columns are 1/2, 1/4, 1/4 of the spacing.
_BOUNDARY_HALVINGS = 2
# Two lines nearer than this are one.
_SAME_CM = 1e-6
# 10 µm: narrower than any electrode, wider than two lines that are one.
_LEAST_ELECTRODE_CM = 1e-3


@dataclass(frozen=True, slots=True)
class ElectrodePlace:
    """Where an electrode sits: its side of the rectangle, and the centre along that side (y or x), in cm."""

    side: Side
    centre_cm: float


@dataclass(frozen=True, slots=True)
class Fingertip:
    """A rectangle from (0, 0) to (width, height) with 32 electrodes, in electrode order, along its edge.

    contact_impedance is in cm over the unit of conductivity. Raises GeometryError for electrodes that leave their side
    or overlap.
    """

    width_cm: float
    height_cm: float
    electrode_width_cm: float
    contact_impedance: float
    mesh_size_cm: float
    electrodes: tuple[ElectrodePlace, ...]

    def __post_init__(self) -> None:
        """Check the measures."""
        for name in ("width_cm", "height_cm", "electrode_width_cm", "contact_impedance", "mesh_size_cm"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise GeometryError(f"the fingertip's {name} must be above 0, not {value:g}")
        if self.electrode_width_cm < _LEAST_ELECTRODE_CM:
            raise GeometryError(
                f"the fingertip's electrode_width_cm must be {_LEAST_ELECTRODE_CM:g} or more, not "
                f"{self.electrode_width_cm:g}"
            )
        if len(self.electrodes) != N_ELECTRODES:
            raise GeometryError(f"the fingertip has {len(self.electrodes)} electrodes, expected {N_ELECTRODES}")
        for side in SIDES:
            self._check_side(side)

    def ends_cm(self, place: ElectrodePlace) -> tuple[float, float]:
        """Return where an electrode begins and ends along its side, in cm."""
        half = self.electrode_width_cm / 2
        return place.centre_cm - half, place.centre_cm + half

    def mesh(self) -> Mesh:
        """Return the fingertip's mesh."""
        x = self._lines(("bottom", "top"), self.width_cm)
        y = self._lines(("left", "right"), self.height_cm)
        edges, of_edge = self._electrode_edges(x, y)
        across, up = np.meshgrid(x, y)
        return Mesh(
            nodes=np.column_stack([across.ravel(), up.ravel()]),
            triangles=_chessboard(len(x), len(y)),
            electrode_edges=edges,
            electrode_of_edge=of_edge,
            contact_impedance=np.full(N_ELECTRODES, self.contact_impedance),
        )

    def _check_side(self, side: Side) -> None:
        length = self.height_cm if side in ("left", "right") else self.width_cm
        numbered = [(self.ends_cm(place), e) for e, place in enumerate(self.electrodes) if place.side == side]
        end_before, before = 0.0, None
        for (start, end), electrode in sorted(numbered):
            if start < -_SAME_CM or end > length + _SAME_CM:
                raise GeometryError(
                    f"electrode {electrode} reaches from {start:g} to {end:g} cm on the {side} side, "
                    f"which is from 0 to {length:g} cm"
                )
            if before is not None and start < end_before + _SAME_CM:
                raise GeometryError(f"electrodes {before} and {electrode} on the {side} side touch or overlap")
            end_before, before = end, electrode

    def _lines(self, sides: Sequence[Side], length: float) -> FloatArray:
        ends = np.array([end for place in self.electrodes if place.side in sides for end in self.ends_cm(place)])
        inside = np.sort(ends[(ends > _SAME_CM) & (ends < length - _SAME_CM)])
        stops = np.concatenate([[0.0], inside[np.diff(inside, prepend=0.0) > _SAME_CM], [length]])
        pieces = [
            np.linspace(start, end, max(1, int(np.ceil((end - start) / self.mesh_size_cm - _SAME_CM))), endpoint=False)
            for start, end in pairwise(stops.tolist())
        ]
        lines = np.append(np.concatenate(pieces), stops[-1])
        for _ in range(_BOUNDARY_HALVINGS):
            lines = np.insert(lines, [1, len(lines) - 1], [lines[:2].mean(), lines[-2:].mean()])
        return lines

    def _electrode_edges(self, x: FloatArray, y: FloatArray) -> tuple[IntArray, IntArray]:
        number = np.arange(len(x) * len(y)).reshape(len(y), len(x))
        along = {
            "left": (y, number[:, 0]),
            "right": (y, number[:, -1]),
            "bottom": (x, number[0]),
            "top": (x, number[-1]),
        }
        edges = []
        for place in self.electrodes:
            lines, nodes = along[place.side]
            start, end = self.ends_cm(place)
            covered = nodes[(lines > start - _SAME_CM) & (lines < end + _SAME_CM)]
            edges.append(np.column_stack([covered[:-1], covered[1:]]))
        return np.vstack(edges), np.repeat(np.arange(len(edges)), [len(each) for each in edges])


def _chessboard(columns: int, rows: int) -> IntArray:
    """Return the triangles of a grid of columns × rows nodes, numbered along x first: (2 (columns−1)(rows−1), 3)."""
    i, j = np.meshgrid(np.arange(columns - 1), np.arange(rows - 1))
    lower_left = (j * columns + i).ravel()
    lower_right, upper_left = lower_left + 1, lower_left + columns
    upper_right = upper_left + 1
    rising = [lower_left, lower_right, upper_right, lower_left, upper_right, upper_left]
    falling = [lower_left, lower_right, upper_left, lower_right, upper_right, upper_left]
    even = ((i + j) % 2 == 0).ravel()[:, None]
    return np.where(even, np.column_stack(rising), np.column_stack(falling)).reshape(-1, 3)
