"""Random experiments, faults and timings through loop, runner and handler: no command to the arm exceeds its limits."""

import asyncio
import math
from collections.abc import Callable
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.control_loop import ControlOutput
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import GripStep
from shearloop.daemon.control.faults import Response
from shearloop.daemon.control.inputs import GripperStatus
from shearloop.daemon.torques import TorqueSample
from shearloop.drivers.ur.messages import MoveLinear, WristSpeed
from shearloop.emulators.scene import Twin, TwinSettings
from tests.daemon.control.cell import GRIP, Cell, Gripper, driven
from tests.daemon.control.loop_rig import EIT, new_loop, speed_of
from tests.drivers.ur.handler_bench import CYCLE_NS, LIMITS, FakeArm

SPEEDS = st.floats(0.01, 3.14)
STEPS = st.one_of(
    st.builds(lambda: {"do": "grip", "width_mm": 5, "force_n": 60}),
    st.builds(lambda: {"do": "release"}),
    st.builds(lambda s: {"do": "wait", "wait_s": s}, st.floats(0, 2)),
    st.builds(lambda a: {"do": "identify", "amplitude_rad": a}, st.floats(0.01, 0.6)),
    st.builds(lambda a, v: {"do": "turn_to", "angle_rad": a, "speed_rad_per_s": v}, st.floats(-6, 6), SPEEDS),
    st.builds(
        lambda a, v, h: {"do": "twist", "angles_rad": a, "speed_rad_per_s": v, "hold_s": h},
        st.lists(st.floats(-3, 3), min_size=1, max_size=3),
        SPEEDS,
        st.floats(0, 1),
    ),
    st.builds(
        lambda to, t, a, v: {
            "do": "tighten", "direction": to, "until_torque_nm": t, "until_angle_rad": a, "speed_rad_per_s": v
        },
        st.sampled_from(["clockwise", "counterclockwise"]),
        st.floats(0.01, 2),
        st.floats(0.01, 6),
        SPEEDS,
    ),
    st.builds(
        lambda t, r: {"do": "hold_torque", "torque_nm": t, "ramp_nm_per_s": r, "hold_s": 1},
        st.floats(-1, 1),
        st.floats(0.01, 1),
    ),
    st.builds(lambda d, v: {"do": "approach", "along_tool_m": d, "speed_m_per_s": v}, st.floats(-0.5, 0.5), SPEEDS.map(
        lambda v: min(v, 0.5)
    )),
)  # fmt: skip


class CheckedArm(FakeArm):
    """Notes what is beyond a limit, or sent while the robot must not move."""

    def __init__(self) -> None:
        super().__init__()
        self.wrong: list[object] = []

    def check(self, command: object, *rules: bool) -> None:
        self.wrong += [] if all(rules) else [command]

    def cycle(self) -> None:
        if self.reading.safety_mode != 1:
            # In a safety stop the controller brakes by itself, and forgets what it was told.
            self.target = 0.0
        super().cycle()

    def wrist(self, command: WristSpeed, left_s: float) -> bool:
        self.check(
            command,
            abs(command.rad_per_s) <= LIMITS.wrist_speed_rad_per_s.inner,
            0 < command.acceleration_rad_per_s2 <= LIMITS.wrist_acceleration_rad_per_s2.hard,
            self.reading.safety_mode == 1 or command.rad_per_s == 0,
        )
        return super().wrist(command, left_s)

    def move(self, command: MoveLinear) -> bool:
        box = LIMITS.workspace
        walls = zip(command.pose[:3], box.lower_m, box.upper_m, strict=True)
        inside = all(low + box.margin_m <= value <= high - box.margin_m for value, low, high in walls)
        slow = 0 < command.speed_m_per_s <= LIMITS.linear_speed_m_per_s.inner
        self.check(command, inside, slow, self.reading.safety_mode == 1)
        return super().move(command)


class TwinGripper(Gripper):
    """Fingers that close at once, and hold with a force if they meet anything."""

    force_n = 0.0

    async def grip(self, wish: GripStep) -> None:
        self.force_n = wish.force_n if wish.expect_object else 0.0
        self.on_closed()


