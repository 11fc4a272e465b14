import pytest

from shearloop.bank.skin.membrane import PAPER_SECTION
from shearloop.bank.skin.plane_strain import MESH_112, CondensedSkin, condense


@pytest.fixture(scope="session")
def skin_112() -> CondensedSkin:
    return condense(PAPER_SECTION, MESH_112)
