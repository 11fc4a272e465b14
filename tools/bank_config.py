"""The configuration of banks and fingertips: `config/banks/*.yaml` and `config/fingertips/*.yaml`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import BankDefinition
from shearloop.bank.channels import INJECTION, ChannelTable, Injection
from shearloop.bank.errors import GeometryError
from shearloop.bank.fingertip import ElectrodePlace, Fingertip, RectangularFingertip, RoundFingertip, Side
from shearloop.bank.mesh import Mesh, load_mesh
from shearloop.bank.models import MODELS
from shearloop.daemon.config_file import ConfigModel, load_yaml_model

if TYPE_CHECKING:
    ModelName: TypeAlias = str
else:
    ModelName = Literal[tuple(MODELS)]
MeshSize = Annotated[float, Field(ge=0.005, le=10)]
Measure = Annotated[float, Field(gt=0, le=100)]


class GridConfig(ConfigModel):
    """`count` values from `low` to `high`, both included; a single one where the two are the same."""

    low: float = Field(ge=-1000, le=1000, description="the first value")
    high: float = Field(ge=-1000, le=1000, description="the last value")
    count: int = Field(ge=1, le=2000, description="number of values")

    @model_validator(mode="after")
    def _ascends(self) -> Self:
        if self.count > 1 and self.low >= self.high:
            raise ValueError(f"low must be below high, but low is {self.low:g} and high is {self.high:g}")
        if self.count == 1 and self.low != self.high:
            raise ValueError(f"a count of 1 needs low and high to be the same, not {self.low:g} and {self.high:g}")
        return self

    def values(self) -> FloatArray:
        """Return the grid, (count,)."""
        return np.linspace(self.low, self.high, self.count)


class MeshFileConfig(ConfigModel):
    """A mesh file (.npz or EIDORS .mat), and how its electrodes are driven."""

    file: Path = Field(description="the mesh: .npz or EIDORS .mat")
    injection: Injection = Field(INJECTION, description="the electrode that an injection's current comes from")


class BankConfig(ConfigModel):
    """A bank. Paths are relative to the file that names them; mesh_size_cm overrides the fingertip's."""

    what: ClassVar[str] = "bank's description"

    mesh: MeshFileConfig | None = Field(None, description="a mesh from a file; else `fingertip`")
    fingertip: Path | None = Field(None, description="the fingertip's dimensions, a file; else `mesh`")
    mesh_size_cm: MeshSize | None = Field(None, description="largest distance of mesh lines (default: the fingertip's)")
    model: ModelName = Field(description="basis model of the conductivity's change")
    k: GridConfig = Field(description="first parameter of the model, in cm (modulated_gaussian: rad/cm)")
    sigma: GridConfig = Field(description="second parameter of the model, in cm (step: not used)")

    @model_validator(mode="after")
    def _is_of_one_geometry(self) -> Self:
        if (self.mesh is None) == (self.fingertip is None):
            raise ValueError("give either `mesh` (with a `file`) or `fingertip`, with a value, and not both")
        if self.mesh_size_cm is not None and self.fingertip is None:
            raise ValueError("`mesh_size_cm` is for a `fingertip`; a `mesh` that is read from a file has its own")
        if self.sigma.low <= 0 and MODELS[self.model].uses_sigma:
            raise ValueError(f"`sigma.low` must be above 0 for the model {self.model}, not {self.sigma.low:g}")
        return self


class ElectrodeRunConfig(ConfigModel):
    """Successive electrodes: on one side of a rectangle by their centres along it, or around a disc by their angles."""

    side: Side | None = Field(None, description="side of a rectangle")
    centres_cm: list[Annotated[float, Field(ge=0, le=100)]] | None = Field(
        None, min_length=1, description="electrodes' centres along the side"
    )
    angles_deg: list[Annotated[float, Field(ge=-360, le=360)]] | None = Field(
        None, min_length=1, description="electrodes' centres around a disc, anticlockwise from the right"
    )


