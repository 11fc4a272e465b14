import math

import pytest

from daemon.loop_task import along_tool


@pytest.mark.parametrize(
    ("turned", "moved"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.03)),
        ((0.0, math.pi, 0.0), (0.0, 0.0, -0.03)),
        ((0.0, math.pi / 2, 0.0), (0.03, 0.0, 0.0)),
    ],
)
def test_along_the_tool_is_where_its_own_axis_points(
    turned: tuple[float, ...], moved: tuple[float, float, float]
) -> None:
    x, y, z, *same = along_tool((0.4, -0.1, 0.3, *turned), 0.03)
    assert (x - 0.4, y + 0.1, z - 0.3) == pytest.approx(moved, abs=1e-12)
    assert tuple(same) == turned
