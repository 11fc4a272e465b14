"""A fingertip described by its measures, and its mesh: a rectangle or a disc.

A rectangle's mesh is a grid of lines parallel to the sides, each cell cut into two triangles; the diagonals alternate
like a chessboard, so that no direction is preferred. A disc's mesh is a square grid within a few rings. Nodes lie at
both ends of every electrode, with at most `mesh_size_cm` between neighbours along lines and rings. The current is
crowded at the boundary, so the outermost rows are halved twice.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.channels import INJECTION, ChannelTable, Injection
from shearloop.bank.errors import GeometryError
from shearloop.bank.mesh import Mesh, joined_edges

Side = Literal["left", "top", "right", "bottom"]
SIDES: tuple[Side, ...] = ("left", "top", "right", "bottom")

# The outermost rows and columns are 1/2, 1/4, 1/4 of the spacing.
_BOUNDARY_HALVINGS = 2
# Two lines nearer than this are one.
_SAME_CM = 1e-6


@dataclass(frozen=True, slots=True)
class ElectrodePlace:
    """The place of an electrode: its side of the rectangle, and the centre along that side (y or x), in cm."""

    side: Side
    centre_cm: float


@dataclass(frozen=True, slots=True)
class Outline:
    """What a drawing needs, in cm: the closed contour, and both ends of each electrode, as points (x, y)."""

    contour: list[tuple[float, float]]
    electrodes: list[tuple[tuple[float, float], tuple[float, float]]]


@dataclass(frozen=True, slots=True)
class RectangularFingertip:
    """A rectangle from (0, 0) to (width, height) with electrodes, in electrode order, along its edge.

    contact_impedance is in cm over the unit of conductivity. Raises GeometryError for electrodes that leave their side
    or overlap.
    """

    width_cm: float
    height_cm: float
    electrode_width_cm: float
    contact_impedance: float
    mesh_size_cm: float
    electrodes: tuple[ElectrodePlace, ...]
    injection: Injection = INJECTION

    def __post_init__(self) -> None:
        """Check the number of electrodes and their places."""
        _ = self.table
        for side in SIDES:
            self._check_side(side)

    @property
    def table(self) -> ChannelTable:
        """The fingertip's channels."""
        return ChannelTable(len(self.electrodes), self.injection)

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
            contact_impedance=np.full(len(self.electrodes), self.contact_impedance),
        )

    def outline(self) -> Outline:
        """Return the rectangle and its electrodes."""
        w, h = self.width_cm, self.height_cm
        electrodes = []
        for place in self.electrodes:
            start, end = self.ends_cm(place)
            across = {"left": 0.0, "right": w, "bottom": 0.0, "top": h}[place.side]
            upright = place.side in ("left", "right")
            electrodes.append(((across, start), (across, end)) if upright else ((start, across), (end, across)))
        return Outline([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)], electrodes)

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
        lines = np.append(_cut(stops, self.mesh_size_cm), stops[-1])
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
        return joined_edges(edges)


@dataclass(frozen=True, slots=True)
class RoundFingertip:
    """A disc with its lowest point at height 0, and electrodes in electrode order around it.

    angles_deg are the electrodes' centres, anticlockwise from the right; electrode_width_cm is measured along the
    edge. Raises GeometryError for electrodes that overlap.
    """

    diameter_cm: float
    electrode_width_cm: float
    contact_impedance: float
    mesh_size_cm: float
    angles_deg: tuple[float, ...]
    injection: Injection = INJECTION

    def __post_init__(self) -> None:
        """Check the number of electrodes and their places."""
        _ = self.table
        order = np.argsort(np.mod(self.angles_deg, 360.0))
        places = np.mod(self.angles_deg, 360.0)[order]
        apart_cm = np.deg2rad(np.diff(places, append=places[0] + 360.0)) * self.diameter_cm / 2
        if (near := int(apart_cm.argmin())) >= 0 and apart_cm[near] < self.electrode_width_cm + _SAME_CM:
            pair = order[near], order[(near + 1) % len(order)]
            raise GeometryError(f"electrodes {pair[0]} and {pair[1]} touch or overlap")

    @property
    def table(self) -> ChannelTable:
        """The fingertip's channels."""
        return ChannelTable(len(self.angles_deg), self.injection)

    @property
    def height_cm(self) -> float:
        """The height of the outline."""
        return self.diameter_cm

    def outline(self) -> Outline:
        """Return the disc and its electrodes, as chords."""
        radius, half = self.diameter_cm / 2, self.electrode_width_cm / self.diameter_cm

        def at(angle: float) -> tuple[float, float]:
            return radius + radius * float(np.cos(angle)), radius + radius * float(np.sin(angle))

        centres = np.deg2rad(self.angles_deg).tolist()
        around = np.linspace(0.0, 2 * np.pi, 120, endpoint=False).tolist()
        return Outline([at(angle) for angle in around], [(at(centre - half), at(centre + half)) for centre in centres])

    def mesh(self) -> Mesh:
        """Return the fingertip's mesh."""
        # A fifth of the start-up time of the page's viewer, which meshes nothing.
        from scipy.spatial import Delaunay

        radius, size = self.diameter_cm / 2, self.mesh_size_cm
        starts = np.deg2rad(self.angles_deg) - self.electrode_width_cm / self.diameter_cm
        ends = np.deg2rad(self.angles_deg) + self.electrode_width_cm / self.diameter_cm
        stops = np.sort(np.mod(np.concatenate([starts, ends]), 2 * np.pi))
        around = _cut(np.append(stops, stops[0] + 2 * np.pi), size / radius)
        n_around, n_rows = len(around), int(np.ceil(radius / size))
        spacing = radius / n_rows
        radii = radius - spacing * np.array([0.0, 0.25, 0.5, 1.0])[: n_rows + 2]
        rings = np.multiply.outer(radii, np.column_stack([np.cos(around), np.sin(around)])).reshape(-1, 2)
        line = spacing * np.arange(-n_rows, n_rows + 1)
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        # Half a spacing from the innermost ring on; the grid has few different heights and couplings.
        grid = grid[np.hypot(*grid.T) <= radii[-1] - spacing / 2 + _SAME_CM]
        nodes = radius + np.vstack([rings, grid])
        ring, place = np.divmod(_chessboard(n_around + 1, len(radii)), n_around + 1)
        innermost = n_around * (len(radii) - 1)
        within = Delaunay(nodes[innermost:]).simplices + innermost
        following = np.append(np.arange(1, n_around), 0)
        middles = around + np.diff(around, append=around[0] + 2 * np.pi) / 2
        covered = [
            np.flatnonzero(np.mod(middles - start, 2 * np.pi) < end - start)
            for start, end in zip(starts, ends, strict=True)
        ]
        edges, of_edge = joined_edges(
            [np.column_stack([covered_nodes, following[covered_nodes]]) for covered_nodes in covered]
        )
        return Mesh(
            nodes=nodes,
            triangles=np.vstack([ring * n_around + place % n_around, within]),
            electrode_edges=edges,
            electrode_of_edge=of_edge,
            contact_impedance=np.full(len(self.angles_deg), self.contact_impedance),
        )


Fingertip: TypeAlias = RectangularFingertip | RoundFingertip


def _cut(stops: FloatArray, spacing: float) -> FloatArray:
    """Return places from the first stop to before the last, at all stops and at most the spacing apart."""
    pieces = [
        np.linspace(start, end, max(1, int(np.ceil((end - start) / spacing - _SAME_CM))), endpoint=False)
        for start, end in pairwise(stops.tolist())
    ]
    return np.concatenate(pieces)


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
