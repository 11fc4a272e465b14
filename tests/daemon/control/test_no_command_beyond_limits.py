"""Random experiments, faults and timings through loop and handler: no command to the arm exceeds its limits."""

import dataclasses
import math
from typing import Any

from hypothesis import example, given, settings
from hypothesis import strategies as st

from shearloop.daemon.control.experiment import Action, ExperimentPhase
from shearloop.daemon.control.experiment_schema import ApproachStep, ExperimentFile, GripStep
from shearloop.daemon.control.loop_inputs import ArmStatus, GripperStatus, TorqueSample
from shearloop.daemon.control.loop_runner import along_tool
from shearloop.daemon.control.safety import Response
from shearloop.drivers.emulators.scene import Twin, TwinSettings
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.messages import Enable, Heartbeat, MoveLinear, Stop, Unlock, WristSpeed
from tests.daemon.control.loop_rig import EIT, new_loop
from tests.drivers.ur.flight import CYCLE_NS, LIMITS, SETTINGS, FakeArm

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
        lambda t, a, v: {"do": "tighten", "until_torque_nm": t, "until_angle_rad": a, "speed_rad_per_s": v},
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
FAULTS = st.sampled_from(
    [
        "protective",
        "emergency",
        "silent",
        "gripper",
        "drop",
        "kick",
        "late",
        "absurd",
        "pause",
        "resume",
        "stop",
        "unlock",
    ]
)


class CheckedArm(FakeArm):
    """Refuses, by failing the test, what is beyond a limit or sent while the robot must not move."""

    def cycle(self) -> None:
        if self.reading.safety_mode != 1:
            # In a safety stop the controller brakes by itself, and forgets what it was told.
            self.target = 0.0
        super().cycle()

    def wrist(self, command: WristSpeed, left_s: float) -> bool:
        assert abs(command.rad_per_s) <= LIMITS.wrist_speed_rad_per_s.inner, command
        assert 0 < command.acceleration_rad_per_s2 <= LIMITS.wrist_acceleration_rad_per_s2.hard, command
        assert self.reading.safety_mode == 1 or command.rad_per_s == 0, "a robot in a safety stop was told to move"
        return super().wrist(command, left_s)

    def move(self, command: MoveLinear) -> bool:
        box = LIMITS.workspace
        for value, low, high in zip(command.pose, box.lower_m, box.upper_m, strict=False):
            assert low + box.margin_m <= value <= high - box.margin_m, command
        assert 0 < command.speed_m_per_s <= LIMITS.linear_speed_m_per_s.inner, command
        assert self.reading.safety_mode == 1
        return super().move(command)


