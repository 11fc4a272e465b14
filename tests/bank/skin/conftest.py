import pytest

from bank.skin.annulus import MESH_112, CondensedSkin, condense
from bank.skin.section import PAPER_SECTION


@pytest.fixture(scope="session")
def skin_112() -> CondensedSkin:
    return condense(PAPER_SECTION, MESH_112)
