"""The configuration of banks and fingertips: what `config/banks/*.yaml` and `config/fingertips/*.yaml` may say."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from bank.errors import GeometryError
from bank.fingertip import ElectrodePlace, Fingertip, Side
from bank.mesh import Mesh, load_mesh
from daemon.config_file import ConfigModel, load_yaml_model
from daemon.errors import UserError

ModelName = Literal["step", "linear", "cut_linear", "gaussian_derivative", "modulated_gaussian"]
MeshSize = Annotated[float, Field(ge=0.005, le=10)]
Measure = Annotated[float, Field(gt=0, le=100)]


class GridConfig(ConfigModel):
    """`count` values from `low` to `high`, both included."""

    low: Annotated[float, Field(ge=-1000, le=1000)]
    high: Annotated[float, Field(ge=-1000, le=1000)]
    count: Annotated[int, Field(ge=2, le=2000)]

    @model_validator(mode="after")
    def _ascends(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low must be below high, but low is {self.low:g} and high is {self.high:g}")
        return self

    def values(self) -> NDArray[np.float64]:
        """Return the grid, (count,)."""
        return np.linspace(self.low, self.high, self.count)


class MeshFileConfig(ConfigModel):
    """A mesh to be read: an .npz or an EIDORS .mat file."""

    file: Path


class BankConfig(ConfigModel):
    """What a bank is of. Paths are relative to the file that names them; mesh_size_cm overrides the fingertip's."""

    mesh: MeshFileConfig | None = None
    fingertip: Path | None = None
    mesh_size_cm: MeshSize | None = None
    model: ModelName
    k: GridConfig
    sigma: GridConfig

    @model_validator(mode="after")
    def _is_of_one_geometry(self) -> Self:
        if (self.mesh is None) == (self.fingertip is None):
            raise ValueError("give either `mesh` (with a `file`) or `fingertip`, and not both")
        if self.mesh_size_cm is not None and self.fingertip is None:
            raise ValueError("`mesh_size_cm` is for a `fingertip`; a `mesh` that is read from a file has its own")
        if self.sigma.low <= 0 and self.model != "step":
            raise ValueError(f"`sigma.low` must be above 0 for the model {self.model}, not {self.sigma.low:g}")
        return self


class ElectrodeRunConfig(ConfigModel):
    """Electrodes that follow each other on one side, by their centres along it."""

    side: Side
    centres_cm: Annotated[list[Annotated[float, Field(ge=0, le=100)]], Field(min_length=1)]


class FingertipConfig(ConfigModel):
    """A rectangular fingertip with electrodes along its edge."""

    width_cm: Measure
    height_cm: Measure
    electrode_width_cm: Measure
    contact_impedance: Annotated[float, Field(gt=0, le=1000)]
    mesh_size_cm: MeshSize
    electrodes: list[ElectrodeRunConfig]

    def fingertip(self) -> Fingertip:
        """Return the fingertip; raises GeometryError for electrodes that are not 32, leave their side or overlap."""
        return Fingertip(
            width_cm=self.width_cm,
            height_cm=self.height_cm,
            electrode_width_cm=self.electrode_width_cm,
            contact_impedance=self.contact_impedance,
            mesh_size_cm=self.mesh_size_cm,
            electrodes=tuple(ElectrodePlace(run.side, centre) for run in self.electrodes for centre in run.centres_cm),
        )


@dataclass(frozen=True, slots=True, eq=False)
class BankPlan:
    """All that `bank.build.build_bank` needs to know: k_grid (K,) and sigma_grid (S,) in the model's units."""

    mesh: Mesh
    model: str
    k_grid: NDArray[np.float64]
    sigma_grid: NDArray[np.float64]


def load_bank_plan(
    path: Path, *, model: str | None = None, k: GridConfig | None = None, sigma: GridConfig | None = None
) -> BankPlan:
    """Read a bank's configuration and its mesh; what is given besides takes the place of what the file says.

    Raises UserError and GeometryError with the file and the key to mend.
    """
    config = load_yaml_model(path, BankConfig)
    model, k, sigma = model or config.model, k or config.k, sigma or config.sigma
    if sigma.low <= 0 and model != "step":
        raise UserError(f"{path}: sigma must begin above 0 for the model {model}, not at {sigma.low:g}")
    if config.mesh is not None:
        mesh = load_geometry(path.parent / config.mesh.file)
    elif config.fingertip is not None:
        mesh = _fingertip_mesh(path.parent / config.fingertip, config.mesh_size_cm)
    else:
        raise UserError(f"{path}: give either `mesh` or `fingertip`")
    return BankPlan(mesh, model, k.values(), sigma.values())


def load_geometry(path: Path) -> Mesh:
    """Return the mesh of a file: a fingertip's description (.yaml, .yml), an .npz or an EIDORS .mat file."""
    if path.suffix not in (".yaml", ".yml"):
        return load_mesh(path)
    return _fingertip_mesh(path)


def _fingertip_mesh(path: Path, mesh_size_cm: float | None = None) -> Mesh:
    config = load_yaml_model(path, FingertipConfig)
    try:
        fingertip = config.fingertip()
        return (fingertip if mesh_size_cm is None else replace(fingertip, mesh_size_cm=mesh_size_cm)).mesh()
    except GeometryError as error:
        raise GeometryError(f"{path}: {error}") from error
