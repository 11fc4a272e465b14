"""Banks: their configuration, the ones that come with shearloop, and the files and mistakes of `shearloop bank`."""

from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import GeometryError
from shearloop.bank.forward import ForwardModel
from shearloop.bank.mesh import load_mesh
from shearloop.bank.models import MODELS, conductivity
from shearloop.cli import main
from shearloop.errors import UserError
from shearloop.tools.bank_config import ModelName, load_bank_plan, load_geometry

CONFIG = Path(__file__).parents[2] / "config"

FINGERTIP = """
width_cm: 3.2
height_cm: 3.2
electrode_width_cm: 0.2
contact_impedance: 0.01
mesh_size_cm: 0.4
electrodes:
  - {side: left, centres_cm: [0.1, 0.5, 0.9, 1.3, 1.7, 2.1, 2.5, 2.9]}
  - {side: top, centres_cm: [0.1, 0.5, 0.9, 1.3, 1.7, 2.1, 2.5, 2.9]}
  - {side: right, centres_cm: [3.1, 2.7, 2.3, 1.9, 1.5, 1.1, 0.7, 0.3]}
  - {side: bottom, centres_cm: [3.1, 2.7, 2.3, 1.9, 1.5, 1.1, 0.7, 0.3]}
"""
BANK = """
fingertip: tip.yaml
model: gaussian_derivative
k: {low: 0.5, high: 3, count: 3}
sigma: {low: 0.9, high: 2, count: 2}
"""


def write_bank_config(folder: Path) -> Path:
    """Write the description of a small bank and of its fingertip, `tip.yaml`, and return the bank's path."""
    (folder / "tip.yaml").write_text(FINGERTIP)
    (folder / "bank.yaml").write_text(BANK)
    return folder / "bank.yaml"


@pytest.fixture
def config(tmp_path) -> Path:
    return write_bank_config(tmp_path)


def test_the_model_names_are_those_that_exist():
    assert get_args(ModelName) == tuple(MODELS)


def test_the_papers_fingertip_gives_the_papers_voltages_within_the_error_of_its_mesh(shared):
    with np.load(shared / "reference" / "eidors_forward.npz") as archive:
        truth = archive["v_homogeneous_twice_refined_mesh"]

    def error(mesh):
        return np.linalg.norm(ForwardModel(mesh).homogeneous() - truth) / np.linalg.norm(truth)

    # Measured 0.55 % and 1.7 %; the paper's own mesh has 0.4 % against the same solution.
    assert error(load_bank_plan(CONFIG / "banks" / "paper.yaml").mesh) < 0.006
    assert error(load_bank_plan(CONFIG / "banks" / "demo.yaml").mesh) < 0.018


def test_the_papers_electrodes_are_where_the_papers_mesh_has_them(shared):
    ours = load_geometry(CONFIG / "fingertips" / "paper.yaml").mesh
    theirs = load_mesh(shared / "reference" / "fingertip_mesh.npz")
    for electrode in range(32):
        ends = [
            np.sort(mesh.nodes[mesh.electrode_edges[mesh.electrode_of_edge == electrode]].reshape(-1, 2), axis=0)[
                [0, -1]
            ]
            for mesh in (ours, theirs)
        ]
        np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


