"""The whole rig in one process: arm, gripper, load cell, two EIT boards and a shear skin, tied by one physics.

Arm → wrist angle → twin ← force of the fingers; twin → wrench, load cell, EIT frames and the skin's gauges. The
controller's cycle makes time pass, so that all devices see the same moment.
"""

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from shearloop.drivers.eit_kit import FRAME_PERIOD_S
from shearloop.drivers.emulators import number_between
from shearloop.drivers.emulators.boards import LOAD_PERIOD_S, EitKitBoard, Hx711Board, Sketch
from shearloop.drivers.emulators.ports import PtyServer, SocketServer
from shearloop.drivers.emulators.robotiq.gripper import (
    URCAP_PORT,
    Gripper,
    GripperPlayer,
    modbus_server,
    urcap_server,
)
from shearloop.drivers.emulators.scene import FloatArray, Joint, Scene, Truth, TwinSettings
from shearloop.drivers.emulators.skin import Gauges, SkinInstruments
from shearloop.drivers.emulators.ur.robot import ControllerSpec, Robot, RobotEvent
from shearloop.drivers.emulators.ur.server import FAULTS, Controller, apply_fault

# Returns a frame (1024,) in volts from each injection's grip (0…1) and shear torque in N·m, (32,) each, and the tool's
# diameter in mm.
FrameOf = Callable[[FloatArray, FloatArray, float], FloatArray]

NOISE_NM = 0.0005
TRUTH_PERIOD_S = 0.1
# The pads face each other: a shear on the right has the opposite sign on the left.
SIDES = {"right": 1.0, "left": -1.0}
# For an outage without a duration.
A_DAY = "86400"
COMMANDS = (
    "kick NM, slip [NM], joint KIND, object MM|none, silence DEVICE [SECONDS], unplug DEVICE [SECONDS], replug DEVICE, "
    "right|left|load|skin FAULT, gripper drop|fault CODE|…, a fault of the robot, or normal"
)


@dataclass(frozen=True, slots=True)
class RigSkin:
    """A shear skin on one finger: `follow` receives the tool's torque in N·m and whether it is gripped."""

    follow: Callable[[float, bool], None]
    gauges: Gauges


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSettings:
    """The rig's devices, addresses and speed.

    `speed` accelerates gel, fingers and boards, `arm_speed` the arm. The answers of controller and gripper, their
    samples and the watchdog stay in real time, as their clients are.
    """

    run_dir: Path
    host: str = "127.0.0.1"
    gripper: Literal["socket", "modbus"] = "socket"
    gripper_port: int = URCAP_PORT
    twin: TwinSettings = field(default_factory=TwinSettings)
    diameter_mm: float | None = 20.0
    speed: float = 1.0
    arm_speed: float = 1.0
    rate_hz: float = 500.0
    # Whether a finger has a shear skin.
    skin: bool = False
    make: ControllerSpec = field(default_factory=ControllerSpec)
    sketch: Sketch = field(default_factory=lambda: Sketch(noise_counts=NOISE_NM * Sketch().counts_per_nm))
    seed: int = 0

    @property
    def ports(self) -> dict[str, Path]:
        """The paths of the serial devices."""
        names = {"right": "eit-right", "left": "eit-left", "load": "load-cell"}
        if self.gripper == "modbus":
            names["gripper"] = "gripper"
        if self.skin:
            names |= {"skin-source": "skin-source", "skin-daq": "skin-daq"}
        return {device: self.run_dir / name for device, name in names.items()}


