"""The gripper over its USB adapter: Modbus RTU with pymodbus (manual, "Gripper register mapping")."""

import logging
import time
from collections.abc import Callable, Sequence

from pymodbus.client import AsyncModbusSerialClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from shearloop.drivers.connection import find_port
from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, ProtocolError
from shearloop.drivers.robotiq import messages

# Errors carry what pymodbus would log.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

# An exchange takes 3 ms; a USB adapter may hold bytes back for 16 ms.
REPLY_DEADLINE_S = 0.3
BAUD_RATE = 115200
DEVICE_ID = 9
FIRST_COMMAND_REGISTER, FIRST_STATUS_REGISTER, N_STATUS_REGISTERS = 0x03E8, 0x07D0, 3
_ACT, _GTO = 1 << 0, 1 << 3


def command_registers(request: messages.Request, last: messages.GripperMove, *, act: bool) -> list[int]:
    """Return the three registers from 0x03E8 for a request; one without a target keeps the last target.

    `act` is the gripper's present ACT, which a halt and a move keep: a rising edge would begin an activation.
    """
    kept = _ACT if act else 0
    match request:
        case messages.GripperAction.RESET:
            action = 0
        case messages.GripperAction.ACTIVATE:
            action = _ACT
        case messages.GripperAction.HALT:
            action = kept
        case messages.GripperMove():
            action, last = kept | _GTO, request
    return [action << 8, last.position, last.speed << 8 | last.force]


def readout_of(registers: Sequence[int]) -> messages.Readout:
    """Return the readout of the three registers from 0x07D0; ProtocolError for another number of them."""
    if len(registers) != N_STATUS_REGISTERS:
        raise ProtocolError(f"The gripper answered with {len(registers)} registers instead of {N_STATUS_REGISTERS}.")
    status, fault_and_echo, position_and_current = registers
    gripper = status >> 8
    return messages.Readout(
        act=bool(gripper & _ACT),
        gto=bool(gripper & _GTO),
        sta=messages.ActivationStatus(gripper >> 4 & 3),
        obj=messages.ObjectStatus(gripper >> 6 & 3),
        # The upper four bits belong to an optional controller that a USB gripper does not have.
        flt=fault_and_echo >> 8 & 0x0F,
        pre=fault_and_echo & 0xFF,
        pos=position_and_current >> 8,
        current=position_and_current & 0xFF,
    )


class ModbusClient:
    """One serial connection. Any failure closes it: Modbus RTU does not distinguish a late answer from the next one."""

    def __init__(
        self, *, serial_number: str | None = None, path: str | None = None, reply_deadline_s: float = REPLY_DEADLINE_S
    ) -> None:
        """Name the adapter by its USB serial number or by a path; nothing is opened yet."""
        self._serial_number = serial_number
        self._path = path
        self._deadline_s = reply_deadline_s
        self._client: AsyncModbusSerialClient | None = None
        self._last = messages.GripperMove(0, 0, 0)
        # ACT as it was read last, and as it was written last. A gripper that has restarted has it at 0; a reset that it
        # has not taken up yet leaves it at 1.
        self._act_read = self._act_written = False

    @property
    def name(self) -> str:
        """The gripper's address, for messages."""
        return self._path or f"the USB adapter {self._serial_number}"

    async def connect(self) -> None:
        """Find the port and open it; DeviceNotFoundError when it is absent or in use."""
        await self.close()
        path = find_port(serial_number=self._serial_number, path=self._path)
        # No retries inside pymodbus: the caller reconnects.
        self._client = AsyncModbusSerialClient(
            path, baudrate=BAUD_RATE, timeout=self._deadline_s, retries=0, reconnect_delay=0
        )
        try:
            if not await self._client.connect():
                raise DeviceNotFoundError(f"{path} cannot be opened; is another program using the gripper?")
            # The registers are written together, so that the first write has to repeat the gripper's present target.
            readout = await self.read()
        except BaseException:
            await self.close()
            raise
        self._last = messages.GripperMove(readout.pre, self._last.speed, self._last.force)
        self._act_written = readout.act

    async def close(self) -> None:
        """Close the port; closing twice is allowed."""
        if self._client is not None:
            self._client.close()
        self._client = None

    async def read(self, *, whole: bool = True) -> messages.Readout:  # noqa: ARG002 - one answer holds them all
        """Return the status registers; DeviceLostError or ProtocolError."""
        response = await self._exchange(None)
        readout = readout_of(response.registers)
        self._act_read = readout.act
        return readout

    async def write(self, request: messages.Request, before: Callable[[], None] = lambda: None) -> None:
        """Write the command registers; DeviceLostError or ProtocolError. `before` is called as the last act before.

        Only `ACTIVATE` activates: a gripper that is not active takes a move as a fault, and stays where it is.
        """
        if request not in (messages.GripperAction.RESET, messages.GripperAction.ACTIVATE):
            # It can restart without a loss of the connection.
            await self.read()
        before()
        command = command_registers(request, self._last, act=self._act_read and self._act_written)
        await self._exchange(command)
        self._act_written = bool(command[0] >> 8 & _ACT)
        if isinstance(request, messages.GripperMove):
            self._last = request

    async def _exchange(self, command: list[int] | None) -> ModbusPDU:
        """Read the status, or write a command."""
        client = self._client
        if client is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        began_s = time.monotonic()
        try:
            if command is None:
                request = client.read_holding_registers(
                    FIRST_STATUS_REGISTER, count=N_STATUS_REGISTERS, device_id=DEVICE_ID
                )
            else:
                request = client.write_registers(FIRST_COMMAND_REGISTER, command, device_id=DEVICE_ID)
            response = await request
            if response.isError():
                raise ProtocolError(f"The gripper at {self.name} refused a Modbus request: {response}.")
        except BaseException as error:
            await self.close()
            if not isinstance(error, ModbusException | OSError):
                raise
            # A port that has gone fails at once.
            waited = time.monotonic() - began_s >= self._deadline_s
            why = f"did not answer within {self._deadline_s:g} s" if waited else "gives no answer"
            raise DeviceLostError(
                f"The gripper at {self.name} {why}: unplugged, without power, or another program uses the port."
            ) from error
        return response
