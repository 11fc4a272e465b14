"""The control loop on a simulated rig, stepped in the loop's own ticks."""

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop, ControlOutput, Drive, End, StandStill
from shearloop.daemon.control.experiment import Action, ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile, GripStep
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.rig_memory import RigMemory
from shearloop.daemon.robot_files import RobotFiles
from shearloop.daemon.torques import TorqueSample, TorqueSource
from shearloop.daemon.wrench_zero import WrenchZero
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.ur.client import UrRobot
from shearloop.emulators.scene import Twin, TwinSettings
from tests.drivers.ur.handler_bench import SETTINGS

TICK_S = 0.008
# Its file is in the state folder of each test.
FILES = RobotFiles("192.168.1.10")
EIT = TorqueSource(name="right", period_s=0.5412, window_s=0.5412)
LOAD = TorqueSource(name="load_cell", period_s=1 / 10.9)
GRIP = {"do": "grip", "width_mm": 10.0, "force_n": 60.0}
CONFIG = LoopConfig()


def new_loop(config: LoopConfig = CONFIG, *, needs_zero: bool = False) -> ControlLoop:
    """Return the loop of a fingertip and a load cell, which may need a zero."""
    sources = {"right": EIT, "load_cell": replace(LOAD, needs_zero=needs_zero)}
    return ControlLoop(config, sources, ("gripper", "right"))


class Rig:
    """The twin with sensors and devices around it, stepped in the loop's own ticks: no I/O, no waiting."""

    def __init__(self, subject: ControlLoop, seed: int = 0, noise_nm: float = 0.012) -> None:
        self.control_loop = subject
        self.twin = Twin(TwinSettings(gel_stiffness_nm_per_rad=0.3))
        self.random = np.random.default_rng(seed)
        self.noise_nm = noise_nm
        self.tick = 0
        self.wrist_rad, self.speed = 0.3, 0.0
        self.force_n, self.width_mm = 0.0, 140.0
        self.window: deque[float] = deque(maxlen=round(EIT.window_s / TICK_S))
        # Whether the fingers meet a tool, expected or not.
        self.meets = False
        self.silent: set[str] = set()
        # When the fingertip's estimator has seen enough of the grip.
        self.warm_from_s, self.warm_up_s = 0.0, 0.0
        self.arm = ArmStatus(0.3, 0)
        self.hand = GripperStatus(0, 140.0, holding=False, moving=False)
        self.pending: list[tuple[int, Action]] = []
        self.begun: list[Action] = []
        self.orders: ControlOutput = StandStill()
        self.true_nm: list[float] = []

    @property
    def t_ns(self) -> int:
        return round(self.tick * TICK_S * 1e9)

    def step(self) -> None:
        self.tick += 1
        self.wrist_rad += self.speed * TICK_S
        state = self.twin.step(TICK_S, self.wrist_rad, self.force_n)
        self.true_nm.append(state.torque_nm)
        self.window.append(state.shear_torque_nm)
        self.sense(state.torque_nm)
        for due, action in list(self.pending):
            if self.tick >= due:
                self.pending.remove((due, action))
                self._finish(action)
        self.orders = self.control_loop.tick(self.t_ns, sent_rad_per_s=self.speed)
        self.speed = speed_of(self.orders)
        match self.orders:
            case Drive(action=action) if action is not None:
                self.begun.append(action)
                self.pending.append((self.tick + 100, action))
            case End(release=True):
                self.force_n = 0.0

    def sense(self, torque_nm: float) -> None:
        now = self.t_ns
        if "arm" not in self.silent:
            self.control_loop.on_arm(replace(self.arm, wrist_rad=self.wrist_rad, t_ns=now))
        if "hand" not in self.silent:
            hand = replace(self.hand, t_ns=now, holding=self.force_n > 0, width_mm=self.width_mm)
            self.control_loop.on_gripper(hand)
        if self.tick % 68 == 0 and "right" not in self.silent:
            middle = now - round(EIT.window_s * 0.5e9)
            value = float(np.mean(self.window) + self.random.normal(0.0, self.noise_nm))
            cold = now < self.warm_from_s * 1e9
            sample = None if cold else value
            self.control_loop.on_torque(TorqueSample("right", sample, "too recently" if cold else "", middle, now))
        if self.tick % 11 == 0 and "load_cell" not in self.silent:
            value = torque_nm + float(self.random.normal(0.0, 0.0005))
            self.control_loop.on_torque(TorqueSample("load_cell", value, "", now - 1_000_000, now))
        if self.tick % 5 == 0 and "wrench" in self.control_loop.sources:
            self.control_loop.on_torque(TorqueSample("wrench", torque_nm, "", now, now))

    def _finish(self, action: Action) -> None:
        if isinstance(action, GripStep):
            holds = action.expect_object or self.meets
            self.force_n = action.force_n if holds else 0.0
            self.width_mm = 30.0 if holds else action.width_mm
            self.warm_from_s = self.t_ns / 1e9 + self.warm_up_s
            # As the gripper's task does, before it says that the fingers have closed.
            self.control_loop.on_gripper(replace(self.hand, t_ns=self.t_ns, holding=holds, width_mm=self.width_mm))
        self.control_loop.on_action_ended()

    def run(self, most_s: float) -> None:
        for _ in range(round(most_s / TICK_S)):
            self.step()
            if self.control_loop.experiment is not None and not self.control_loop.experiment.running:
                return


def speed_of(orders: ControlOutput) -> float:
    """Return the wrist speed that the loop asks for, in rad/s."""
    return orders.rad_per_s if isinstance(orders, Drive) else 0.0


def started(rig: Rig, *steps: dict[str, Any], **keys: Any) -> Rig:
    for _ in range(70):
        rig.step()
    file = ExperimentFile.model_validate({"name": "test", "steps": list(steps), **keys})
    assert rig.control_loop.start(file, rig.t_ns, confirmed=True) is None
    return rig


def stop(rig: Rig) -> None:
    """Stop as the operator does."""
    rig.control_loop.stop(Fault(FaultCode.OPERATOR_STOP, "'test' was under way"))


def phase(rig: Rig) -> ExperimentPhase:
    return rig.control_loop.experiment.phase


def memory_of(
    loop: ControlLoop,
    cell: LoadCell | None = None,
    robot: UrRobot | None = None,
    files: RobotFiles = FILES,
    clock: Clock | None = None,
) -> RigMemory:
    """Return the restored memory of a rig, whose robot is not connected unless a test has its own."""
    wrench = WrenchZero(loop, UrRobot(SETTINGS) if robot is None else robot)
    memory = RigMemory(files, loop, cell, wrench, Clock() if clock is None else clock)
    memory.restore()
    return memory
