"""The geometry of a sensor: a triangle mesh with electrodes on its boundary edges."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import GeometryError
from shearloop.bank.matlab_file import Struct, read_variables
from shearloop.files import open_file, refusing_damage
from shearloop.words import counted

# A triangle with a smaller area over its longest edge squared is an error of the mesh.
_THINNEST = 1e-8
_MAX_NODES = 1e9
_FARTHEST_CM = 1e6
# The unit of coordinates in the digest: far below any mesh size, far above rounding.
_DIGEST_UNIT_CM = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A triangle mesh with electrodes, checked when it is made; its arrays are read-only.

    nodes (N, 2) in cm; triangles (T, 3) node numbers, in either orientation; electrode_edges (E, 2) node numbers of
    boundary edges; electrode_of_edge (E,) electrode number of each; contact_impedance (L,) of each electrode, in cm
    over the unit of conductivity. Raises GeometryError for a mesh that the equations cannot be solved on.
    """

    nodes: FloatArray
    triangles: IntArray
    electrode_edges: IntArray
    electrode_of_edge: IntArray
    contact_impedance: FloatArray

    def __post_init__(self) -> None:
        """Take read-only copies and check them."""
        for name, dtype, shape in (
            ("nodes", np.float64, (-1, 2)),
            ("triangles", np.int64, (-1, 3)),
            ("electrode_edges", np.int64, (-1, 2)),
            ("electrode_of_edge", np.int64, (-1,)),
            ("contact_impedance", np.float64, (-1,)),
        ):
            object.__setattr__(self, name, _array(getattr(self, name), name, dtype, shape))
        _check_nodes(self)
        _check_triangles(self)
        _check_electrodes(self)

    @property
    def n_electrodes(self) -> int:
        """The number of electrodes."""
        return len(self.contact_impedance)

    @property
    def height_cm(self) -> float:
        """The extent along y, in cm."""
        return float(np.ptp(self.nodes[:, 1]))

    @property
    def digest(self) -> str:
        """The sha256 of the geometry in hexadecimal, the same on all machines and for all file formats."""
        edges = np.column_stack([self.electrode_of_edge, np.sort(self.electrode_edges, axis=1)])
        digest = hashlib.sha256(b"shearloop geometry 1")
        for part in (
            np.rint(self.nodes / _DIGEST_UNIT_CM),
            self.triangles,
            edges[np.lexsort(edges.T[::-1])],
            np.rint(self.contact_impedance / _DIGEST_UNIT_CM),
        ):
            digest.update(np.array(part.shape, dtype="<i8").tobytes())
            digest.update(part.astype("<i8").tobytes())
        return digest.hexdigest()

    def refined(self) -> "Mesh":
        """Return the mesh with every triangle cut into four; the children of triangle t are 4t … 4t + 3."""
        n = len(self.nodes)
        pairs, of_side = _edges(self.triangles)
        (a, b, c), (ab, bc, ca) = self.triangles.T, n + of_side.T
        children = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1)
        edges = np.sort(self.electrode_edges, axis=1)
        halves = n + rows_of_edges(edges, pairs, n)
        return Mesh(
            nodes=np.vstack([self.nodes, self.nodes[pairs].mean(axis=1)]),
            triangles=children.reshape(-1, 3),
            electrode_edges=np.stack([edges[:, 0], halves, halves, edges[:, 1]], axis=1).reshape(-1, 2),
            electrode_of_edge=np.repeat(self.electrode_of_edge, 2),
            contact_impedance=self.contact_impedance,
        )


def boundary_edges(triangles: IntArray) -> IntArray:
    """Return the (B, 2) edges that belong to one triangle only, each with the smaller node number first."""
    edges, of_side = _edges(triangles)
    found: IntArray = edges[np.bincount(of_side.ravel()) == 1]
    return found


def doubled_areas(nodes: FloatArray, triangles: IntArray) -> FloatArray:
    """Return twice the signed area of every triangle, (T,), in cm²."""
    a, b, c = np.moveaxis(nodes[triangles], 1, 0)
    u, v = b - a, c - a
    twice: FloatArray = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return twice