class FingertipGeometryConfig(ConfigModel):
    """A fingertip with electrodes along its edge: a rectangle (width_cm, height_cm) or a disc (diameter_cm)."""

    what: ClassVar[str] = "fingertip's description"

    width_cm: Measure | None = Field(None, description="width of a rectangle")
    height_cm: Measure | None = Field(None, description="height of a rectangle")
    diameter_cm: Measure | None = Field(None, description="diameter of a disc")
    # 10 µm: narrower than any electrode, wider than two lines of the mesh that are one.
    electrode_width_cm: float = Field(ge=1e-3, le=100, description="width of each electrode")
    contact_impedance: float = Field(
        gt=0, le=1000, description="impedance of each contact, in cm over the conductivity"
    )
    mesh_size_cm: MeshSize = Field(description="largest distance of mesh lines")
    injection: Injection = Field(INJECTION, description="the electrode that an injection's current comes from")
    electrodes: list[ElectrodeRunConfig] = Field(description="the electrodes in order")

    @model_validator(mode="after")
    def _has_one_outline(self) -> Self:
        is_round = self.diameter_cm is not None
        if is_round in (self.width_cm is not None, self.height_cm is not None):
            raise ValueError("give either `diameter_cm`, or `width_cm` and `height_cm`")
        for run in self.electrodes:
            given = run.side is not None, run.centres_cm is not None, run.angles_deg is not None
            if given != (not is_round, not is_round, is_round):
                wanted = "`angles_deg`" if is_round else "`side` and `centres_cm`"
                raise ValueError(f"each entry of `electrodes` needs {wanted}, and nothing else")
        return self

    def fingertip(self) -> Fingertip:
        """Return the fingertip; raises GeometryError for electrodes that leave their side or overlap."""
        if self.diameter_cm is not None:
            angles = tuple(angle for run in self.electrodes for angle in run.angles_deg or ())
            measures = self.model_dump(exclude={"electrodes", "width_cm", "height_cm"})
            return RoundFingertip(**measures, angles_deg=angles)
        places = tuple(
            ElectrodePlace(run.side, centre)
            for run in self.electrodes
            for centre in run.centres_cm or ()
            if run.side is not None
        )
        return RectangularFingertip(**self.model_dump(exclude={"electrodes", "diameter_cm"}), electrodes=places)


class Geometry(NamedTuple):
    """A fingertip's mesh and its channels."""

    mesh: Mesh
    table: ChannelTable


class BankPlan(NamedTuple):
    """A configured bank."""

    mesh: Mesh
    definition: BankDefinition


def load_bank_plan(path: Path) -> BankPlan:
    """Read a bank's configuration and its mesh; raises UserError and GeometryError with the file and key to mend."""
    config = load_yaml_model(path, BankConfig)
    if config.fingertip is not None:
        mesh, table = _fingertip_geometry(path.parent / config.fingertip, config.mesh_size_cm)
    elif config.mesh is not None:
        mesh = load_mesh(path.parent / config.mesh.file)
        table = ChannelTable(mesh.n_electrodes, config.mesh.injection)
    return BankPlan(mesh, BankDefinition(mesh.digest, config.model, config.k.values(), config.sigma.values(), table))


def load_geometry(path: Path) -> Geometry:
    """Return the geometry of a file: a fingertip's description (.yaml, .yml), an .npz or an EIDORS .mat file.

    A file of a mesh alone is taken for a fingertip with opposite injections.
    """
    if path.suffix in (".yaml", ".yml"):
        return _fingertip_geometry(path)
    mesh = load_mesh(path)
    return Geometry(mesh, ChannelTable(mesh.n_electrodes))


def load_fingertip(path: Path, mesh_size_cm: float | None = None) -> Fingertip:
    """Return the fingertip of a description, with another mesh size if given; raises UserError and GeometryError."""
    fingertip = load_yaml_model(path, FingertipGeometryConfig).fingertip()
    return fingertip if mesh_size_cm is None else replace(fingertip, mesh_size_cm=mesh_size_cm)


def _fingertip_geometry(path: Path, mesh_size_cm: float | None = None) -> Geometry:
    try:
        fingertip = load_fingertip(path, mesh_size_cm)
        return Geometry(fingertip.mesh(), fingertip.table)
    except GeometryError as error:
        raise GeometryError(f"{path}: {error}") from error