def test_a_plan_has_the_grids_and_the_mesh(config):
    plan = load_bank_plan(config)
    np.testing.assert_array_equal(plan.definition.k_grid, [0.5, 1.75, 3])
    np.testing.assert_array_equal(plan.definition.sigma_grid, [0.9, 2])
    assert plan.definition.model == "gaussian_derivative"
    config.write_text(BANK + "mesh_size_cm: 0.1\n")
    assert len(load_bank_plan(config).mesh.nodes) > len(plan.mesh.nodes)


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("fingertip: tip.yaml", "", "give either `mesh` .* or `fingertip`"),
        ("fingertip: tip.yaml", "fingertip: tip.yaml\nmesh: {file: a.npz}", "and not both"),
        ("fingertip: tip.yaml", "mesh: {file: a.npz}\nmesh_size_cm: 0.1", "`mesh_size_cm` is for a `fingertip`"),
        ("fingertip: tip.yaml", "mesh: {file: none.npz}", r"none\.npz: the mesh cannot be read"),
        ("fingertip: tip.yaml", "fingertip: none.yaml", r"none\.yaml: the fingertip's description cannot be read"),
        (
            "electrode_width_cm: 0.2",
            "electrode_width_cm: 1.0e-9",
            r"tip\.yaml:\d+: electrode_width_cm: .* is too small",
        ),
        ("count: 3", "count: 0", r"k\.count: 0 is too small; allowed: from 1 to 2000"),
        ("count: 3", "count: 1", r"k: a count of 1 needs low and high to be the same, not 0\.5 and 3"),
        ("high: 3", "high: 0.5", r"k: low must be below high, but low is 0\.5 and high is 0\.5"),
        ("low: 0.9", "low: 0", r"`sigma\.low` must be above 0 for the model gaussian_derivative, not 0"),
        ("gaussian_derivative", "square", "model: 'square' does not exist; allowed: step, linear"),
        (
            "mesh_size_cm: 0.4",
            "mesh_size_cm: 0",
            r"tip\.yaml:\d+: mesh_size_cm: 0 is too small; allowed: from 0\.005 to 10",
        ),
        ("side: top", "side: front", r"tip\.yaml:\d+: electrodes\[1\]\.side: 'front' does not exist; allowed: left"),
        ("[0.1, 0.5,", "[0.1, 0.2,", r"tip\.yaml: electrodes 0 and 1 on the left side touch or overlap"),
        (
            "side: left, centres_cm: [0.1,",
            "side: left, centres_cm: [",
            r"tip\.yaml: .*an even number of 8 to 32 electrodes, not 31",
        ),
    ],
)
def test_mistakes_in_a_bank_and_its_fingertip_are_named(config, before, after, sentence):
    assert before in BANK + FINGERTIP
    config.write_text(BANK.replace(before, after))
    (config.parent / "tip.yaml").write_text(FINGERTIP.replace(before, after))
    with pytest.raises((UserError, GeometryError), match=sentence):
        load_bank_plan(config)


