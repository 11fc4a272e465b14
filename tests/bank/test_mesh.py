"""Meshes: refusals, files, digest and refinement."""

import io
import os
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import savemat

from shearloop.bank.errors import GeometryError
from shearloop.bank.forward import ForwardModel
from shearloop.bank.mesh import doubled_areas, load_mesh

FIELDS = ("nodes", "triangles", "electrode_edges", "electrode_of_edge", "contact_impedance")


def save_npz(path, mesh, **changed):
    np.savez(path, **({name: getattr(mesh, name) for name in FIELDS} | changed))
    return path


def save_eidors(path, mesh, **changed):
    electrodes = np.zeros(32, dtype=[("nodes", object), ("z_contact", float)])
    for e in range(32):
        nodes = np.unique(mesh.electrode_edges[mesh.electrode_of_edge == e]) + 1
        electrodes[e] = (nodes.astype(float), mesh.contact_impedance[e])
    model = {"type": "fwd_model", "nodes": mesh.nodes, "elems": mesh.triangles + 1.0, "electrode": electrodes}
    savemat(path, {"mdl": model | changed})
    return path


def test_both_forms_of_the_papers_mesh_are_one_geometry_with_one_solution(shared, paper_mesh, paper_forward):
    eidors = load_mesh(shared / "reference" / "ModelGen.mat")
    assert eidors.digest == paper_mesh.digest
    np.testing.assert_allclose(ForwardModel(eidors).homogeneous(), paper_forward.homogeneous(), rtol=0, atol=1e-12)


def test_both_forms_of_a_small_mesh_are_read_back(tmp_path, fingertip):
    assert load_mesh(save_npz(tmp_path / "small.npz", fingertip)).digest == fingertip.digest
    assert load_mesh(save_eidors(tmp_path / "small.mat", fingertip)).digest == fingertip.digest


def test_the_digest_is_of_the_geometry_and_not_of_rounding_or_the_order_of_edges(fingertip):
    order = np.random.default_rng(3).permutation(len(fingertip.electrode_edges))
    same = replace(
        fingertip,
        nodes=fingertip.nodes * (1 + 1e-15),
        electrode_edges=fingertip.electrode_edges[order][:, ::-1],
        electrode_of_edge=fingertip.electrode_of_edge[order],
    )
    assert same.digest == fingertip.digest
    assert fingertip.digest == "5c8188442f4d209643ef41245e8dfe91eb70f418cf11f3abbddb4da3d799b68f"
    moved = fingertip.nodes.copy()
    moved[100, 0] += 1e-6
    others = [
        replace(fingertip, nodes=moved),
        replace(fingertip, contact_impedance=fingertip.contact_impedance * 2),
        replace(fingertip, electrode_of_edge=np.roll(fingertip.electrode_of_edge, 1)),
        fingertip.refined(),
    ]
    assert len({mesh.digest for mesh in [fingertip, *others]}) == 5


def test_refining_keeps_area_electrodes_and_the_order_of_children(fingertip):
    fine = fingertip.refined()
    areas = np.abs(doubled_areas(fine.nodes, fine.triangles)).reshape(-1, 4)
    parents = np.abs(doubled_areas(fingertip.nodes, fingertip.triangles))
    np.testing.assert_allclose(4 * areas, np.repeat(parents[:, None], 4, axis=1))
    centroids = fine.nodes[fine.triangles].mean(axis=1).reshape(-1, 4, 2).mean(axis=1)
    np.testing.assert_allclose(centroids, fingertip.nodes[fingertip.triangles].mean(axis=1), atol=1e-12)

    def lengths(mesh):
        sides = np.linalg.norm(np.diff(mesh.nodes[mesh.electrode_edges], axis=1)[:, 0], axis=1)
        return np.bincount(mesh.electrode_of_edge, sides)

    np.testing.assert_allclose(lengths(fine), lengths(fingertip))


def test_arrays_of_a_mesh_do_not_change(fingertip):
    with pytest.raises(ValueError, match="read-only"):
        fingertip.nodes[0, 0] = 1


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"nodes": np.zeros((9, 3))}, r"nodes has shape \(9, 3\), expected any × 2"),
        ({"nodes": np.full((289, 2), np.nan)}, "node 0 is not finite"),
        ({"nodes": np.zeros((289, 2))}, "512 degenerate triangles: triangle 0 with nodes"),
        ({"triangles": np.array([[0, 1, 900]])}, "triangles names nodes 0 to 900, but the nodes are numbered 0 to 288"),
        ({"triangles": np.array([[0.0, 1.0, 2.0]])}, "triangles holds float64, expected integers"),
        ({"triangles": np.array([[0, 1, 18]])}, "falls into 287 pieces"),
        ({"contact_impedance": np.zeros(32)}, "must be above 0, but the smallest is 0"),
        ({"contact_impedance": np.ones(31)}, "unknown are .31."),
        ({"contact_impedance": np.ones(33)}, "without an edge are .32."),
        ({"electrode_of_edge": np.arange(31)}, "has 31 entries for 32 edges"),
        ({"electrode_edges": np.tile([[0, 1]], (32, 1))}, "belongs to two electrodes"),
        ({"electrode_edges": np.column_stack([np.arange(18, 50), np.arange(19, 51)])}, "not on the mesh's boundary"),
    ],
)
def test_what_cannot_be_solved_on_is_refused_with_the_files_name(tmp_path, fingertip, changed, sentence):
    with pytest.raises(GeometryError, match=rf"bad\.npz: .*{sentence}"):
        load_mesh(save_npz(tmp_path / "bad.npz", fingertip, **changed))


