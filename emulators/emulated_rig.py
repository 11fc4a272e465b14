"""The whole rig in one process: arm, gripper, load cell, EIT boards and shear skin, tied by one physics.

Arm → wrist angle → twin ← force of the fingers; twin → wrench, load cell, EIT frames and skin. The
controller's cycle makes time pass, so that all devices see the same moment.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

from shearloop.drivers.defaults import FRAME_PERIOD_S, LOAD_CELL_RATE_HZ, URCAP_PORT
from shearloop.drivers.robotiq.models import DEFAULT_MODEL, MODELS, GripperModel
from shearloop.emulators.boards import EitKitBoard, Hx711Board, Sketch, format_line
from shearloop.emulators.gripper import Fingers, Gripper, GripperPlayer, ModbusSlave, UrcapSession
from shearloop.emulators.numbers import number_between
from shearloop.emulators.ports import PtyServer, Server, SocketServer
from shearloop.emulators.scene import FloatArray, Joint, Scene, TwinSettings
from shearloop.emulators.skin import SkinInstruments
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.emulators.ur_controller import FAULTS, Controller
from shearloop.emulators.ur_robot import ControllerSpec, Robot

NOISE_NM = 0.0005
# Holds more than any limit on the torque, 6 N·m, allows.
CLAMP_N = 600.0
# The shear on the skin beyond which its membrane is not modelled.
MAX_SHEAR_N = 20.0
JOINTS = {joint.value: joint for joint in Joint}
# The pads face each other: a shear on the right has the opposite sign on the left.
SIDES = {"right": 1.0, "left": -1.0}
COMMANDS = (
    f"kick NM, slip [NM], weigh NM, flip load|FINGERTIP, joint {'|'.join(JOINTS)}, spring NM_PER_RAD, object MM|none, "
    "silence DEVICE [SECONDS], unplug DEVICE [SECONDS], replug DEVICE, right|left|load|skin FAULT, "
    "gripper drop|fault CODE|…, a fault of the robot, or normal"
)


class FrameSynthesiser(Protocol):
    """Makes the frames of one fingertip."""

    def line(self, grip: FloatArray, shear_torque_nm: FloatArray, diameter_mm: float) -> FloatArray:
        """Return the board's line, (v,) in volts, for grip (0…1) and shear at each injection, (L,) each."""


Device: TypeAlias = EitKitBoard | Hx711Board | SkinInstruments | GripperPlayer | Controller