SOLVE = ["solve", "--mesh", "{folder}/tip.yaml", "--model", "step", "--k", "1", "--sigma", "1", "--out", "{out}"]
BUILD = ["build", "--config", "{folder}/bank.yaml", "--out", "{out}", "--jobs", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a configuration and the bank that the command built of it."""
    folder = tmp_path_factory.mktemp("bank")
    config = write_bank_config(folder)
    assert main(["bank", "build", "--config", f"{config}", "--out", f"{folder}/a.bank", "--jobs", "1"]) == 0
    return folder


def test_build_writes_the_bank_and_reports_its_identity(folder, tmp_path, capsys, result_of):
    capsys.readouterr()
    build = ["bank", "build", "--config", f"{folder}/bank.yaml", "--out", f"{tmp_path}/b.bank", "--jobs", "1"]
    result = result_of(*build)
    bank = Bank.open(tmp_path / "b.bank")
    assert (result["identity"], result["shape"], result["model"]) == (bank.identity, [*bank.signals.shape], bank.model)
    assert result["valid_cells"] == bank.valid.sum()


def test_info_checks_the_bank_and_says_what_it_is_of(folder, ran, result_of):
    result = result_of("bank", "info", f"{folder}/a.bank")
    assert result["k"] == {"low": 0.5, "high": 3.0, "count": 3, "unit": "cm"}
    assert result["valid_cells"] == 6
    assert "3 values from 0.5 to 3 (cm)" in ran("bank", "info", f"{folder}/a.bank").out


def test_info_refuses_a_damaged_bank(folder, tmp_path, mistake):
    content = bytearray((folder / "a.bank").read_bytes())
    content[-5] ^= 1
    (tmp_path / "bad.bank").write_bytes(content)
    sentence = mistake("bank", "info", tmp_path / "bad.bank")
    assert "bad.bank: the file is damaged: the checksum of signals" in sentence
    assert "shearloop bank build" in sentence


def test_solve_writes_the_absolute_voltages(folder, tmp_path):
    solve = ["bank", "solve", "--mesh", f"{folder}/tip.yaml", "--model", "gaussian_derivative"]
    assert main([*solve, "--k", "1.5", "--sigma", "1.1", "--out", f"{tmp_path}/v.npy"]) == 0
    voltages = np.load(tmp_path / "v.npy")
    assert (voltages.dtype, voltages.shape) == (np.float64, (896,))
    assert np.linalg.norm(voltages) > 1


def test_solve_leaves_what_was_there_whole_until_the_voltages_are_written(folder, tmp_path, monkeypatch, ran, mistake):
    out, link = tmp_path / "v.npy", tmp_path / "link.npy"
    np.save(out, np.zeros(3))
    earlier = out.read_bytes()
    link.symlink_to(out)
    solve = [*("bank", "solve", "--mesh", f"{folder}/tip.yaml", "--model", "gaussian_derivative", "--k", "1.5")]
    solve += ["--sigma", "1.1", "--out", f"{link}"]

    def full(file, _voltages):
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(np, "save", full)
        assert "No space left on device" in mistake(*solve)
    assert out.read_bytes() == earlier
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.npy", "v.npy"]
    ran(*solve)
    assert np.load(out).shape == (896,)
    assert link.is_symlink()
    assert "is a folder" in mistake(*solve[:-1], f"{tmp_path}")


def test_solve_on_the_papers_mesh_gives_the_voltages_of_eidors(shared, tmp_path):
    with np.load(shared / "reference" / "eidors_forward.npz") as archive:
        k, sigma, expected = (archive[f"gaussian_derivative_random_{name}"][2] for name in ("k", "sigma", "v"))
    solve = ["bank", "solve", "--model", "gaussian_derivative", "--k", str(k), "--sigma", str(sigma)]
    for name in ("fingertip_mesh.npz", "ModelGen.mat"):
        assert main([*solve, "--mesh", f"{shared}/reference/{name}", "--out", f"{tmp_path}/v"]) == 0
        found = np.load(tmp_path / "v")
        assert np.linalg.norm(found - expected) < 1e-9 * np.linalg.norm(expected)


def test_solve_refuses_a_conductivity_that_is_not_positive_and_writes_nothing(folder, tmp_path, mistake):
    out = tmp_path / "v.npy"
    sentence = mistake(
        "bank",
        *("solve", "--mesh", folder / "tip.yaml", "--model", "gaussian_derivative"),
        *("--k", "1.5", "--sigma", "0.4", "--out", out),
    )
    assert "--model gaussian_derivative --k 1.5 --sigma 0.4: the conductivity is not positive everywhere" in sentence
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ([*BUILD, "--jobs", "0"], "--jobs 0 is not a whole number above 0"),
        ([*BUILD, "--out", "{folder}"], "is a folder; give the name of a file"),
        ([*BUILD, "--out", "/dev/null"], "/dev/null is no file, and cannot hold a bank; give the name of a file"),
        ([*BUILD, "--out", "{folder}/tip.yaml/a.bank"], "there is no folder"),
        ([*BUILD, "--config", "{folder}/none.yaml"], "none.yaml: the bank's description cannot be read"),
        ([*BUILD, "--config", "{folder}/tip.yaml"], "model: is missing; allowed: step, linear"),
        (["info", "{folder}/tip.yaml"], "tip.yaml: this is not a bank"),
        (["info", "{folder}/tip.yaml"], "or make one with `shearloop bank build --config FILE --out NAME.bank`"),
        (["info", "{folder}/none"], "none: the bank cannot be read"),
        (["info", "{folder}"], ": the bank cannot be read: it is a folder; name a file in it\n"),
        (["info", "/dev/null"], ": the bank cannot be read: it is a device or a pipe; name a file\n"),
        (
            ["build", "--config", "{folder}", "--out", "{out}"],
            "cannot be read: it is a folder; name a file in it; did you",
        ),
        ([*SOLVE, "--mesh", "{folder}"], ": the mesh cannot be read: it is a folder; name a file in it\n"),
        ([*SOLVE, "--mesh", "{folder}/none"], "the mesh cannot be read"),
        ([*SOLVE, "--mesh", "{folder}/a.bank"], "is not a mesh"),
        ([*SOLVE, "--model", "x"], "no basis model"),
        ([*SOLVE, "--k", "nan"], "finite"),
        ([*SOLVE, "--out", "{folder}"], "is a folder; give the name of a file"),
    ],
)
def test_mistakes_are_one_sentence(folder, tmp_path, arguments, part, mistake):
    assert part in mistake("bank", *(argument.format(folder=folder, out=tmp_path / "out") for argument in arguments))
    assert list(tmp_path.iterdir()) == []


def test_a_bank_is_of_the_mesh_file_that_the_configuration_names(folder, tmp_path):
    mesh, file = load_geometry(folder / "tip.yaml").mesh.refined(), tmp_path / "mesh.npz"
    names = ("nodes", "triangles", "electrode_edges", "electrode_of_edge", "contact_impedance")
    np.savez(file, **{name: getattr(mesh, name) for name in names})
    (tmp_path / "bank.yaml").write_text(BANK.replace("fingertip: tip.yaml", f"mesh: {{file: {file.name}}}"))
    build = ["bank", "build", "--config", f"{tmp_path}/bank.yaml", "--out", f"{tmp_path}/m.bank", "--jobs", "1"]
    assert main(build) == 0
    mesh = load_mesh(file)
    bank = Bank.open(tmp_path / "m.bank")
    assert bank.geometry_hash == mesh.digest
    forward = ForwardModel(mesh)
    expected = forward.voltages(conductivity(mesh, bank.model, 1.75, 2.0)) - forward.homogeneous()
    np.testing.assert_array_equal(bank.signals[1, 1], expected.astype(np.float32))