class WholeRig:
    """Control loop and command handler with the twin between them, one cycle at a time."""

    def __init__(self) -> None:
        self.control_loop, self.arm, self.twin = new_loop(), CheckedArm(), Twin(TwinSettings())
        self.now_ns, self.number, self.force_n = 10**12, 0, 0.0
        self.handler = CommandHandler(SETTINGS, self.arm, self.now_ns)
        self.silent, self.absurd, self.fault = False, False, ""
        self.sent, self.stopped, self.late = 0.0, True, 0
        self.action: tuple[int, Action] | None = None

    def cycle(self) -> None:
        self.now_ns += CYCLE_NS
        self.arm.cycle()
        self.number += 1
        torque_nm = self.twin.step(CYCLE_NS / 1e9, self.arm.reading.wrist_rad, self.force_n).torque_nm
        self.arm.be(wrench=(0.0, 0.0, 0.0, 0.0, 0.0, torque_nm))
        self.handler.request(0, Heartbeat(), self.arm.reading, self.now_ns)
        self.handler.tick(self.arm.reading, self.now_ns)
        if self.late:
            self.late -= 1
            return
        self._sense(torque_nm)
        if self.action is not None and self.number >= self.action[0]:
            self._finish(self.action[1])
        orders = self.control_loop.tick(self.now_ns)
        if orders.ends_motion:
            if not self.stopped:
                self._ask(Stop(4.0))
            self.stopped, self.action = True, None
            self.force_n = 0.0 if orders.release else self.force_n
            return
        self.stopped = False
        if orders.action is not None:
            self._begin(orders.action)
        assert abs(orders.wrist_rad_per_s) <= self.control_loop.config.wrist_speed_rad_per_s
        if self.control_loop.status.decision.response >= Response.HOLD:
            assert orders.wrist_rad_per_s == 0.0, "held, and yet it turns"
        if orders.wrist_rad_per_s or self.sent:
            reply = self._ask(WristSpeed(orders.wrist_rad_per_s, 4.0))
            self.sent = reply.sent.rad_per_s if isinstance(reply.sent, WristSpeed) else 0.0
            self.control_loop.on_speed_sent(self.sent)

    def befall(self, fault: str) -> None:
        match fault:
            case "protective" | "emergency":
                self.arm.be(safety_mode=3 if fault == "protective" else 7)
            case "silent":
                self.silent = not self.silent
            case "absurd":
                self.absurd = not self.absurd
            case "gripper":
                self.fault = "" if self.fault else "fault 14"
            case "drop":
                self.force_n = 0.0
            case "kick":
                self.twin.kick_nm += 0.3
            case "late":
                self.late = 40
            case "pause":
                self.control_loop.pause()
            case "resume":
                self.control_loop.resume()
            case "stop":
                self.control_loop.stop("the operator said so")
            case "unlock":
                self.arm.be(safety_mode=1)
                self._ask(Unlock())
                self.control_loop.acknowledge()

    def _ask(self, command: Any) -> Any:
        reply = self.handler.request(self.number, command, self.arm.reading, self.now_ns)
        return reply if reply is not None else dataclasses.make_dataclass("Later", [("sent", object, None)])()

    def _sense(self, torque_nm: float) -> None:
        state = self.handler.state(self.arm.reading, self.number)
        self.control_loop.on_arm(
            ArmStatus(state.wrist_rad, self.now_ns, state.protective_stop, state.emergency_stop, state.blocked)
        )
        holding = self.force_n > 0
        self.control_loop.on_gripper(GripperStatus(self.now_ns, 20.0, holding=holding, moving=False, fault=self.fault))
        said = 1e30 if self.absurd else torque_nm
        if not self.silent and self.number % 11 == 0:
            self.control_loop.on_torque(TorqueSample("load_cell", said, "", self.now_ns - CYCLE_NS, self.now_ns))
        if not self.silent and self.number % 68 == 0:
            middle = self.now_ns - round(EIT.window_s * 0.5e9)
            self.control_loop.on_torque(
                TorqueSample("right", math.nan if self.absurd else torque_nm, "", middle, self.now_ns)
            )

    def _begin(self, action: Action) -> None:
        self.action = (self.number + 30, action)
        if isinstance(action, ApproachStep):
            pose = action.pose_m_rad or along_tool(self.arm.reading.tcp_pose, action.along_tool_m or 0.0)
            self._ask(MoveLinear(pose, action.speed_m_per_s, 0.3))

    def _finish(self, action: Action) -> None:
        self.action = None
        self.arm.be(moving_linearly=False)
        if isinstance(action, GripStep):
            self.force_n = action.force_n if action.expect_object else 0.0
            if self.control_loop.inputs.gripper is not None:
                self.control_loop.on_gripper(
                    dataclasses.replace(self.control_loop.inputs.gripper, holding=action.expect_object)
                )
        self.control_loop.on_action_ended()


@settings(max_examples=40, deadline=None)
@given(
    st.lists(STEPS, min_size=1, max_size=5),
    st.lists(st.tuples(st.integers(1, 150), FAULTS), max_size=6),
    st.sampled_from(["right", "load_cell"]),
    st.floats(0.05, 2.0),
)
@example([{"do": "turn_to", "angle_rad": 1.0, "speed_rad_per_s": 1.0}], [(32, "protective")], "right", 1.0)
def test_whatever_is_asked_and_whatever_happens_no_command_is_outside_the_limits(steps, story, drive, torque_limit_nm):
    rig = WholeRig()
    for _ in range(40):
        rig.cycle()
    rig._ask(Enable())
    for _ in range(70):
        rig.cycle()
    begin = [{"do": "grip", "width_mm": 5, "force_n": 60}]
    content = {"name": "any", "torque_source": drive, "steps": begin + steps, "limits": {"torque_nm": torque_limit_nm}}
    assert rig.control_loop.start(ExperimentFile.model_validate(content), rig.now_ns) is None
    for cycles, fault in [*story, (150, "resume")]:
        for _ in range(cycles):
            rig.cycle()
            wrist, speed = rig.arm.reading.wrist_rad, rig.arm.reading.qd_rad_per_s[5]
            assert LIMITS.joints.lower_rad[5] <= wrist <= LIMITS.joints.upper_rad[5]
            assert abs(speed) <= LIMITS.wrist_speed_rad_per_s.hard
        rig.befall(fault)
    experiment = rig.control_loop.experiment
    if experiment.phase is ExperimentPhase.STOPPED:
        for _ in range(60):
            rig.cycle()
        assert abs(rig.arm.reading.qd_rad_per_s[5]) < 1e-9, "stopped, and yet it turns"
        assert experiment.stop_reason
