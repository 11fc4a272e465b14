from itertools import islice

import numpy as np
import pytest

from shearloop.cli.emulate.rig import PushedSkin
from shearloop.emulators.emulated_rig import SkinOnTool
from shearloop.emulators.gripper import Gripper, GripperRegisters
from shearloop.emulators.scene import Scene, Truth, TwinSettings
from shearloop.emulators.skin import Circuit, EmulatedAdcBoard, adc_lines
from shearloop.emulators.synthetic_skin import SyntheticSkin

DT_S = 0.002
# A gel that does not creep, so that every torque can be said in advance.
ELASTIC = TwinSettings(relaxing_share=0.0, hysteresis_rad=0.0)
STIFF = 0.8 * 20.0 / 20.8  # gel and joint in series


class Hands:
    """A scene and what is done with it."""

    def __init__(self, settings: TwinSettings = ELASTIC, speed: float = 1.0) -> None:
        self.gripper = Gripper(object_mm=20.0)
        self.scene = Scene(self.gripper, settings, speed)
        self.wrist_rad = 0.0
        self.flange_nm = 0.0
        self.gripper.write(GripperRegisters(act=True))
        self.wait(8.0 / speed)

    def wait(self, duration_s: float) -> Truth:
        for _ in range(round(duration_s / DT_S)):
            self.flange_nm = self.scene.step(DT_S, self.wrist_rad)
        return self.scene.truth()

    def go(self, position: int) -> Truth:
        self.gripper.write(GripperRegisters(act=True, gto=True, pos=position, spe=255, force=67))
        return self.wait(1.0)

    def twist(self, by_rad: float, duration_s: float) -> Truth:
        start_rad, steps = self.wrist_rad, round(duration_s / DT_S)
        for n in range(1, steps + 1):
            self.wrist_rad = start_rad + by_rad * n / steps
            self.flange_nm = self.scene.step(DT_S, self.wrist_rad)
        return self.scene.truth()


def twisted(by_rad: float, duration_s: float) -> tuple[Hands, Truth]:
    """Return hands that grip the tool and have twisted it."""
    hands = Hands()
    hands.go(255)
    return hands, hands.twist(by_rad, duration_s)


def test_a_twist_of_the_wrist_is_felt_by_flange_lever_and_gel_while_the_tool_is_gripped():
    hands = Hands()
    assert hands.twist(0.1, 0.2).torque_nm == 0.0, "nothing is gripped yet"
    truth = hands.go(255)
    assert (truth.gripped, truth.torque_nm) == (True, 0.0)
    assert truth.width_mm == pytest.approx(20.0)
    assert truth.diameter_mm == 20.0
    truth = hands.twist(0.1, 0.5)
    assert truth.torque_nm == pytest.approx(STIFF * 0.1)
    assert truth.shear_torque_nm == pytest.approx(STIFF * 0.1)
    assert hands.flange_nm == pytest.approx(-STIFF * 0.1), "the tool resists"
    truth = hands.go(0)
    assert (truth.gripped, truth.torque_nm, truth.shear_torque_nm, hands.flange_nm) == (False, 0.0, 0.0, 0.0)


def test_a_load_cell_gives_the_mean_over_its_conversion():
    hands, truth = twisted(0.2, 1.0)
    # The mean of a ramp is its value in the middle.
    assert hands.scene.conversion_nm(0.09) == pytest.approx(truth.torque_nm - STIFF * 0.2 * 0.045, rel=1e-4)


def test_each_injection_of_a_frame_sees_the_shear_of_its_own_moment():
    hands, truth = twisted(0.2, 1.0)
    grip, shear_nm, width_mm = hands.scene.frame(0.5)
    assert width_mm == pytest.approx(20.0)
    assert (grip == 1.0).all()
    before_s = 0.5 * (1 - (np.arange(32) + 0.5) / 32)
    np.testing.assert_allclose(shear_nm, truth.shear_torque_nm - STIFF * 0.2 * before_s, rtol=1e-4)


def test_a_faster_scene_relaxes_faster_and_its_measurements_cover_its_own_time():
    slow, fast = (Hands(TwinSettings(), speed) for speed in (1.0, 20.0))
    relaxed = []
    for hands, speed in ((slow, 1.0), (fast, 20.0)):
        hands.go(255)
        hands.twist(0.1, 0.02)
        before = hands.scene.time_s
        relaxed.append(hands.wait(10.0 / speed).torque_nm)
        assert hands.scene.time_s - before == pytest.approx(10.0)
        assert hands.scene.conversion_nm(0.09) == pytest.approx(relaxed[-1], rel=1e-3)
    assert relaxed[1] == pytest.approx(relaxed[0], rel=3e-3)
    assert relaxed[0] < 0.98 * STIFF * 0.1


