"""The gripper by way of its USB adapter: Modbus RTU with pymodbus, as the paper's authors drove it."""

import asyncio
import logging
from collections.abc import Awaitable
from typing import TypeVar

from pymodbus.client import AsyncModbusSerialClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from shearloop.drivers.connection import find_port
from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, ProtocolError
from shearloop.drivers.robotiq import registers
from shearloop.drivers.robotiq.messages import GripperMove, Readout, Request

T = TypeVar("T")

# What it would say of a late or broken answer is told here, by the error that it leads to.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

# An exchange takes 3 ms; a USB adapter may hold bytes back for 16 ms.
REPLY_DEADLINE_S = 0.3


class ModbusClient:
    """One serial connection. Any failure closes it: Modbus RTU cannot tell a late answer from the next one's."""

    def __init__(
        self,
        *,
        serial_number: str | None = None,
        path: str | None = None,
        reply_deadline_s: float = REPLY_DEADLINE_S,
    ) -> None:
        """Name the adapter by its USB serial number or by a path; nothing is opened yet."""
        if (serial_number is None) == (path is None):
            raise ValueError("the gripper's adapter is named either by its USB serial number or by its path")
        self._serial_number = serial_number
        self._path = path
        self._deadline_s = reply_deadline_s
        self._client: AsyncModbusSerialClient | None = None
        self._last = GripperMove(0, 0, 0)

    @property
    def name(self) -> str:
        """Where the gripper is, for sentences."""
        return self._path or f"the USB adapter {self._serial_number}"

    async def connect(self) -> None:
        """Find the port and open it; DeviceNotFoundError when it is not there or not to be had."""
        await self.close()
        path = find_port(serial_number=self._serial_number, path=self._path)
        # No retries and no reconnecting of its own: whoever waits for an answer is told at once.
        client = AsyncModbusSerialClient(
            path, baudrate=registers.BAUD_RATE, timeout=self._deadline_s, retries=0, reconnect_delay=0
        )
        try:
            there = await _heeded(client.connect())
        except BaseException:
            client.close()
            raise
        if not there:
            client.close()
            raise DeviceNotFoundError(f"{path} cannot be opened; is another program using the gripper?")
        self._client = client
        # The registers are written together: the target in them has to be the gripper's own, not ours from before.
        try:
            readout = await self.read()
        except BaseException:
            await self.close()
            raise
        self._last = GripperMove(readout.pre, self._last.speed, self._last.force)

    async def close(self) -> None:
        """Close the port; closing twice is allowed."""
        if self._client is not None:
            self._client.close()
        self._client = None

    async def read(self) -> Readout:
        """Return the status registers; DeviceLostError or ProtocolError."""
        response = await self._exchange(None)
        return registers.readout_of(response.registers)

    async def read_again(self, before: Readout) -> Readout:  # noqa: ARG002 - it all comes in one exchange
        """Return what `read` does."""
        return await self.read()

    async def write(self, request: Request) -> None:
        """Write the command registers; DeviceLostError or ProtocolError."""
        await self._exchange(registers.command_registers(request, self._last))
        if isinstance(request, GripperMove):
            self._last = request

    async def _exchange(self, command: list[int] | None) -> ModbusPDU:
        """Read the status, or write a command."""
        client = self._client
        if client is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        whole = False
        try:
            if command is None:
                request = client.read_holding_registers(
                    registers.FIRST_STATUS_REGISTER,
                    count=registers.N_STATUS_REGISTERS,
                    device_id=registers.DEVICE_ID,
                )
            else:
                request = client.write_registers(
                    registers.FIRST_COMMAND_REGISTER, command, device_id=registers.DEVICE_ID
                )
            response = await _heeded(request)
            whole = not response.isError()
        except (ModbusException, OSError) as error:
            raise DeviceLostError(
                f"The gripper at {self.name} did not answer within {self._deadline_s:g} s: "
                "unplugged, without power, or another program uses the port."
            ) from error
        finally:
            if not whole:
                await self.close()
        if response.isError():
            raise ProtocolError(f"The gripper at {self.name} refused a Modbus request: {response}.")
        return response


async def _heeded(waiting: Awaitable[T]) -> T:
    """Return what is waited for; raises CancelledError where this task was told to end meanwhile, whatever came of it.

    pymodbus waits by asyncio.wait_for, which before Python 3.12 loses a cancellation that comes with the answer.
    """
    task = asyncio.current_task()
    before = task.cancelling() if task is not None else 0
    result = await waiting
    if task is not None and task.cancelling() > before:
        raise asyncio.CancelledError
    return result
