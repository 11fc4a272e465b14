"""`shearloop bank`: files, output, and mistakes as one sentence with status 2."""

import numpy as np
import pytest

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.mesh import load_mesh
from shearloop.bank.eit.models import conductivity
from shearloop.daemon.bank_config import load_geometry
from shearloop.daemon.cli import main
from tests.daemon.test_bank_config import BANK, write_bank_config

SOLVE = ["solve", "--mesh", "{folder}/tip.yaml", "--model", "step", "--k", "1", "--sigma", "1", "--out", "{out}"]
BUILD = ["build", "--config", "{folder}/bank.yaml", "--out", "{out}", "--jobs", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a configuration and the bank that the command built of it."""
    folder = tmp_path_factory.mktemp("bank")
    config = write_bank_config(folder)
    assert main(["bank", "build", "--config", f"{config}", "--out", f"{folder}/a.bank", "--jobs", "1"]) == 0
    return folder


def test_build_writes_the_bank_and_tells_its_identity(folder, tmp_path, capsys, result_of):
    capsys.readouterr()
    build = ["bank", "build", "--config", f"{folder}/bank.yaml", "--out", f"{tmp_path}/b.bank", "--jobs", "1"]
    result = result_of(*build)
    bank = Bank.open(tmp_path / "b.bank", verify=True)
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
    assert "Is a directory" in mistake(*solve[:-1], f"{tmp_path}")


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
        ([*BUILD, "--out", "{folder}"], "is a directory; give the name of a file"),
        ([*BUILD, "--out", "/dev/null"], "/dev/null is no file, and cannot hold a bank; give the name of a file"),
        ([*BUILD, "--out", "{folder}/tip.yaml/a.bank"], "there is no folder"),
        ([*BUILD, "--config", "{folder}/none.yaml"], "none.yaml: the bank's description cannot be read"),
        ([*BUILD, "--config", "{folder}/tip.yaml"], "model: is missing; allowed: step, linear"),
        (["info", "{folder}/tip.yaml"], "tip.yaml: this is not a bank"),
        (["info", "{folder}/tip.yaml"], "or make one with `shearloop bank build --config FILE --out NAME.bank`"),
        (["info", "{folder}/none"], "none: the bank cannot be read"),
        ([*SOLVE, "--mesh", "{folder}/none"], "the mesh cannot be read"),
        ([*SOLVE, "--mesh", "{folder}/a.bank"], "is not a mesh"),
        ([*SOLVE, "--model", "x"], "no basis model"),
        ([*SOLVE, "--k", "nan"], "finite"),
        ([*SOLVE, "--out", "{folder}"], "the voltages cannot be written: Is a directory"),
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
