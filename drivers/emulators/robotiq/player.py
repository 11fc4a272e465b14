"""A gripper played by itself: the model moves at its pace or a multiple, and is told by commands what happens to it."""

import asyncio
from typing import Protocol

from shearloop.drivers.emulators.ports import Outage
from shearloop.drivers.emulators.robotiq.gripper import Gripper

STEP_S = 0.008
COMMANDS = (
    "object MM puts something of that width between the fingers, object none takes it away; "
    "fault CODE makes the gripper report a fault, cool ends one below 10; "
    "lose [SECONDS] breaks the connection, silence [SECONDS] leaves requests without an answer"
)


class Server(Protocol):
    """A face's server, as far as a player needs it."""

    silent: bool

    async def run(self) -> None:
        """Serve until cancelled."""

    async def disconnect(self) -> None:
        """Break the connection."""

    async def restore(self) -> None:
        """Let it be made again."""


class GripperPlayer:
    """One gripper with one face."""

    def __init__(self, gripper: Gripper, server: Server, speed: float = 1.0) -> None:
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
        """Play until cancelled, with somebody else moving the gripper by its `step`."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            group.create_task(self._break())

    def recover(self) -> None:
        """End what keeps the gripper from answering, and a fault below 10; one from 10 on is the client's to end."""
        self._outage.end()
        self._speak()
        self._gripper.clear_minor()

    def command(self, text: str) -> None:
        """Do what a line says; ValueError, with a sentence, for one that says nothing known."""
        match text.split():
            case ["object", "none"]:
                self._object_mm = None
            case ["object", width]:
                self._object_mm = _number(width, 0.0, 140.0, "a width in mm")
            case ["fault", code]:
                self._gripper.fail(int(_number(code, 0, 15, "a fault code")))
            case ["cool"]:
                self._gripper.clear_minor()
            case ["lose", *seconds] if len(seconds) < 2:
                self._outages.put_nowait(_seconds(seconds))
            case ["silence", *seconds] if len(seconds) < 2:
                self._server.silent = True
                if seconds:
                    asyncio.get_running_loop().call_later(_seconds(seconds), self._speak)
            case _:
                raise ValueError(f"{text!r} is no command; {COMMANDS}")

    def _speak(self) -> None:
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
    return _number(words[0], 0.0, 86400.0, "a time in seconds") if words else 0.0


def _number(text: str, low: float, high: float, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise ValueError(f"{text!r} is not {what} from {low:g} to {high:g}")
    return value
