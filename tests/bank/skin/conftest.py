import pytest

from shearloop.bank.skin.annulus import MESH_112, CondensedSkin, condense
from shearloop.bank.skin.section import PAPER_SECTION


@pytest.fixture(scope="session")
def skin_112() -> CondensedSkin:
    return condense(PAPER_SECTION, MESH_112)
