"""Modbus RTU as a face of the gripper: frames in, frames out, and a pseudo-terminal for them.

Layout: Modbus application protocol 1.1b3 and Modbus over serial line 1.02; registers: the gripper's manual, chapter 4.
"""

import asyncio
import struct
from collections.abc import Callable
from pathlib import Path

from shearloop.drivers.emulators.ports import PtyServer
from shearloop.drivers.emulators.robotiq.gripper import Gripper

DEVICE_ID = 9
COMMAND_REGISTERS = range(0x03E8, 0x03EB)
STATUS_REGISTERS = range(0x07D0, 0x07D3)
READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY, READ_WRITE = 3, 4, 6, 16, 23
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
# A frame is at most 256 bytes; a pause in the middle of one ends it (on the wire 1.75 ms, but a busy host is slower).
LONGEST_FRAME = 256
PAUSE_S = 0.1


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


class ModbusFace:
    """The gripper's end of the serial line."""

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._buffer = b""
        self._last_s = 0.0
        self.damaged = 0

    def feed(self, data: bytes, t_s: float) -> bytes:
        """Return the reply frames to what has come by `t_s`; requests to other devices and damaged ones get none."""
        if t_s - self._last_s > PAUSE_S:
            self._buffer = b""
        self._last_s = t_s
        self._buffer += data
        replies = b""
        while (length := _request_length(self._buffer)) is not None and len(self._buffer) >= length:
            frame, self._buffer = self._buffer[:length], self._buffer[length:]
            if crc16(frame[:-2]) != frame[-2:]:
                # Where the next frame would begin cannot be known.
                self.damaged += 1
                self._buffer = b""
            elif frame[0] == DEVICE_ID:
                replies += self._reply(frame[1:-2])
        if len(self._buffer) > LONGEST_FRAME:
            self.damaged += 1
            self._buffer = b""
        return replies

    def _reply(self, request: bytes) -> bytes:
        self._gripper.heard()
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
        status = gripper.act | gripper.gto << 3 | gripper.sta << 4 | gripper.obj << 6
        content = bytes([status, 0, gripper.flt, gripper.pre, gripper.pos, gripper.current])
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
    """Return how long the request at the buffer's beginning is, with its check; None when too little has come."""
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
    """The face on a pseudo-terminal; on request it is lost, silent, or damages its next reply."""

    def __init__(
        self, gripper: Gripper, link: Path | None = None, on_port: Callable[[str], None] = lambda _: None
    ) -> None:
        super().__init__(self._reply_to, link, on_port)
        self._face = ModbusFace(gripper)
        self.damage_next = False

    def _reply_to(self, data: bytes) -> bytes:
        reply = self._face.feed(data, asyncio.get_running_loop().time())
        if reply and self.damage_next and not self.silent:
            self.damage_next = False
            reply = reply[:-1] + bytes([reply[-1] ^ 0xFF])
        return reply
