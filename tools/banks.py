"""The mesh and the two banks of a reproduction: chosen, built, and kept for the next run."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank, BankDefinition
from shearloop.bank.build import build_bank
from shearloop.bank.errors import BankFileError
from shearloop.bank.mesh import Mesh
from shearloop.errors import UserError
from shearloop.tools.bank_config import load_geometry
from shearloop.tools.outputs import new_folder

MODEL = "gaussian_derivative"
# The paper's own mesh, next to a folder of recordings.
PAPER_MESH = Path("reference") / "fingertip_mesh.npz"

OWN_FINGERTIP = Path(str(resources.files("shearloop"))) / "config" / "fingertips" / "paper.yaml"


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """The cells of a bank: k (K,) and sigma (S,) in cm."""

    k: FloatArray
    sigma: FloatArray


# The whole fingertip as in the paper's figure 6, and finer where screwdrivers match.
GRIDS = {
    "focused": Grid(np.linspace(3.1, 3.4, 100), np.linspace(1.2, 1.9, 100)),
    "wide": Grid(np.linspace(0.01, 4.4, 100), np.linspace(0.01, 4.4, 100)),
}


def choose_mesh(recordings: Path, mesh: Path | None) -> tuple[Mesh, str]:
    """Return the mesh of a file, else the paper's next to the recordings, else our own.

    The second value is its origin, for the report. Raises UserError and GeometryError for unusable files.
    """
    if mesh is not None:
        return load_geometry(mesh).mesh, str(mesh)
    beside = recordings.resolve().parent / PAPER_MESH
    if beside.is_file():
        return load_geometry(beside).mesh, f"{beside} (the paper's)"
    return load_geometry(OWN_FINGERTIP).mesh, f"our own grid for {OWN_FINGERTIP}"


def is_built(path: Path, definition: BankDefinition) -> bool:
    """Return whether an earlier build has finished this bank."""
    if not path.exists():
        return False
    try:
        return Bank.open(path).identity == definition.identity
    except BankFileError as error:
        print(f"{error} (it is built again)", file=sys.stderr)
        return False


def cached_bank(
    name: str, grid: Grid, mesh: Mesh, folder: Path, jobs: int = 1, on_row: Callable[[int], None] = lambda _: None
) -> Bank:
    """Return the bank of this grid and mesh from a folder; build it where it is missing or damaged.

    `on_row(done)` is called after each row. Raises BankFileError where it cannot be written.
    """
    definition = BankDefinition(mesh.digest, MODEL, grid.k, grid.sigma)
    path = folder / f"{name}-{definition.identity[:12]}.bank"
    if is_built(path, definition):
        return Bank.open(path)
    try:
        with new_folder(folder):
            build_bank(mesh, definition, path, jobs=jobs, on_row=on_row)
    except OSError as error:
        raise UserError(f"{folder}: the folder for banks cannot be made: {error.strerror}") from error
    return Bank.open(path)
