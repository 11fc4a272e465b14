"""The torques of fingertips in stage 7 are those of the control loop."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from shearloop.daemon.control.creep import Creep
from shearloop.drivers.eit_kit import Frame
from shearloop.drivers.robotiq.messages import GripperCommand
from shearloop.estimation.values import Estimate, TactileFrame
from shearloop.tools.commission.tactile import ESTIMATES, TactileSensor
from shearloop.tools.commission.tool import repeated_grips

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
    assert np.mean(sensor.torques_nm()) == pytest.approx(wanted_nm)
    assert (wanted_nm < 0.2) == configured
    sensor.tare(0)
    assert creep.crept_nm == 0.0, "the gel is at rest again"


class Fingers:
    """A gripper that closes onto a tool for some frames; a grip shears the gel."""

    model = SimpleNamespace(stroke_mm=140.0)

    def __init__(self, board: Board, tactile: Tactile, shears_nm: list[float]) -> None:
        self._board, self._tactile, self._shears_nm = board, tactile, shears_nm

    def activate(self) -> None:
        """Every finger is active."""

    def move(self, command: GripperCommand) -> SimpleNamespace:
        if command.width_mm > 0:
            return SimpleNamespace(diameter_mm=None)
        self._tactile.shear_nm = self._shears_nm.pop(0)
        for _ in range(20):
            self._board.take(1, 0.0)
        return SimpleNamespace(diameter_mm=20.0)


def test_the_creep_begins_anew_after_the_last_grip():
    board, tactile, creep = Board(), Tactile(0.0), Creep(0.3, 10.0)
    sensor = TactileSensor("right", tactile, {"right": board}, PERIOD_S, creep)
    fingers = Fingers(board, tactile, [0.4, 0.3])
    context = SimpleNamespace(
        counts=SimpleNamespace(starts=2),
        operator=SimpleNamespace(allow=lambda _: None),
        gripper=lambda: nullcontext(fingers),
        clock=SimpleNamespace(now_ns=lambda: 0),
    )
    repeated_grips(context, [sensor])
    first = len(board.frames) + 1
    tactile.shear_nm = 0.2
    loops = Creep(0.3, 10.0)
    wanted_nm = [loops.torque_nm(0.2, round(number * PERIOD_S * 1e9) + 1) for number in range(first, first + 4)]
    assert sensor.torques_nm() == pytest.approx(wanted_nm[1:])