def test_a_kick_is_a_jump_of_the_torque_and_gone_with_the_grip():
    hands = Hands()
    with pytest.raises(ValueError, match="kick needs a tool in the grip"):
        hands.scene.kick(0.05)
    hands.go(255)
    hands.twist(0.05, 0.1)
    hands.scene.kick(0.05)
    assert hands.wait(DT_S).torque_nm == pytest.approx(STIFF * 0.05 + 0.05)
    hands.go(0)
    assert hands.go(255).torque_nm == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slip_leaves_so_much_torque_and_the_grip_holds_again(sign):
    hands, _ = twisted(sign * 0.15, 0.1)
    hands.scene.slip(0.03)
    truth = hands.wait(DT_S)
    assert truth.torque_nm == pytest.approx(sign * 0.03)
    assert truth.slipped_rad == pytest.approx(sign * (0.15 - 0.03 / STIFF))
    assert hands.twist(sign * 0.1, 0.1).torque_nm == pytest.approx(sign * (0.03 + STIFF * 0.1))
    hands.scene.slip()
    assert hands.wait(DT_S).torque_nm == pytest.approx(0.0, abs=1e-6)


def test_a_tool_that_falls_takes_the_torque_with_it():
    hands, _ = twisted(0.1, 0.1)
    hands.gripper.object_mm = None
    truth = hands.wait(1.0)
    assert (truth.gripped, truth.torque_nm, truth.diameter_mm) == (False, 0.0, None)
    assert truth.width_mm == pytest.approx(0.0)


def test_a_skin_on_the_tool_bears_the_torque_of_a_turn_and_of_a_press():
    """The daemon compares the torques of all sensors of one tool."""
    hands, _ = twisted(0.02, 0.2)
    skin = SyntheticSkin(radius_mm=15.0)
    gauges = SkinOnTool(skin, hands.scene)
    gauges.resistances_ohm()
    assert skin.torque_nm == pytest.approx(STIFF * 0.02)
    hands.scene.kick(0.03)
    hands.wait(0.1)
    gauges.resistances_ohm()
    assert skin.torque_nm == pytest.approx(STIFF * 0.02 + 0.03)


def test_a_press_on_a_skin_that_a_robot_turns_shows_in_its_torque_and_on_the_flange_and_stays():
    skin = SyntheticSkin(radius_mm=15.0)
    pushed = PushedSkin(skin)
    pushed.step(DT_S, 1.0)
    before_nm = -pushed.step(DT_S, 1.05)
    assert before_nm > 0.005
    pushed.kick(0.03)
    assert [-pushed.step(DT_S, 1.05) for _ in range(3)] == pytest.approx([before_nm + 0.03] * 3)
    assert skin.torque_nm == pytest.approx(before_nm + 0.03)
    assert -pushed.step(DT_S, 1.06) > before_nm + 0.03, "the wrist turns it on from there"


def test_a_converter_board_sends_the_mean_over_its_conversion():
    """The driver says that a reading belongs to the middle of its period."""
    skin = SyntheticSkin()
    circuit = Circuit(skin, level_a=0.005, output_on=True)
    lines = adc_lines(circuit)
    at_rest = next(lines)
    skin.push(1.0)
    pressed = [at_rest, *islice(lines, 2)]
    first, middle, last = (float(line.split(b",")[0]) for line in pressed)
    assert last - first > 0.005
    assert middle == pytest.approx((first + last) / 2, abs=2e-5)


def test_a_converter_board_converts_on_in_a_silence():
    """The first line after it is no mean with a voltage from before."""
    skin = SyntheticSkin()
    board = EmulatedAdcBoard(adc_lines(Circuit(skin, level_a=0.005, output_on=True)), period_s=0.1)
    board.command("silence")
    assert [board.next_line(0.1 * number) for number in range(2)] == [b"", b""]
    skin.push(1.0)
    board.next_line(0.2)
    board.command("normal")
    first, second = (float(board.next_line(0.3).split(b",")[0]) for _ in range(2))
    assert first == pytest.approx(second, abs=2e-5)