def load_mesh(path: str | Path) -> Mesh:
    """Read a fingertip's mesh from an npz file (the fields of `Mesh`) or an EIDORS model (.mat, variable `mdl`).

    Raises GeometryError, with the file's name, for a file that is missing, truncated, foreign or not of a fingertip.
    """
    path = Path(path)
    damage = "the file is truncated or damaged ({}); fetch it or save it again, from MATLAB with `save -v6`"
    with refusing_damage(path, GeometryError, "the mesh", damage):
        with open_file(path) as file:
            start = file.read(8)
        if start.startswith(b"PK"):
            fields = _npz_fields(path)
        elif start.startswith(b"MATLAB"):
            fields = _eidors_fields(path)
        else:
            raise GeometryError(
                f"{path} is not a mesh: expected an .npz file with the arrays {', '.join(_FIELDS)}, "
                "or an EIDORS model saved from MATLAB or Octave with `save -v6`"
            )
    try:
        return Mesh(**fields)
    except GeometryError as error:
        raise GeometryError(f"{path}: {error}") from error


_FIELDS = tuple(Mesh.__dataclass_fields__)


def _npz_fields(path: Path) -> dict[str, Any]:
    with open_file(path) as file, np.load(file, allow_pickle=False) as archive:
        missing = [name for name in _FIELDS if name not in archive.files]
        if missing:
            raise GeometryError(f"{path}: the mesh lacks {', '.join(missing)}; it has {', '.join(archive.files)}")
        return {name: archive[name] for name in _FIELDS}


def _eidors_fields(path: Path) -> dict[str, Any]:
    with open_file(path) as file:
        models = read_variables(file.read()).get("mdl")
    try:
        [model] = models if isinstance(models, Struct) else []
        electrodes: Any = model["electrode"]
        impedance = np.array([np.asarray(electrode["z_contact"], np.float64).item() for electrode in electrodes])
        nodes, triangles = np.asarray(model["nodes"], np.float64), _numbers(model["elems"])
        members = [_numbers(electrode["nodes"]).ravel() for electrode in electrodes]
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise GeometryError(
            f"{path}: expected an EIDORS forward model in the variable `mdl`, with nodes, elems and "
            f"electrode(…).nodes and .z_contact ({error})"
        ) from error
    if triangles.shape[1:] != (3,):
        raise GeometryError(f"{path}: the EIDORS model is not of triangles: elems has shape {triangles.shape}")
    # The boundary edges between an electrode's nodes are its own, as EIDORS reads them.
    boundary = boundary_edges(triangles)
    edges, of_edge = joined_edges(
        [boundary[np.isin(boundary, electrode_nodes).all(axis=1)] for electrode_nodes in members]
    )
    return dict(zip(_FIELDS, (nodes, triangles, edges, of_edge, impedance), strict=True))


def _numbers(values: Any) -> IntArray:
    """Return MATLAB's numbers of nodes, which begin with 1, as ours; raises ValueError for other numbers."""
    found = np.asarray(values, np.float64)
    if not (np.abs(found) < _MAX_NODES).all() or (found % 1).any():
        raise ValueError("the number of a node is not whole")
    return found.astype(np.int64) - 1


def joined_edges(edges: list[IntArray]) -> tuple[IntArray, IntArray]:
    """Return the (E, 2) edges of all electrodes, and the electrode (E,) of each edge."""
    return np.vstack(edges), np.repeat(np.arange(len(edges)), [len(electrode_edges) for electrode_edges in edges])


def _array(values: ArrayLike, name: str, dtype: type, shape: tuple[int, ...]) -> NDArray[Any]:
    found = np.asarray(values)
    fits = found.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, found.shape, strict=True))
    if not fits or found.size == 0:
        wanted = " × ".join("any" if size == -1 else str(size) for size in shape)
        raise GeometryError(f"{name} has shape {found.shape}, expected {wanted}")
    if found.dtype.kind not in "iuf" or (dtype is np.int64 and found.dtype.kind == "f"):
        raise GeometryError(f"{name} holds {found.dtype}, expected {'integers' if dtype is np.int64 else 'numbers'}")
    copy: NDArray[Any] = found.astype(dtype)
    copy.setflags(write=False)
    return copy


def _check_nodes(mesh: Mesh) -> None:
    near = (np.abs(mesh.nodes) < _FARTHEST_CM).all(axis=1)
    if not near.all():
        raise GeometryError(f"node {int(np.flatnonzero(~near)[0])} is not finite, or beyond {_FARTHEST_CM:g} cm")
    for name, array in (("triangles", mesh.triangles), ("electrode_edges", mesh.electrode_edges)):
        if array.min() < 0 or array.max() >= len(mesh.nodes):
            raise GeometryError(
                f"{name} names nodes {array.min()} to {array.max()}, but the nodes are numbered 0 to "
                f"{len(mesh.nodes) - 1}"
            )


