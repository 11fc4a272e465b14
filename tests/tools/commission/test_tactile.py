"""The torques of fingertips in stage 7 are those of the control loop."""

import numpy as np
import pytest

from shearloop.daemon.control.creep import Creep
from shearloop.drivers.eit_kit import Frame
from shearloop.estimation.values import Estimate, TactileFrame
from shearloop.tools.commission.tactile import ESTIMATES, TactileSensor

PERIOD_S = 0.5


class Board:
    """Sends a frame whenever one is waited for."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def take(self, _count: int, _silent_s: float) -> None:
        number, channels = len(self.frames) + 1, np.full(8, 0.5)
        t_ns, is_bad = round(number * PERIOD_S * 1e9), np.zeros(8, dtype=bool)
        self.frames.append(
            Frame(
                channels=channels, raw=channels, t_begin_ns=t_ns, t_mid_ns=t_ns + 1, t_arrival_ns=t_ns + 2, seq=number,
                saturated=is_bad, dead=is_bad, repeated=False,
            )
        )  # fmt: skip

    def since(self, t_ns: int) -> list[Frame]:
        return [frame for frame in self.frames if frame.t_mid_ns >= t_ns]


class Tactile:
    """A session whose fingertips feel a constant shear until their tare."""

    taring = False

    def __init__(self, shear_nm: float) -> None:
        self.shear_nm: float | None = shear_nm

    def tare(self) -> None:
        self.shear_nm = None

    def estimate(self, _frame: TactileFrame) -> Estimate:
        return Estimate(valid=True, torque_nm=self.shear_nm)


@pytest.mark.parametrize("configured", [True, False])
def test_the_creep_of_a_gel_is_subtracted_where_it_is_configured(configured):
    creep = Creep(0.3, 10.0)
    sensor = TactileSensor("right", Tactile(0.2), {"right": Board()}, PERIOD_S, creep if configured else None)
    loops = Creep(0.3, 10.0)
    # The first frame may have begun before the call, and is not averaged.
    shown_nm = [loops.torque_nm(0.2, round(number * PERIOD_S * 1e9)) for number in range(1, ESTIMATES + 2)]
    wanted_nm = np.mean(shown_nm[1:]) if configured else 0.2
    assert sensor.torque_nm() == pytest.approx(wanted_nm)
    assert (wanted_nm < 0.2) == configured
    sensor.tare(0)
    assert creep.crept_nm == 0.0, "the gel is at rest again"
