"""The whole rig in a process of its own, met by the real clients: what is done to the tool is felt by all of them."""

import json
import signal
from contextlib import AsyncExitStack

import numpy as np
import pytest

from shearloop.drivers.connection import SerialLink
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import ObjectStatus
from shearloop.drivers.robotiq.modbus_client import ModbusClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from tests.cli.emulate_rig import rig as played

pytestmark = pytest.mark.real_time


async def test_a_twist_is_felt_by_load_cell_wrench_and_both_fingertips_and_is_gone_with_the_grip(rig):
    async with AsyncExitStack() as stack:
        arm = await stack.enter_async_context(played.arm_at(rig))
        await rig.fault("robot wrench-error 0")
        gripper = await stack.enter_async_context(played.open_gripper_at(rig))
        right = await stack.enter_async_context(played.Reader(played.kit_at(rig, "right").readings()))
        left = await stack.enter_async_context(played.Reader(played.kit_at(rig, "left").readings()))
        load = await stack.enter_async_context(
            played.Reader(LoadCell(SerialLink(path=rig.run_dir / "load-cell"), played.COUNTS).readings())
        )
        free = [await played.mean_of(right), await played.mean_of(left)]
        held = await played.grip(gripper)
        assert held.object is ObjectStatus.CONTACT_CLOSING
        assert held.diameter_mm == pytest.approx(20.0, abs=1.0)
        rest = [await played.mean_of(right), await played.mean_of(left)]
        assert [played.sigma_of(frame - idle) for frame, idle in zip(rest, free, strict=True)] == [
            pytest.approx(1.85, rel=0.02),
            pytest.approx(1.85, rel=0.02),
        ]
        assert await played.torque_of(load) == pytest.approx(0.0, abs=played.LOAD_NOISE_NM)

        origin_rad = (await rig.truth())["wrist_rad"]
        await played.twist(arm, 0.1)
        before = await rig.truth()
        frames = [await played.mean_of(right), await played.mean_of(left)]
        torque_nm = await played.torque_of(load)
        state = await arm.next_state()
        after = await rig.truth()
        # Gel and joint in series; the gel relaxes meanwhile, by a twelfth in the end.
        quick_nm = (before["wrist_rad"] - origin_rad) / (1 / 0.8 + 1 / 20)
        assert quick_nm == pytest.approx(0.077, rel=0.1)
        assert 0.9 * quick_nm < after["torque_nm"] < before["torque_nm"] < quick_nm
        assert after["torque_nm"] - played.LOAD_NOISE_NM < torque_nm < before["torque_nm"] + played.LOAD_NOISE_NM
        assert -before["torque_nm"] - 1e-6 < state.wrist_torque_nm < -after["torque_nm"] + 1e-6, "the tool resists"
        expected = played.CM_PER_NM * (before["shear_torque_nm"] + after["shear_torque_nm"]) / 2
        assert played.sigma_of(frames[0] - rest[0]) == pytest.approx(expected, rel=0.05)
        assert played.sigma_of(frames[1] - rest[1]) == pytest.approx(-expected, rel=0.05)

        await played.release(gripper)
        assert (await rig.truth(lambda truth: not truth["gripped"]))["torque_nm"] == 0.0
        assert await played.torque_of(load) == pytest.approx(0.0, abs=played.LOAD_NOISE_NM)
        assert (await arm.next_state()).wrist_torque_nm == pytest.approx(0.0, abs=1e-9)
        assert abs(played.sigma_of(await played.mean_of(right) - free[0])) < 0.02


async def test_the_modbus_gripper_the_papers_sketch_a_sigma_and_the_truth_in_a_file(bank, tmp_path):
    run_dir, truth = tmp_path / "run", tmp_path / "truth.jsonl"
    arguments = ("--bank", str(bank), "--run-dir", str(run_dir), *played.PACE, "--gripper", "modbus", "--paper-sketch")
    others = ("--truth", str(truth), "--sigma", "2.0", "1.3")
    rig = played.RigProcess(
        "rig", *arguments, *others, "--diameter-mm", "40", "--gel-stiffness", "0.4", module=3, ready="rig ready"
    )
    rig.run_dir = run_dir
    try:
        async with AsyncExitStack() as stack:
            gripper = RobotiqGripper(
                ModbusClient(path=str(run_dir / "gripper")), WidthCalibration.nominal(), poll_s=0.02
            )
            stack.push_async_callback(gripper.close)
            cell = LoadCell(SerialLink(path=run_dir / "load-cell"), LoadCalibration.of_torque_lines())
            load = await stack.enter_async_context(played.Reader(cell.readings()))
            right = await stack.enter_async_context(played.Reader(played.kit_at(rig, "right").readings()))
            await gripper.connect()
            await gripper.activate(may_drop=True)
            free = await played.mean_of(right)
            assert (await played.grip(gripper)).diameter_mm == pytest.approx(40.0, abs=1.0)
            await rig.fault("kick -0.06")
            assert await played.torque_of(load) == pytest.approx(-0.06, rel=0.08)
            shear_nm = (await rig.truth())["shear_torque_nm"]
            seen_nm = 0.4 - 0.2 * played.sigma_of(await played.mean_of(right) - free)
            assert seen_nm == pytest.approx(shear_nm, abs=0.004), "σ falls by 5 cm per N·m"
            await rig.fault("slip")
            slipped_rad = (await rig.truth(lambda truth: bool(truth["slipped_rad"])))["slipped_rad"]
            assert slipped_rad == pytest.approx(-0.06 * (1 / 0.4 + 1 / 20), rel=0.1), "a softer gel was asked for"
        rig.process.send_signal(signal.SIGTERM)
        assert rig.process.wait(10) == 0
    finally:
        rig.close()
    assert not list(run_dir.iterdir())
    lines = [json.loads(line) for line in truth.read_text().splitlines()]
    assert {"t_mono_ns", "time_s", "torque_nm", "diameter_mm"} <= lines[-1].keys()
    assert np.median(np.diff([line["time_s"] for line in lines])) == pytest.approx(0.1, rel=0.3)
    assert min(line["torque_nm"] for line in lines) == pytest.approx(-0.06, rel=0.08)
