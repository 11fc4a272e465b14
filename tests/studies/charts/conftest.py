"""Synthetic recordings and a small bank for the charts."""

from pathlib import Path

import numpy as np
import pytest

from shearloop.bank.bank_file import Bank
from shearloop.bank.mesh import Mesh
from shearloop.studies.charts.chart_data import Split, own_fingertip, splits
from shearloop.tools.banks import Grid, cached_bank


@pytest.fixture(scope="session")
def scratch(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("charts")


@pytest.fixture(scope="session")
def parts(scratch) -> list[Split]:
    return splits([], 0.6, scratch)


@pytest.fixture(scope="session")
def slices(parts) -> Split:
    return parts[0]


@pytest.fixture(scope="session")
def stream(parts) -> Split:
    return parts[1]


@pytest.fixture(scope="session")
def coarse_mesh() -> Mesh:
    return own_fingertip(0.4).mesh()


@pytest.fixture(scope="session")
def bank(scratch, coarse_mesh) -> Bank:
    return cached_bank("chart", Grid(np.linspace(3.0, 3.6, 13), np.linspace(1.0, 2.1, 30)), coarse_mesh, scratch)