class WholeRig(Cell):
    """A cell with the twin in its fingers, whose fingertip and load cell measure it."""

    def __init__(self) -> None:
        self.arm, self.twin = CheckedArm(), Twin(TwinSettings())
        self.silent = self.absurd = False
        self.fault, self.number = "", 0
        super().__init__(new_loop(), self.arm, TwinGripper())
        self.gripper.on_closed = self.sense_gripper
        self.tick, self.control_loop.tick = self.control_loop.tick, self.checked_tick

    def checked_tick(self, *given: Any) -> ControlOutput:
        output = self.tick(*given)
        held = self.control_loop.status.decision.response >= Response.HOLD
        fastest = 0.0 if held else self.control_loop.config.wrist_speed_rad_per_s
        self.arm.check((output, held), abs(speed_of(output)) <= fastest)
        return output

    def sense_gripper(self) -> None:
        holding = self.gripper.force_n > 0
        status = GripperStatus(self.robot.bench.now_ns, 20.0, holding=holding, moving=False, fault=self.fault)
        self.control_loop.on_gripper(status)

    def sense(self) -> None:
        self.number += 1
        now_ns, reading = self.robot.bench.now_ns, self.arm.reading
        torque_nm = self.twin.step(CYCLE_NS / 1e9, reading.wrist_rad, self.gripper.force_n).torque_nm
        self.arm.be(wrench=(0.0, 0.0, 0.0, 0.0, 0.0, torque_nm))
        self.sense_gripper()
        said = 1e30 if self.absurd else torque_nm
        if not self.silent and self.number % 11 == 0:
            self.control_loop.on_torque(TorqueSample("load_cell", said, "", now_ns - CYCLE_NS, now_ns))
        if not self.silent and self.number % 68 == 0:
            said, middle = math.nan if self.absurd else torque_nm, now_ns - round(EIT.window_s * 0.5e9)
            self.control_loop.on_torque(TorqueSample("right", said, "", middle, now_ns))
        wrist_rad, speed = reading.wrist_rad, reading.qd_rad_per_s[5]
        inside = LIMITS.joints.lower_rad[5] <= wrist_rad <= LIMITS.joints.upper_rad[5]
        self.arm.check(reading, inside, abs(speed) <= LIMITS.wrist_speed_rad_per_s.hard)

    async def unlock(self) -> None:
        self.arm.be(safety_mode=1)
        unlocking = asyncio.create_task(self.runner.unlock())
        while not unlocking.done():
            await self.cycles(1)


FAULTS: dict[str, Callable[[WholeRig], Any]] = {
    "protective": lambda rig: rig.arm.be(safety_mode=3),
    "emergency": lambda rig: rig.arm.be(safety_mode=7),
    "silent": lambda rig: setattr(rig, "silent", not rig.silent),
    "absurd": lambda rig: setattr(rig, "absurd", not rig.absurd),
    "gripper": lambda rig: setattr(rig, "fault", "" if rig.fault else "fault 14"),
    "drop": lambda rig: setattr(rig.gripper, "force_n", 0.0),
    "kick": lambda rig: setattr(rig.twin, "kick_nm", rig.twin.kick_nm + 0.3),
    "late": lambda rig: [rig.robot.cycle(read=False) for _ in range(40)],
    "pause": lambda rig: rig.control_loop.pause(),
    "resume": lambda rig: rig.control_loop.resume(),
    "stop": lambda rig: rig.runner.stop(),
    "unlock": WholeRig.unlock,
}


async def run_scenario(steps: list[dict[str, Any]], faults: list[tuple[int, str]], **keys: Any) -> None:
    async with driven(cell=WholeRig()) as rig:
        await rig.cycles(100)
        await rig.start(GRIP, *steps, **keys)
        for cycles, fault in [*faults, (150, "resume")]:
            await rig.cycles(cycles)
            happened = FAULTS[fault](rig)
            if asyncio.iscoroutine(happened):
                await happened
        if rig.phase is ExperimentPhase.STOPPED:
            await rig.cycles(60)
            assert abs(rig.arm.reading.qd_rad_per_s[5]) < 1e-9, "stopped, and yet it turns"
            assert rig.why
        assert rig.arm.wrong == []
        assert not rig.task.done()


@settings(max_examples=40, deadline=None)
@given(
    st.lists(STEPS, min_size=1, max_size=5),
    st.lists(st.tuples(st.integers(1, 150), st.sampled_from([*FAULTS])), max_size=6),
    st.sampled_from(["right", "load_cell"]),
    st.floats(0.05, 2.0),
)
@example([{"do": "turn_to", "angle_rad": 1.0, "speed_rad_per_s": 1.0}], [(32, "protective")], "right", 1.0)
def test_whatever_is_asked_and_whatever_happens_no_command_is_outside_the_limits(steps, faults, drive, torque_limit_nm):
    asyncio.run(run_scenario(steps, faults, torque_source=drive, limits={"torque_nm": torque_limit_nm}))