def _check_triangles(mesh: Mesh) -> None:
    corners = mesh.nodes[mesh.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    thin = np.abs(doubled_areas(mesh.nodes, mesh.triangles)) <= 2 * _THINNEST * longest**2
    if thin.any():
        which, count = int(np.flatnonzero(thin)[0]), counted(int(thin.sum()), "degenerate triangle")
        raise GeometryError(f"{count}: triangle {which} with nodes {mesh.triangles[which].tolist()} has no area")
    links = sp.coo_array(
        (np.ones(mesh.triangles.size), (mesh.triangles.ravel(), np.roll(mesh.triangles, 1, axis=1).ravel())),
        shape=(len(mesh.nodes), len(mesh.nodes)),
    )
    pieces, _ = connected_components(links, directed=False)
    if pieces != 1:
        raise GeometryError(f"the mesh falls into {pieces} pieces that are not connected (or has nodes in no triangle)")


def _check_electrodes(mesh: Mesh) -> None:
    if mesh.electrode_of_edge.shape != mesh.electrode_edges.shape[:1]:
        raise GeometryError(
            f"electrode_of_edge has {len(mesh.electrode_of_edge)} entries for {len(mesh.electrode_edges)} edges"
        )
    missing = np.setdiff1d(np.arange(mesh.n_electrodes), mesh.electrode_of_edge)
    foreign = np.setdiff1d(mesh.electrode_of_edge, np.arange(mesh.n_electrodes))
    if missing.size or foreign.size:
        raise GeometryError(
            f"the {mesh.n_electrodes} electrodes are numbered from 0: without an edge are {missing.tolist()}, "
            f"unknown are {foreign.tolist()}"
        )
    if not (np.isfinite(mesh.contact_impedance) & (mesh.contact_impedance > 0)).all():
        raise GeometryError(f"contact impedances must be above 0, but the smallest is {mesh.contact_impedance.min()}")
    edges = np.sort(mesh.electrode_edges, axis=1)
    if len(np.unique(edges, axis=0)) != len(edges):
        raise GeometryError("an edge belongs to two electrodes, or twice to one")
    boundary = boundary_edges(mesh.triangles)
    inside = rows_of_edges(edges, boundary, len(mesh.nodes)) < 0
    if inside.any():
        which = int(np.flatnonzero(inside)[0])
        raise GeometryError(
            f"electrode {mesh.electrode_of_edge[which]} has the edge {edges[which].tolist()}, "
            "which is not on the mesh's boundary"
        )


def _edges(triangles: IntArray) -> tuple[IntArray, IntArray]:
    """Return the sorted (E, 2) edges of a mesh, and the (T, 3) rows in them of the sides ab, bc and ca."""
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    # One number for each pair: numpy is much slower at finding equal rows.
    n = int(triangles.max()) + 1
    keys, of_side = np.unique(ends @ [n, 1], return_inverse=True)
    return np.column_stack(np.divmod(keys, n)), of_side.reshape(-1, 3)


def rows_of_edges(edges: IntArray, among: IntArray, n_nodes: int) -> IntArray:
    """Return where each of (E, 2) sorted edges stands in a lexically sorted (B, 2) list, or −1."""
    keys, wanted = among @ [n_nodes, 1], edges @ [n_nodes, 1]
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[at] == wanted, at, -1)


class Terms(NamedTuple):
    """Terms that add up to a matrix: entry (rows, columns)[p] gets Σ values[p] · factors[source[p]]; all are (P,).

    A factor is the conductivity of a triangle or, numbered after them, the contacts' constant 1.
    """

    rows: IntArray
    columns: IntArray
    values: FloatArray
    source: IntArray

    def where(self, keep: BoolArray) -> "Terms":
        """Return some of the terms."""
        return Terms(self.rows[keep], self.columns[keep], self.values[keep], self.source[keep])

    def moved(self, place: IntArray) -> "Terms":
        """Return the terms with each unknown at its place."""
        return self._replace(rows=place[self.rows], columns=place[self.columns])
