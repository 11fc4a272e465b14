"""The emulated gripper's two interfaces, the URCap's socket and Modbus RTU, and a player that moves it in real time.

Modbus: application protocol 1.1b3 and serial line 1.02; registers: the gripper's manual, chapter 4.
"""

import asyncio
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from shearloop.drivers.emulators import number_between
from shearloop.drivers.emulators.ports import Outage, PtyServer, SocketServer
from shearloop.drivers.emulators.robotiq.gripper import Gripper

URCAP_PORT = 63352
LONGEST_LINE = 256
_COMMANDS = {"ACT": "act", "GTO": "gto", "ATR": "atr", "ARD": "ard", "POS": "pos", "SPE": "spe", "FOR": "force"}

DEVICE_ID = 9
COMMAND_REGISTERS, STATUS_REGISTERS = range(0x03E8, 0x03EB), range(0x07D0, 0x07D3)
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
# A frame is at most 256 bytes. A pause ends it: 1.75 ms on the wire, longer on a busy host.
LONGEST_FRAME, PAUSE_S = 256, 0.1

STEP_S = 0.008
COMMANDS = (
    "object MM puts something of that width between the fingers, object none takes it away; "
    "fault CODE makes the gripper report a fault, cool ends one below 10; "
    "lose [SECONDS] breaks the connection, silence [SECONDS] leaves requests without an answer"
)


@dataclass(slots=True)
class UrcapSession:
    """One connection to the URCap. An invalid line gets no reply."""

    gripper: Gripper
    # The controller answers but has no data from the gripper: its values are `?`.
    no_data: bool = False
    _buffer: bytes = field(default=b"", init=False)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        self._buffer = self._buffer[-LONGEST_LINE:]
        return b"".join(self._reply(line.decode("ascii", "replace").split()) for line in lines)

    def _reply(self, words: list[str]) -> bytes:
        match words:
            case ["GET", variable]:
                return self._get(variable)
            case ["SET", *pairs] if pairs and len(pairs) % 2 == 0:
                return self._set(dict(zip(pairs[::2], pairs[1::2], strict=True)))
        return b""

    def _get(self, variable: str) -> bytes:
        gripper = self.gripper
        gripper.feed_watchdog()
        values = {
            "ACT": int(gripper.taken.act),
            "GTO": int(gripper.taken.gto),
            "ATR": int(gripper.command.atr),
            "ARD": int(gripper.command.ard),
            "SPE": gripper.command.spe,
            "FOR": gripper.command.force,
            "STA": gripper.sta,
            "OBJ": gripper.obj,
            "POS": gripper.pos,
            "PRE": gripper.taken.pos,
            "FLT": gripper.flt,
            "COU": gripper.current,
            "SID": DEVICE_ID,
            "PCO": gripper.pos,
        }
        if self.no_data or variable not in values:
            return f"{variable} ?\n".encode()
        text = str(values[variable])
        if variable == "FLT":
            text = text.rjust(2, "0")
            gripper.status_was_read()
        return f"{variable} {text}\n".encode()

    def _set(self, pairs: dict[str, str]) -> bytes:
        if not pairs.keys() <= _COMMANDS.keys():
            return b""
        if not all(text.isdigit() and int(text) <= 255 for text in pairs.values()):
            return b""
        self.gripper.feed_watchdog()
        command = self.gripper.command
        for name, text in pairs.items():
            kind = type(getattr(command, _COMMANDS[name]))
            setattr(command, _COMMANDS[name], kind(int(text)))
        return b"ack"


