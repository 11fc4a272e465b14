"""`shearloop listen --json` and the page of `shearloop view`, as processes: what they give, and what it must be."""

import asyncio
import base64
import json
import math
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from tests.fixtures.daemons import shearloop
from tests.tools.recordings.every_message import Published, Recorded, Row, by_stream, value_of


def no_json(text: str) -> None:
    pytest.fail(f"{text} is no JSON")


def same(found: Any, expected: Any) -> bool:
    """Return whether two values are equal, with NaN and None for nothing."""
    if isinstance(expected, list):
        return len(found) == len(expected) and all(map(same, found, expected))
    if expected is None or found is None:
        return expected is None and (found is None or found == "" or math.isnan(found))
    if isinstance(expected, dict):
        return bool(json.loads(found) == expected) if isinstance(found, str) else bool(found == expected)
    return type(found) in (type(expected), float, int, np.bool_) and bool(found == expected)


def page_content(paged: Row) -> Row:
    """Return a message's content of a batch for the page, with its arrays as lists."""
    return {
        key: np.frombuffer(base64.b64decode(value["float32"]), "<f4").reshape(value["shape"]).tolist()
        if isinstance(value, dict) and "float32" in value
        else value
        for key, value in paged["content"].items()
    }


def check_message(topic: str, shown: Row, published: Row, row: Row | None) -> None:
    """Hold what is shown of a message to be all that was published, and the recorded row too, if there is one."""
    assert shown.keys() == {key for key in published if not key.endswith("_shape")}, topic
    for key, value in shown.items():
        truth = value_of(published, key)
        flat = np.array(value, float).round(6).ravel().tolist() if isinstance(truth, list) else value
        assert same(flat, truth), f"{topic} {key}: {value} is not {truth}"
        # Unix times of a recording have one offset for the file.
        kept = row["log_time_ns"] / 1e9 if row is not None and key == "timestamp" else truth
        assert row is None or same(row.get(key), kept), f"recorded {topic} {key}"


class Received:
    """What one way out gave, and a wait for a message of it."""

    def __init__(self) -> None:
        self.messages: Published = []
        self._more = asyncio.Event()

    def add(self, topic: str, content: Row) -> None:
        self.messages.append((topic, content))
        self._more.set()

    async def until(self, topic: str, **values: Any) -> None:
        """Wait for a message of a topic with at least these values."""
        while not any(
            name == topic and all(content[key] >= value for key, value in values.items())
            for name, content in self.messages
        ):
            self._more.clear()
            await self._more.wait()

    def numbers(self) -> dict[tuple[str, str], list[int]]:
        """Return the numbers of the messages of each topic and source, in their order."""
        found: dict[tuple[str, str], list[int]] = {}
        for topic, content in self.messages:
            found.setdefault((topic, content["source"]), []).append(content["seq"])
        return found


@dataclass
class Watched:
    """What `listen` and an open page gave, and the history with which a page that is opened later begins."""

    url: str
    http: aiohttp.ClientSession
    group: asyncio.TaskGroup
    listened: Received = field(default_factory=Received)
    paged: Received = field(default_factory=Received)
    history: Published = field(default_factory=list)

    async def open_later(self, topic: str, **values: Any) -> None:
        """Open a second page until it has a message of a topic with at least these values."""
        async with self.http.ws_connect(f"{self.url}stream", max_msg_size=0) as stream:
            later = Received()
            reading = self.group.create_task(_read_batches(stream, later, self.history))
            await later.until(topic, **values)
            reading.cancel()

    async def until_begun(self) -> None:
        """Wait until both have heard of the robot."""
        await asyncio.gather(self.listened.until("robot.state"), self.paged.until("robot.state"))

    async def until_ended(self) -> None:
        """Wait until both have said that the daemon ended."""
        await asyncio.gather(self.listened.until("daemon.end"), self.paged.until("daemon.end"))

    def check(self, recorded: Recorded, topics: set[str], not_paged: set[str]) -> None:
        """Hold all that came to be what was published and recorded, of just these topics."""
        published, rows = by_stream(recorded.published), recorded.by_stream()
        for received, expected in ((self.listened, topics), (self.paged, topics - not_paged)):
            found = by_stream(received.messages)
            came = {topic for topic, _, _ in found}
            assert came == expected, f"missing: {expected - came}, too many: {came - expected}"
            for stream, content in found.items():
                # The recording ends before the daemon says so.
                row = None if stream[0] == "daemon.end" else rows[stream]
                check_message(stream[0], content, published[stream], row)
        # `listen` leaves out none from its first on; the page has the latest of each thirtieth of a second.
        for (topic, source), found_numbers in self.listened.numbers().items():
            first = found_numbers[0]
            sent = sorted(seq for name, other, seq in published if (name, other) == (topic, source) and seq >= first)
            assert found_numbers == sent, (topic, source)


async def _read_lines(listen: asyncio.subprocess.Process, received: Received) -> None:
    async for line in listen.stdout:
        content = json.loads(line, parse_constant=no_json)
        received.add(content.pop("topic"), content)


async def _read_batches(stream: aiohttp.ClientWebSocketResponse, received: Received, history: Published) -> None:
    async for message in stream:
        batch = json.loads(message.data, parse_constant=no_json)
        history += [(one["topic"], one["content"]) for one in batch["history"]]
        for paged in batch["messages"]:
            received.add(paged["topic"], page_content(paged))


@asynccontextmanager
async def watching(folder: Path) -> AsyncIterator[Watched]:
    """Listen to the daemon of a folder, and open its page, before it runs."""
    addresses = ("--connect", f"ipc://{folder}/publish")
    viewing = ("--commands", f"ipc://{folder}/commands", "--port", "0", "--token-file", str(folder / "token"))
    async with AsyncExitStack() as opened:
        listen = await opened.enter_async_context(shearloop("listen", "--json", *addresses))
        view = await opened.enter_async_context(shearloop("view", "--json", *addresses, *viewing))
        url = json.loads(await view.stdout.readline())["url"]
        http = await opened.enter_async_context(aiohttp.ClientSession())
        first = await opened.enter_async_context(http.ws_connect(f"{url}stream", max_msg_size=0))
        # Its readers end before what they read from is closed.
        group = await opened.enter_async_context(asyncio.TaskGroup())
        watched = Watched(url, http, group)
        group.create_task(_read_lines(listen, watched.listened))
        group.create_task(_read_batches(first, watched.paged, []))
        yield watched
        listen.kill()
        await first.close()
