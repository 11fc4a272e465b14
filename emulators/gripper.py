"""An emulated Robotiq gripper: its mechanics, the URCap's socket and Modbus RTU, and a player that moves it in time.

Modbus: application protocol 1.1b3 and serial line 1.02; registers: the gripper's manual, chapter 4. `Gripper`,
`UrcapSession` and `ModbusSlave` have no I/O; `step` passes the time.
"""

import asyncio
import math
import struct
import time
from dataclasses import dataclass, field, replace
from typing import Any

from pymodbus.framer import FramerRTU

from shearloop.drivers.robotiq.models import DEFAULT_MODEL, MODELS, GripperModel
from shearloop.emulators.numbers import number_between
from shearloop.emulators.ports import Server

COUNTS_MAX = 255
FIRST_MAJOR_FAULT = 10
ACTIVATION_NOT_FINISHED, NOT_ACTIVATED, OVER_TEMPERATURE = 5, 7, 8
ACTIVATION_SPEED_MM_S = 150.0

_COMMANDS = {"ACT": "act", "GTO": "gto", "POS": "pos", "SPE": "spe", "FOR": "force"}

DEVICE_ID = 9
COMMAND_REGISTERS, STATUS_REGISTERS = struct.pack(">HH", 0x03E8, 3), struct.pack(">HH", 0x07D0, 3)
READ, WRITE = 3, 16
# A request with its check: to read the status, or to write the three command registers.
READ_BYTES, WRITE_BYTES = 8, 15

STEP_S = 0.008


@dataclass(frozen=True, slots=True)
class GripperRegisters:
    """The command registers."""

    act: bool = False
    gto: bool = False
    pos: int = 0
    spe: int = 0
    force: int = 0


@dataclass(frozen=True, slots=True)
class Fingers:
    """The true width over the counts: from the model's stroke at `open_counts` to 0 at `closed_counts`.

    Half-way it is wider than a straight line by `bow_mm`.
    """

    model: GripperModel = MODELS[DEFAULT_MODEL]
    open_counts: float = 3.0
    closed_counts: float = 230.0
    bow_mm: float = 0.0

    def width_mm(self, counts: float) -> float:
        """Return the width at a position."""
        closed = (counts - self.open_counts) / (self.closed_counts - self.open_counts)
        return self.model.stroke_mm * (1 - closed) + 4 * self.bow_mm * closed * (1 - closed)

    def counts(self, width_mm: float) -> float:
        """Return the position of a width."""
        stroke_mm, bow_mm = self.model.stroke_mm, self.bow_mm
        straight = stroke_mm - 4 * bow_mm
        # The root of a quadratic equation, in the form that a bow of 0 does not divide by.
        root = math.sqrt(straight**2 + 16 * bow_mm * (stroke_mm - width_mm))
        return self.open_counts + (self.closed_counts - self.open_counts) * 2 * (stroke_mm - width_mm) / (
            straight + root
        )


_BARE_2F_140 = Fingers()