def test_a_mesh_with_another_number_of_electrodes_than_its_channels_is_refused(tmp_path, fingertip):
    edges = fingertip.electrode_edges[:31]
    few = replace(fingertip, electrode_edges=edges, electrode_of_edge=np.arange(31), contact_impedance=np.ones(31))
    mesh = load_mesh(save_npz(tmp_path / "other.npz", few))
    with pytest.raises(GeometryError, match="the mesh has 31 electrodes, but the channel table needs 32"):
        ForwardModel(mesh)


def test_files_that_are_missing_foreign_or_incomplete_are_refused_by_name(tmp_path, fingertip):
    with pytest.raises(GeometryError, match=r"none\.npz: the mesh cannot be read: No such file"):
        load_mesh(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("nodes, triangles\n")
    with pytest.raises(GeometryError, match=r"text\.npz is not a mesh: expected an \.npz file"):
        load_mesh(tmp_path / "text.npz")
    np.savez(tmp_path / "part.npz", nodes=fingertip.nodes, other=1)
    with pytest.raises(GeometryError, match=r"lacks triangles, electrode_edges, .* it has nodes, other"):
        load_mesh(tmp_path / "part.npz")
    np.savez(tmp_path / "object.npz", **{name: np.array([{}], dtype=object) for name in FIELDS})
    with pytest.raises(GeometryError, match=r"object\.npz: the file is truncated or damaged"):
        load_mesh(tmp_path / "object.npz")
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as archive:
        for name in FIELDS:
            archive.writestr(f"{name}.npy", b"not an array")
    with pytest.raises(GeometryError, match=r"zip\.npz"):
        load_mesh(tmp_path / "zip.npz")


def test_eidors_files_without_a_model_are_refused_by_name(tmp_path):
    savemat(tmp_path / "other.mat", {"data": np.zeros(3)})
    with pytest.raises(GeometryError, match=r"other\.mat: expected an EIDORS forward model in the variable `mdl`"):
        load_mesh(tmp_path / "other.mat")


@pytest.mark.parametrize("save", [save_npz, save_eidors])
def test_a_file_cut_off_anywhere_is_refused_by_name(tmp_path, fingertip, save):
    suffix = ".npz" if save is save_npz else ".mat"
    whole = save(tmp_path / f"whole{suffix}", fingertip).read_bytes()
    for length in [0, 3, 10, *np.linspace(100, len(whole) - 1, 25).astype(int)]:
        cut = tmp_path / f"cut{suffix}"
        cut.write_bytes(io.BytesIO(whole).read(length))
        with pytest.raises(GeometryError, match="cut"):
            load_mesh(cut)


def test_a_changed_model_of_eidors_is_refused_by_name_or_read(tmp_path, fingertip):
    whole = save_eidors(tmp_path / "whole.mat", fingertip).read_bytes()
    rng = np.random.default_rng(5)
    path = tmp_path / "changed.mat"
    for _ in range(300):
        changed = bytearray(whole)
        # Most of the rest is coordinates.
        for at in rng.integers(128, rng.choice([600, len(whole)]), rng.integers(1, 5)):
            changed[at] = rng.choice([0, 127, 255, rng.integers(256)])
        path.write_bytes(changed)
        error = None
        try:
            load_mesh(path)
        except GeometryError as refused:
            error = str(refused)
        assert error is None or str(path) in error


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({"elems": np.full((5, 3), np.nan)}, "the number of a node is not whole"),
        ({"elems": np.full((5, 3), 1.5)}, "the number of a node is not whole"),
        ({"elems": np.ones((5, 4))}, "not of triangles"),
        ({"nodes": "text"}, "could not convert string to float"),
        ({"electrode": {"nodes": np.ones((1, 2))}}, "'z_contact'"),
        ({"electrode": 3.0}, "expected an EIDORS forward model"),
    ],
)
def test_a_model_of_eidors_with_wrong_values_is_refused(changed, problem, tmp_path, fingertip):
    with pytest.raises(GeometryError, match=rf"bad\.mat: .*{problem}"):
        load_mesh(save_eidors(tmp_path / "bad.mat", fingertip, **changed))


@pytest.mark.parametrize("damage", ["deflate", "header", "method", "pipe"])
def test_damage_of_an_npz_file_is_refused_by_name(damage, tmp_path, fingertip):
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, **{name: getattr(fingertip, name) for name in FIELDS})
    content = bytearray(path.read_bytes())
    if damage == "deflate":
        content[120:200] = bytes(range(80))
    if damage == "header":
        whole = io.BytesIO()
        np.savez(whole, **{name: getattr(fingertip, name) for name in FIELDS})
        content = bytearray(whole.getvalue().replace(b"{'descr': ", b"{'descr: [("))
    if damage == "method":
        for at in (one.start() for one in re.finditer(b"PK\x01\x02", content)):
            content[at + 10] = 99
    path.unlink()
    if damage == "pipe":
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    with pytest.raises(GeometryError, match=r"bad\.npz: .*(truncated or damaged|a device or a pipe)"):
        load_mesh(path)
