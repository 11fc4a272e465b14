"""The gripper by way of the robot's controller: the URCap's socket."""

import asyncio
from collections import deque
from collections.abc import Sequence

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DriverError
from shearloop.drivers.robotiq.messages import Readout, Request
from shearloop.drivers.robotiq.urcap import (
    PORT,
    READ_ORDER,
    STANDING_ORDER,
    ReplyParser,
    get_line,
    readout_of,
    set_lines,
    value_of,
)

CONNECT_DEADLINE_S = 2.0
# A reply takes some milliseconds; the controller serves the socket with a low priority.
REPLY_DEADLINE_S = 0.5


class SocketClient:
    """One connection to the URCap. Any failure closes it: after one, replies would belong to other questions."""

    def __init__(self, host: str, port: int = PORT, *, reply_deadline_s: float = REPLY_DEADLINE_S) -> None:
        """Name the controller; nothing is opened yet."""
        self._host = host
        self._port = port
        self._deadline_s = reply_deadline_s
        self._connection: _Connection | None = None

    @property
    def name(self) -> str:
        """Where the gripper is, for sentences."""
        return f"{self._host}:{self._port}"

    async def connect(self) -> None:
        """Open the connection; DeviceNotFoundError when nothing listens there."""
        await self.close()
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(CONNECT_DEADLINE_S):
                _, self._connection = await loop.create_connection(
                    lambda: _Connection(self.name, self._deadline_s), self._host, self._port
                )
        except OSError as error:  # a timeout is one
            raise DeviceNotFoundError(
                f"There is no gripper socket at {self.name} ({error or 'no answer'}); check the robot's address and "
                "that the Robotiq URCap is installed and runs."
            ) from error

    async def close(self) -> None:
        """Close the connection; closing twice is allowed."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.abort()
            await connection.closed

    async def read(self) -> Readout:
        """Return the status registers, asked for one after the other; DeviceLostError or ProtocolError."""
        return readout_of(await self._values(READ_ORDER))

    async def read_again(self, before: Readout) -> Readout:
        """Return the same, of which fewer are asked for while the fingers stand as before.

        Each question wakes this process.
        """
        values = await self._values(STANDING_ORDER)
        if tuple(values.values()) != (before.sta, before.gto, before.pre, before.obj, before.pos, before.flt):
            return await self.read()
        return before

    async def _values(self, variables: Sequence[str]) -> dict[str, int | None]:
        texts = await self._ask([(get_line(variable), variable) for variable in variables])
        return {name: value_of(name, text) for name, text in zip(variables, texts, strict=True)}

    async def write(self, request: Request) -> None:
        """Send a request and wait for its acknowledgements; DeviceLostError or ProtocolError."""
        await self._ask([(line, "") for line in set_lines(request)])

    async def _ask(self, questions: "Sequence[_Question]") -> list[str]:
        if self._connection is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        try:
            return await self._connection.ask(questions)
        except DriverError:
            self._connection = None
            raise


# A line to send, and the variable whose value it asks for; a line without one is to be acknowledged.
_Question = tuple[bytes, str]


class _Connection(asyncio.Protocol):
    """Asks one question after the other, each as soon as the one before is answered.

    Fifty to eighty questions a second: all is done where the answer is read, and no task is woken before the last one.
    """

    def __init__(self, name: str, deadline_s: float) -> None:
        loop = asyncio.get_running_loop()
        self.closed: asyncio.Future[None] = loop.create_future()
        self._loop = loop
        self._name = name
        self._deadline_s = deadline_s
        self._transport: asyncio.Transport | None = None
        self._parser = ReplyParser()
        self._questions: deque[_Question] = deque()
        self._answers: list[str] = []
        self._all_answered: asyncio.Future[list[str]] | None = None
        self._asked_s = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._failure: DriverError | None = None

    async def ask(self, questions: Sequence[_Question]) -> list[str]:
        """Return the answers, or raise why there are not all: then, or when it is cancelled, the connection ends."""
        if self._failure is not None:
            raise self._failure
        self._questions, self._answers = deque(questions), []
        answered = self._all_answered = self._loop.create_future()
        try:
            self._send_next()
            self._watch()
            answers: list[str] = await answered
        except BaseException as error:
            if self._failure is None:
                self._failure = (
                    error
                    if isinstance(error, DriverError)
                    else DeviceLostError(
                        f"A question to the gripper at {self._name} was given up, and the connection with it; it is "
                        "opened again by itself."
                    )
                )
            self.abort()
            raise
        finally:
            if self._timer is not None:
                self._timer.cancel()
            self._all_answered = None
        return answers

    def abort(self) -> None:
        """End the connection; not by waiting for bytes to a peer that may be gone."""
        if self._transport is not None:
            self._transport.abort()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the way out."""
        if not isinstance(transport, asyncio.Transport):
            raise TypeError(f"a connection's transport is a {type(transport).__name__}")
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Take what was answered, and ask on."""
        try:
            self._parser.feed(data)
            while self._questions and (answer := self._answer()) is not None:
                self._questions.popleft()
                self._answers.append(answer)
                if self._questions:
                    self._send_next()
                elif self._all_answered is not None and not self._all_answered.done():
                    self._all_answered.set_result(self._answers)
        except DriverError as error:
            self._fail(error)

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell who waits for an answer."""
        self.closed.set_result(None)
        self._fail(
            DeviceLostError(f"The controller closed the gripper's socket at {self._name}.")
            if exc is None
            else DeviceLostError(f"The connection to the gripper at {self._name} broke: {exc}.")
        )

    def _send_next(self) -> None:
        self._parser.expect_nothing()
        self._asked_s = self._loop.time()
        if self._transport is not None:
            self._transport.write(self._questions[0][0])

    def _answer(self) -> str | None:
        variable = self._questions[0][1]
        if variable:
            return self._parser.take_value(variable)
        return "" if self._parser.take_ack() else None

    def _watch(self) -> None:
        """Give up where the latest question has waited for too long, and else look again when it would have."""
        if not self._questions:
            # Answered just now, and late: who asked has not been woken yet.
            return
        due_s = self._asked_s + self._deadline_s
        if self._loop.time() < due_s:
            self._timer = self._loop.call_at(due_s, self._watch)
            return
        asked = self._questions[0][0].decode().strip()
        self._fail(
            DeviceLostError(
                f"The gripper's socket at {self._name} gave no whole answer to {asked!r} within {self._deadline_s:g} s."
            )
        )

    def _fail(self, error: DriverError) -> None:
        """Keep the first failure, which every later question meets, and end the connection."""
        if self._failure is None:
            self._failure = error
        if self._all_answered is not None and not self._all_answered.done():
            self._all_answered.set_exception(self._failure)
        self.abort()