class EmulatedRig:
    """All devices. `run` plays them, `command` applies faults, `scene` is the true state.

    `on_event` receives events of the robot, `on_truth` the true state ten times a second of the scene's time, and
    `on_ready` is called when every port is there.
    """

    def __init__(
        self,
        settings: RigSettings,
        frame_of: FrameOf,
        *,
        skin: RigSkin | None = None,
        on_event: Callable[[RobotEvent], None] | None = None,
        on_truth: Callable[[Truth], None] | None = None,
        on_ready: Callable[[], None] = lambda: None,
    ) -> None:
        self._settings = settings
        self._frame_of = frame_of
        self._on_truth = on_truth
        self._on_ready = on_ready
        self._awaited = {*SIDES, "load", "gripper"}
        gripper = Gripper()
        self.scene = Scene(gripper, settings.twin, settings.speed)
        self.player = GripperPlayer(gripper, self._gripper_server(gripper))
        if settings.diameter_mm is not None:
            self.player.command(f"object {settings.diameter_mm}")
        robot = Robot(settings.make, lambda wrist_rad, _, dt_s: self._step(dt_s, wrist_rad), settings.arm_speed)
        self.controller = Controller(robot, host=settings.host, rate_hz=settings.rate_hz, on_event=on_event)
        self.eit = {side: self._eit_board(side, number) for number, side in enumerate(SIDES)}
        self.load = Hx711Board(
            lambda: self.scene.conversion_nm(LOAD_PERIOD_S),
            settings.sketch,
            period_s=LOAD_PERIOD_S / settings.speed,
            link=settings.ports["load"],
            on_port=lambda _: self._appeared("load"),
            seed=settings.seed,
        )
        self._follow_skin = None if skin is None else skin.follow
        self.skin = None if skin is None else self._skin_instruments(skin.gauges)

    async def run(self) -> None:
        """Play until cancelled; OSError, alone or in a group, if an address or port is not available."""
        async with self.controller, asyncio.TaskGroup() as group:
            group.create_task(self.controller.run())
            group.create_task(self.player.serve())
            group.create_task(self.load.run())
            for board in self.eit.values():
                group.create_task(board.run())
            if self.skin is not None:
                group.create_task(self.skin.run())
            if self._on_truth is not None:
                group.create_task(self._report_truth(self._on_truth))

    def command(self, text: str) -> None:
        """Execute a command; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["kick", jump_nm]:
                self.scene.kick(_torque(jump_nm))
            case ["slip"]:
                self.scene.slip()
            case ["slip", left_nm]:
                self.scene.slip(_torque(left_nm))
            case ["joint", name]:
                self.scene.put_on(Joint.named(name))
            case ["object", *_]:
                self.player.command(text)
            case ["normal"]:
                for device in self._devices:
                    self._recover(device)
            case ["replug", device]:
                self._recover(device)
            case ["silence", device, *seconds]:
                self._command_device(device, " ".join(["silence", *seconds]))
            case ["unplug", device, *seconds]:
                self._command_device(device, " ".join(["unplug", *(seconds or [A_DAY])]))
            case [device, *words] if device in self._devices and words:
                self._command_device(device, " ".join(words))
            case [name, *_] if name in FAULTS:
                apply_fault(self.controller, text)
            case _:
                raise ValueError(f"{text!r} is no command; there are {COMMANDS}")

    @property
    def _devices(self) -> tuple[str, ...]:
        return ("load", "gripper", "robot", *SIDES, *(("skin",) if self.skin is not None else ()))

    def _command_device(self, device: str, text: str) -> None:
        if device not in self._devices:
            raise ValueError(f"there is no device {device!r}; there are {', '.join(self._devices)}")
        kind = text.split(maxsplit=1)[0]
        if device == "robot":
            apply_fault(self.controller, text)
        elif device == "gripper":
            self.player.command({"drop": "object none", "unplug": text.replace("unplug", "lose")}.get(kind, text))
        elif device == "load":
            self.load.command(text)
        elif device == "skin" and self.skin is not None:
            # Without its voltages the skin measures nothing; faults of the source are named `source`.
            self.skin.command(f"daq {text}" if kind in ("silence", "unplug") else text)
        else:
            self.eit[device].command(text)

    def _recover(self, device: str) -> None:
        if device == "gripper":
            self.player.recover()
        else:
            self._command_device(device, "normal")

    def _step(self, dt_s: float, wrist_rad: float) -> float:
        torque_nm = self.scene.step(dt_s, wrist_rad)
        if self._follow_skin is not None:
            state = self.scene.twin.state
            self._follow_skin(state.torque_nm, state.gripped)
        return torque_nm

    def _skin_instruments(self, gauges: Gauges) -> SkinInstruments:
        settings = self._settings
        self._awaited |= {"skin-source", "skin-daq"}
        return SkinInstruments(
            gauges,
            settings.ports["skin-source"],
            settings.ports["skin-daq"],
            on_port=lambda device, _: self._appeared(f"skin-{device}"),
            speed=settings.speed,
            seed=settings.seed,
        )

    def _gripper_server(self, gripper: Gripper) -> SocketServer | PtyServer:
        settings = self._settings
        if settings.gripper == "modbus":
            return modbus_server(gripper, settings.ports["gripper"], lambda _: self._appeared("gripper"))
        return urcap_server(gripper, settings.host, settings.gripper_port, lambda _: self._appeared("gripper"))

    def _eit_board(self, side: str, number: int) -> EitKitBoard:
        settings = self._settings
        return EitKitBoard(
            self._frames(SIDES[side]),
            period_s=FRAME_PERIOD_S / settings.speed,
            link=settings.ports[side],
            on_port=lambda _: self._appeared(side),
            seed=settings.seed + number,
        )

    def _frames(self, sign: float) -> Iterator[FloatArray]:
        while True:
            seen = self.scene.frame(FRAME_PERIOD_S)
            yield self._frame_of(seen.grip, sign * seen.shear_torque_nm, seen.diameter_mm)

    def _appeared(self, device: str) -> None:
        if device in self._awaited:
            self._awaited.discard(device)
            if not self._awaited:
                self._on_ready()

    async def _report_truth(self, on_truth: Callable[[Truth], None]) -> None:
        loop = asyncio.get_running_loop()
        period_s = TRUTH_PERIOD_S / self._settings.speed
        due_s = loop.time()
        while True:
            on_truth(self.scene.truth())
            due_s = max(due_s + period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())


def _torque(text: str) -> float:
    return number_between(text, -5.0, 5.0, "no torque in N·m of at most 5; write for instance 0.05")