class Gripper:
    """One gripper: `write` sets the command registers, `step` moves the fingers.

    Closing, they stop at `object_mm`; opening, at `widest_mm`. The next step takes up commands: until then the status
    belongs to the motion before, as on the real gripper.
    """

    def __init__(self, object_mm: float | None = None, fingers: Fingers = _BARE_2F_140) -> None:
        """Start as after power-on: reset, half open."""
        self.object_mm = object_mm
        self.fingers = fingers
        self.widest_mm: float | None = None
        self.powered = True
        self.command = GripperRegisters()
        # The commands that the last step has taken up.
        self.taken = GripperRegisters()
        # gOBJ: 0 moving, 1 contact opening, 2 contact closing, 3 at target; gFLT; gCU: motor current in 10 mA.
        self.obj = self.flt = self.current = 0
        self._position = float(COUNTS_MAX // 2)
        # The positions that an activation has still to reach; None before it begins.
        self._to_reach: list[float] | None = None

    @property
    def sta(self) -> int:
        """gSTA: 0 reset, 1 activating, 3 active."""
        return 0 if self._to_reach is None else 1 if self._to_reach else 3

    @property
    def pos(self) -> int:
        """gPO: the position, rounded to counts."""
        return min(max(round(self._position), 0), COUNTS_MAX)

    @property
    def width_mm(self) -> float:
        """The true width between the fingers, mm."""
        return self.fingers.width_mm(self._position)

    @property
    def grip_force_n(self) -> float:
        """The force on the object between the fingers, N; 0 without one."""
        low, high = self.fingers.model.force_n
        return low + (high - low) * self.taken.force / COUNTS_MAX if self.obj == 2 else 0.0

    def write(self, registers: GripperRegisters) -> None:
        """Set the command registers."""
        self.command = registers

    def fail(self, code: int) -> None:
        """Report a fault and stop; from 10 on only a rising edge of ACT ends it."""
        self.flt, self.current = code, 0

    def clear_minor(self) -> None:
        """End a fault below 10, as cooling down does."""
        if self.flt < FIRST_MAJOR_FAULT:
            self.flt = 0

    def step(self, dt_s: float) -> None:
        """Take up the command registers, then move for dt_s."""
        self._take_up()
        if self.flt >= FIRST_MAJOR_FAULT:
            self.current = 0
        elif self._to_reach:
            if self._approach(self._to_reach[0], ACTIVATION_SPEED_MM_S, dt_s):
                del self._to_reach[0]
                if not self._to_reach:
                    self.flt, self.obj = 0, 3
        elif self.sta == 3 and self.taken.gto and self.flt != OVER_TEMPERATURE:
            low, high = self.fingers.model.speed_mm_per_s
            self._approach(float(self.taken.pos), low + (high - low) * self.taken.spe / COUNTS_MAX, dt_s)

    def _take_up(self) -> None:
        wanted, before = self.command, self.taken
        self.taken = wanted
        if not wanted.act:
            self._to_reach, self.obj, self.current = None, 0, 0
            if before.act:
                self.flt = 0
            if wanted.gto and not before.gto:
                self.flt = NOT_ACTIVATED
        elif not before.act:
            opened, closed = self.fingers.open_counts, self.fingers.closed_counts
            self._to_reach, self.flt = [opened, closed, opened], ACTIVATION_NOT_FINISHED

    def _approach(self, target: float, speed_mm_per_s: float, dt_s: float) -> bool:
        """Move towards a position; return whether the fingers have stopped, there or at an object."""
        fingers = self.fingers
        # The manual gives the speed of the whole stroke.
        travel = speed_mm_per_s * dt_s * (fingers.closed_counts - fingers.open_counts) / fingers.model.stroke_mm
        closing = target > self._position
        # The fingers' own stops count as the target: a real gripper that closes on air reports no object.
        stop = target = min(max(target, fingers.open_counts), fingers.closed_counts)
        if closing and self.object_mm is not None:
            stop = min(target, fingers.counts(self.object_mm))
        elif not closing and self.widest_mm is not None:
            stop = max(target, fingers.counts(self.widest_mm))
        # An object wider than the opening pushes the fingers apart.
        self._position = min(self._position + travel, stop) if closing else max(self._position - travel, stop)
        if self._position != stop:
            self.obj, self.current = 0, 15
            return False
        self.obj, self.current = (3, 0) if stop == target else (1 + closing, 5 + self.taken.force // 5)
        return True


@dataclass(slots=True)
class UrcapSession:
    """One connection to the URCap."""

    gripper: Gripper
    _buffer: bytes = field(default=b"", init=False)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        return b"".join(self._reply(line.decode("ascii", "replace").split()) for line in lines)

    def _reply(self, words: list[str]) -> bytes:
        match words:
            case ["GET", variable]:
                return f"{variable} {self._get(variable)}\n".encode()
            case ["SET", *pairs]:
                self._set(dict(zip(pairs[::2], pairs[1::2], strict=True)))
                return b"ack"
        return b""

    def _get(self, variable: str) -> str:
        gripper = self.gripper
        values = {
            "ACT": int(gripper.taken.act),
            "GTO": int(gripper.taken.gto),
            "STA": gripper.sta,
            "OBJ": gripper.obj,
            "POS": gripper.pos,
            "PRE": gripper.taken.pos,
            "FLT": gripper.flt,
            "COU": gripper.current,
        }
        if not gripper.powered or variable not in values:
            return "?"
        if variable == "FLT":
            return f"{values[variable]:02}"
        return str(values[variable])

    def _set(self, pairs: dict[str, str]) -> None:
        # Automatic release, ATR, is not played.
        values = {name: int(text) for name, text in pairs.items() if name != "ATR"}
        changed: dict[str, Any] = {_COMMANDS[name]: value for name, value in values.items()}
        self.gripper.write(replace(self.gripper.command, **changed))


def crc16(data: bytes) -> bytes:
    """Return the frame check."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")


class ModbusSlave:
    """The gripper's end of the serial line: its status and its command are read and written as a whole. No I/O."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._buffer = b""

    def feed(self, data: bytes) -> bytes:
        """Return the reply frames to the requests that `data` completes; damaged ones get none."""
        self._buffer += data
        replies = b""
        while len(self._buffer) >= (length := WRITE_BYTES if self._buffer[1:2] == bytes([WRITE]) else READ_BYTES):
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc16(frame[:-2]) != frame[-2:]:
                # The start of the next frame is unknown.
                self._buffer = b""
            elif self._gripper.powered:
                answer = bytes([DEVICE_ID]) + self._answer(frame[1:-2])
                replies += answer + crc16(answer)
        return replies

    def _answer(self, request: bytes) -> bytes:
        gripper = self._gripper
        if request == bytes([READ]) + STATUS_REGISTERS:
            status = gripper.taken.act | gripper.taken.gto << 3 | gripper.sta << 4 | gripper.obj << 6
            return bytes([READ, 6, status, 0, gripper.flt, gripper.taken.pos, gripper.pos, gripper.current])
        if request[:5] != bytes([WRITE]) + COMMAND_REGISTERS:
            raise ValueError(f"the gripper has no such registers: {request.hex()}")
        action, _, _, pos, spe, force = request[6:]
        gripper.write(GripperRegisters(bool(action & 1), bool(action & 1 << 3), pos, spe, force))
        return request[:5]


class GripperPlayer:
    """One gripper with one server, moved in real time or a multiple, with faults by commands."""

    def __init__(self, gripper: Gripper, server: Server, speed: float = 1.0) -> None:
        self.server = server
        self._gripper = gripper
        self._speed = speed

    async def run(self) -> None:
        """Play until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self.server.run())
            last_s = time.monotonic()
            while True:
                await asyncio.sleep(STEP_S)
                now_s = time.monotonic()
                self._gripper.step((now_s - last_s) * self._speed)
                last_s = now_s

    def command(self, text: str) -> None:
        """Carry out a line; ValueError, with a sentence, for an invalid one."""
        match text.split():
            case ["object", "none"] | ["drop"]:
                self._gripper.object_mm = None
            case ["object", width]:
                stroke_mm = self._gripper.fingers.model.stroke_mm
                self._gripper.object_mm = number_between(
                    width, 0.0, stroke_mm, f"not a width in mm from 0 to {stroke_mm:g}"
                )
            case ["fault", code]:
                self._gripper.fail(int(number_between(code, 0, 15, "not a fault code from 0 to 15")))
            case _:
                self.server.command(text)
                if text == "normal":
                    # The client has to end a fault from 10 on.
                    self._gripper.clear_minor()