class SkinOnTool:
    """The gauges of a synthetic skin that bears the whole torque of the scene's tool, as the other sensors do."""

    def __init__(self, skin: SyntheticSkin, scene: Scene) -> None:
        self._skin, self._scene = skin, scene
        self._rested_s = scene.time_s

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ now."""
        self._skin.rest(self._scene.time_s - self._rested_s)
        self._rested_s = self._scene.time_s
        shear_n = self._scene.twin.state.torque_nm * 1e3 / self._skin.radius_mm
        self._skin.push(min(max(shear_n, -MAX_SHEAR_N), MAX_SHEAR_N))
        return self._skin.resistances_ohm()


class EmulatedRig:
    """All devices: `run` plays all but the robot, and the `controller`, iterated over, makes time pass.

    `command` applies faults, `scene` is the true state. `ports` get the path or address of each port when it appears.
    """

    def __init__(
        self,
        synthesisers: Mapping[str, FrameSynthesiser],
        run_dir: Path,
        *,
        host: str = "127.0.0.1",
        gripper_on: Literal["socket", "modbus", "none"] = "socket",
        model: GripperModel = MODELS[DEFAULT_MODEL],
        load_cell: bool = True,
        load_rate_hz: float = LOAD_CELL_RATE_HZ,
        skin: Callable[[Scene], SkinInstruments] | None = None,
        twin: TwinSettings | None = None,
        diameter_mm: float = 20.0,
        speed: float = 1.0,
        rate_hz: float = 500.0,
        make: ControllerSpec | None = None,
        sketch: Sketch | None = None,
        seed: int = 0,
    ) -> None:
        """Gel, fingers and boards are `speed` times as fast as arm, answers and watchdog, which stay in real time.

        `synthesisers` are by the fingertips' names; `skin` makes the instruments of a skin on the scene's tool. Without
        a gripper the tool is clamped to the wrist.
        """
        gripper = Gripper(object_mm=diameter_mm, fingers=Fingers(model))
        self.scene = Scene(gripper, twin, speed, clamp_n=CLAMP_N if gripper_on == "none" else 0.0)
        self.controller = Controller(Robot(make, self.scene), host=host, rate_hz=rate_hz)
        # Fingertips that are mounted the other way round.
        self._flipped: set[str] = set()
        boards: dict[str, EitKitBoard | Hx711Board] = {
            side: EitKitBoard(
                self._frames(side, synthesiser, SIDES.get(side, (-1.0) ** number)),
                period_s=FRAME_PERIOD_S / speed,
                link=run_dir / f"eit-{side}",
                seed=seed + number,
            )
            for number, (side, synthesiser) in enumerate(synthesisers.items())
        }
        if load_cell:
            boards["load"] = Hx711Board(
                (sketch or Sketch(noise_counts=NOISE_NM * Sketch().counts_per_nm)).lines(
                    self._torques_nm(1 / load_rate_hz), seed
                ),
                period_s=1 / load_rate_hz / speed,
                link=run_dir / "load-cell",
                seed=seed,
            )
        self._played: list[EitKitBoard | Hx711Board | SkinInstruments | Server] = [*boards.values()]
        self.commanded: dict[str, Device] = {**boards}
        self.ports = {name: board.port.appearances for name, board in boards.items()}
        if skin is not None:
            self._add_skin(skin(self.scene))
        if gripper_on != "none":
            player = GripperPlayer(
                gripper,
                PtyServer(ModbusSlave(gripper), run_dir / "gripper")
                if gripper_on == "modbus"
                else SocketServer(UrcapSession(gripper), host, URCAP_PORT),
            )
            self._played.append(player.server)
            self.commanded["gripper"] = player
            self.ports["gripper"] = player.server.appearances
        self.commanded["robot"] = self.controller

    def _add_skin(self, instruments: SkinInstruments) -> None:
        self._played.append(instruments)
        self.commanded["skin"] = instruments
        self.ports |= {"skin-source": instruments.source_port, "skin-daq": instruments.daq_port}

    async def run(self) -> None:
        """Play all but the robot until cancelled; OSError, in a group, if an address or port is not available."""
        async with asyncio.TaskGroup() as group:
            for device in self._played:
                group.create_task(device.run())

    def command(self, text: str) -> None:
        """Execute a command; ValueError, with a sentence, for an unknown one."""
        match text.split():
            case ["kick", jump_nm]:
                self.scene.kick(torque(jump_nm))
            case ["slip", *left_nm] if len(left_nm) < 2:
                self.scene.slip(*map(torque, left_nm))
            case ["weigh", torque_nm]:
                self.scene.load_nm = torque(torque_nm)
            case ["flip", "load"]:
                self.scene.load_sign = -1.0
            case ["flip", side] if isinstance(self.commanded.get(side), EitKitBoard):
                self._flipped.add(side)
            case ["joint", name] if name in JOINTS:
                self.scene.put_on(JOINTS[name])
            case ["spring", nm_per_rad]:
                refusal = "no stiffness in N·m/rad from 0.05 to 50; write for instance 0.8"
                self.scene.put_on_spring(number_between(nm_per_rad, 0.05, 50.0, refusal))
            case ["object", *_]:
                self._device("gripper").command(text)
            case ["normal"]:
                self.scene.load_nm, self.scene.load_sign = 0.0, 1.0
                self._flipped.clear()
                for commanded in self.commanded.values():
                    commanded.command("normal")
            case ["replug", device]:
                self._device(device).command("normal")
            case ["silence" | "unplug" as outage, device, *seconds]:
                self._device(device).command(" ".join([outage, *seconds]))
            case [device, *words] if device in self.commanded and words:
                self.commanded[device].command(" ".join(words))
            case [name, *_] if name in FAULTS:
                self.controller.command(text)
            case _:
                raise ValueError(f"{text!r} is no command; there are {COMMANDS}")

    def _device(self, name: str) -> Device:
        if name not in self.commanded:
            raise ValueError(f"there is no device {name!r}; there are {', '.join(self.commanded)}")
        return self.commanded[name]

    def _frames(self, side: str, synthesiser: FrameSynthesiser, sign: float) -> Iterator[bytes]:
        while True:
            grip, shear_nm, width_mm = self.scene.frame(FRAME_PERIOD_S)
            seen_nm = -shear_nm if side in self._flipped else shear_nm
            yield format_line(synthesiser.line(grip, sign * seen_nm, width_mm))

    def _torques_nm(self, period_s: float) -> Iterator[float]:
        while True:
            yield self.scene.conversion_nm(period_s)


def torque(text: str) -> float:
    """Return the torque of a command in N·m; ValueError, with a sentence, for other text."""
    return number_between(text, -5.0, 5.0, "no torque in N·m of at most 5; write for instance 0.05")
