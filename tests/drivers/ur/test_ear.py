"""Listening with pauses, to a pipe of this process."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from drivers.ur.ear import Ear


class Listener:
    """What was heard through an ear, and when."""

    def __init__(self) -> None:
        self.reading, self.writing = os.pipe()
        os.set_blocking(self.reading, False)
        self.heard: list[bytes] = []
        self.times_s: list[float] = []
        self.news = asyncio.Event()
        self.ear = Ear(self.reading, self._hear)

    def _hear(self) -> None:
        try:
            self.heard.append(os.read(self.reading, 100))
        except BlockingIOError:
            return
        self.times_s.append(asyncio.get_running_loop().time())
        self.news.set()

    def say(self, data: bytes) -> None:
        os.write(self.writing, data)

    async def hears(self) -> bytes:
        async with asyncio.timeout(10):
            await self.news.wait()
        self.news.clear()
        return self.heard[-1]


@asynccontextmanager
async def a_listener() -> AsyncIterator[Listener]:
    one = Listener()
    try:
        yield one
    finally:
        one.ear.close()
        os.close(one.reading)
        os.close(one.writing)


async def test_what_is_said_is_heard() -> None:
    async with a_listener() as listener:
        listener.ear.listen()
        listener.ear.listen()
        for word in (b"a", b"b"):
            listener.say(word)
            assert await listener.hears() == word


async def test_what_is_said_in_a_pause_is_heard_at_once_after_it() -> None:
    async with a_listener() as listener:
        listener.ear.listen()
        begun_s = asyncio.get_running_loop().time()
        listener.ear.pause(0.05)
        for word in (b"a", b"b", b"c"):
            listener.say(word)
            await asyncio.sleep(0)
        assert await listener.hears() == b"abc"
        assert len(listener.heard) == 1
        assert listener.times_s[0] - begun_s >= 0.05 - 1e-3
        listener.say(b"d")
        assert await listener.hears() == b"d", "after the pause as before it"


async def test_a_pause_ends_when_somebody_wants_to_hear() -> None:
    async with a_listener() as listener:
        listener.ear.listen()
        listener.ear.pause(3600)
        listener.say(b"a")
        listener.ear.listen()
        assert await listener.hears() == b"a"


async def test_a_pause_that_nobody_was_silent_in_is_replaced_by_the_next() -> None:
    async with a_listener() as listener:
        listener.ear.pause(3600)
        listener.ear.pause(0.0)
        listener.say(b"a")
        assert await listener.hears() == b"a"


async def test_nothing_is_heard_after_the_end() -> None:
    async with a_listener() as listener:
        listener.ear.listen()
        listener.ear.pause(0.0)
        listener.ear.close()
        listener.say(b"a")
        listener.ear.listen()
        listener.ear.pause(0.0)
        for _ in range(3):
            await asyncio.sleep(0)
        assert listener.heard == []