class UrcapServer(SocketServer):
    """Serves the gripper's socket; it can be lost, silent, or without data from the gripper."""

    def __init__(
        self,
        gripper: Gripper,
        host: str = "127.0.0.1",
        port: int = URCAP_PORT,
        on_port: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(self._new_session, host, port, on_port)
        self._gripper = gripper
        self.no_data = False

    def _new_session(self) -> Callable[[bytes], bytes]:
        session = UrcapSession(self._gripper)

        def answer(data: bytes) -> bytes:
            session.no_data = self.no_data
            return session.feed(data)

        return answer


def crc16(data: bytes) -> bytes:
    """Return the frame check, low byte first: CRC-16 with the polynomial 0xA001, reflected, from 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


class _ModbusError(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class ModbusSlave:
    """The gripper's end of the serial line. No I/O."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._buffer = b""
        self._last_s = 0.0
        self.damaged = 0

    def feed(self, data: bytes, t_s: float) -> bytes:
        """Return the reply frames to the bytes at `t_s`; damaged requests and those to other devices get none."""
        if t_s - self._last_s > PAUSE_S:
            self._buffer = b""
        self._last_s = t_s
        self._buffer += data
        replies = b""
        while (length := _request_length(self._buffer)) is not None and len(self._buffer) >= length:
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc16(frame[:-2]) != frame[-2:]:
                # The start of the next frame is unknown.
                self.damaged += 1
                self._buffer = b""
            elif frame[0] == DEVICE_ID:
                replies += self._reply(frame[1:-2])
        if len(self._buffer) > LONGEST_FRAME:
            self.damaged += 1
            self._buffer = b""
        return replies

    def _reply(self, request: bytes) -> bytes:
        self._gripper.feed_watchdog()
        try:
            answer = self._answer(request)
        except _ModbusError as error:
            answer = bytes([request[0] | 0x80, error.code])
        frame = bytes([DEVICE_ID]) + answer
        return frame + crc16(frame)

    def _answer(self, request: bytes) -> bytes:
        function = request[0]
        match function:
            case 3 | 4:
                first, count = struct.unpack(">HH", request[1:5])
                return self._read(function, first, count)
            case 6:
                first, value = struct.unpack(">HH", request[1:5])
                self._write(first, [value])
                return request
            case 16:
                first, count = struct.unpack(">HH", request[1:5])
                self._write(first, _words(request[6:], count))
                return request[:5]
            case 23:
                first, count, write_first, write_count = struct.unpack(">HHHH", request[1:9])
                self._write(write_first, _words(request[10:], write_count))
                return self._read(function, first, count)
        raise _ModbusError(ILLEGAL_FUNCTION)

    def _read(self, function: int, first: int, count: int) -> bytes:
        wanted = range(first, first + count)
        if not count or wanted[0] not in STATUS_REGISTERS or wanted[-1] not in STATUS_REGISTERS:
            raise _ModbusError(ILLEGAL_ADDRESS)
        gripper = self._gripper
        status = gripper.taken.act | gripper.taken.gto << 3 | gripper.sta << 4 | gripper.obj << 6
        content = bytes([status, 0, gripper.flt, gripper.taken.pos, gripper.pos, gripper.current])
        gripper.status_was_read()
        part = content[2 * (first - STATUS_REGISTERS[0]) :][: 2 * count]
        return bytes([function, len(part)]) + part

    def _write(self, first: int, values: list[int]) -> None:
        wanted = range(first, first + len(values))
        if not values or wanted[0] not in COMMAND_REGISTERS or wanted[-1] not in COMMAND_REGISTERS:
            raise _ModbusError(ILLEGAL_ADDRESS)
        command = self._gripper.command
        for register, value in zip(wanted, values, strict=True):
            high, low = value >> 8, value & 0xFF
            match register - COMMAND_REGISTERS[0]:
                case 0:
                    command.act, command.gto = bool(high & 1), bool(high & 1 << 3)
                    command.atr, command.ard = bool(high & 1 << 4), bool(high & 1 << 5)
                case 1:
                    command.pos = low
                case _:
                    command.spe, command.force = high, low


def _request_length(buffer: bytes) -> int | None:
    """Return the length of the request at the buffer's start, with its check, or None when too little has come."""
    if len(buffer) < 2:
        return None
    match buffer[1]:
        case 16:
            return 9 + buffer[6] if len(buffer) > 6 else None
        case 23:
            return 13 + buffer[10] if len(buffer) > 10 else None
    return 8


def _words(data: bytes, count: int) -> list[int]:
    if len(data) != 2 * count:
        raise _ModbusError(ILLEGAL_ADDRESS)
    return list(struct.unpack(f">{count}H", data))


class ModbusServer(PtyServer):
    """The slave on a pseudo-terminal; it can be lost, silent, or damage its next reply."""

    def __init__(
        self, gripper: Gripper, link: Path | None = None, on_port: Callable[[str], None] = lambda _: None
    ) -> None:
        super().__init__(self._reply_to, link, on_port)
        self._slave = ModbusSlave(gripper)
        self.damage_next = False

    def _reply_to(self, data: bytes) -> bytes:
        reply = self._slave.feed(data, asyncio.get_running_loop().time())
        if reply and self.damage_next and not self.silent:
            self.damage_next = False
            reply = reply[:-1] + bytes([reply[-1] ^ 0xFF])
        return reply


GripperServer = UrcapServer | ModbusServer


class GripperPlayer:
    """One gripper with one server, moved in real time or a multiple, with faults by commands."""

    def __init__(self, gripper: Gripper, server: GripperServer, speed: float = 1.0) -> None:
        self._gripper = gripper
        self._server = server
        self._speed = speed
        self._object_mm: float | None = None
        self._outages: asyncio.Queue[float] = asyncio.Queue()
        self._outage = Outage()
        gripper.between = lambda _: self._object_mm

    async def run(self) -> None:
        """Play until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self.serve())
            group.create_task(self._move())

    async def serve(self) -> None:
        """Serve until cancelled; the caller moves the gripper by its `step`."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            group.create_task(self._break())

    def recover(self) -> None:
        """End outages, and a fault below 10; the client has to end one from 10 on."""
        self._outage.end()
        self._end_silence()
        self._gripper.clear_minor()

    def command(self, text: str) -> None:
        """Carry out a line; ValueError, with a sentence, for an invalid one."""
        match text.split():
            case ["object", "none"]:
                self._object_mm = None
            case ["object", width]:
                self._object_mm = number_between(width, 0.0, 140.0, "not a width in mm from 0 to 140")
            case ["fault", code]:
                self._gripper.fail(int(number_between(code, 0, 15, "not a fault code from 0 to 15")))
            case ["cool"]:
                self._gripper.clear_minor()
            case ["lose", *seconds] if len(seconds) < 2:
                self._outages.put_nowait(_seconds(seconds))
            case ["silence", *seconds] if len(seconds) < 2:
                self._server.silent = True
                if seconds:
                    asyncio.get_running_loop().call_later(_seconds(seconds), self._end_silence)
            case _:
                raise ValueError(f"{text!r} is no command; {COMMANDS}")

    def _end_silence(self) -> None:
        self._server.silent = False

    async def _move(self) -> None:
        loop = asyncio.get_running_loop()
        last_s = loop.time()
        while True:
            await asyncio.sleep(STEP_S)
            now_s = loop.time()
            self._gripper.step((now_s - last_s) * self._speed)
            last_s = now_s

    async def _break(self) -> None:
        while True:
            seconds = await self._outages.get()
            await self._server.disconnect()
            await self._outage.wait(seconds)
            await self._server.restore()


def _seconds(words: list[str]) -> float:
    return number_between(words[0], 0.0, 86400.0, "not a time in seconds from 0 to 86400") if words else 0.0
