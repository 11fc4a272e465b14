"""What `shearloop listen --json` prints and `shearloop view` sends to its page is what a running daemon recorded."""

import asyncio
import json
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import aiohttp

from shearloop.daemon.web.message_store import CHARTED
from tests.fixtures.daemons import emulated_kit, running_daemon, shearloop
from tests.tools.recordings.every_message import Published, Recorded, Row, by_stream, latest_recording
from tests.tools.recordings.test_every_way_out import check_message, no_json, page_content

LAST_FRAME = 24
# The page takes no raw frames.
PAGED = {"eit.estimate", "eit.heatmap", "load.torque", "health", "daemon.end"}
LISTENED = {*PAGED, "eit.frame"}


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


async def read_lines(listen: asyncio.subprocess.Process, received: Received) -> None:
    async for line in listen.stdout:
        content = json.loads(line, parse_constant=no_json)
        received.add(content.pop("topic"), content)


async def read_batches(stream: aiohttp.ClientWebSocketResponse, received: Received, history: Published) -> None:
    async for message in stream:
        batch = json.loads(message.data, parse_constant=no_json)
        history += [(one["topic"], one["content"]) for one in batch["history"]]
        for paged in batch["messages"]:
            received.add(paged["topic"], page_content(paged))


async def watched(config: Path, folder: Path) -> tuple[Published, Received, Received, Published]:
    """Return what a daemon of two emulated boards published, what was listened to, the page's part, and its history."""
    published, listened, paged, history = Published(), Received(), Received(), Published()
    addresses = ("--connect", f"ipc://{folder}/publish")
    viewing = ("--commands", f"ipc://{folder}/commands", "--port", "0", "--token-file", str(folder / "token"))
    async with AsyncExitStack() as opened:
        group = await opened.enter_async_context(asyncio.TaskGroup())
        listen = await opened.enter_async_context(shearloop("listen", "--json", *addresses))
        view = await opened.enter_async_context(shearloop("view", "--json", *addresses, *viewing))
        url = json.loads(await view.stdout.readline())["url"]
        http = await opened.enter_async_context(aiohttp.ClientSession())
        first = await opened.enter_async_context(http.ws_connect(f"{url}stream", max_msg_size=0))
        group.create_task(read_lines(listen, listened))
        group.create_task(read_batches(first, paged, []))
        async with running_daemon(config) as daemon:
            daemon.publisher.add_listener(lambda topic, content: published.append((topic, content)))
            await asyncio.gather(listened.until("health"), paged.until("health"))
            load = ("--paper-sketch", "--torque-nm", "0.08", "--speed", "5", "--link", str(folder / "load-cell"))
            async with (
                emulated_kit(folder, LAST_FRAME + 1, "--once"),
                shearloop("emulate", "hx711", *load, stdin=asyncio.subprocess.PIPE),
            ):
                await listened.until("eit.estimate", frame=LAST_FRAME)
                await listened.until("load.torque", seq=10)
            # A page that is opened later begins with the last minute.
            await paged.until("eit.estimate", frame=LAST_FRAME)
            async with http.ws_connect(f"{url}stream", max_msg_size=0) as second:
                later = Received()
                reading = group.create_task(read_batches(second, later, history))
                await later.until("eit.estimate", frame=LAST_FRAME)
                reading.cancel()
        await asyncio.gather(listened.until("daemon.end"), paged.until("daemon.end"))
        listen.kill()
        await first.close()
    return published, listened, paged, history


def test_listen_and_the_page_give_what_was_recorded(config, tmp_path):
    path = config(load_cell={"device": {"path": "load-cell"}}, recording={"folder": str(tmp_path / "recordings")})
    sent, listened, paged, history = asyncio.run(watched(path, tmp_path))
    published = by_stream(sent)
    recorded = Recorded(latest_recording(tmp_path / "recordings"), sent).by_stream()
    for received, topics in ((listened, LISTENED), (paged, PAGED)):
        found = by_stream(received.messages)
        assert {topic for topic, _, _ in found} == topics
        for stream, content in found.items():
            # The recording ends before the daemon says so.
            row = None if stream[0] == "daemon.end" else recorded[stream]
            check_message(stream[0], content, published[stream], row)
    # `listen` leaves out none from its first on; the page has the latest of each thirtieth of a second.
    numbers: dict[tuple[str, str], list[int]] = {}
    for topic, content in listened.messages:
        numbers.setdefault((topic, content["source"]), []).append(content["seq"])
    for (topic, source), found in numbers.items():
        assert found == [seq for name, other, seq in published if (name, other) == (topic, source) and seq >= found[0]]
    assert numbers["eit.estimate", "right"] == [*range(LAST_FRAME + 1)]
    charted = {(topic, one["source"], one["timestamp"]): one for topic, one in sent}
    assert {topic for topic, _ in history} == {"eit.estimate", "load.torque"}
    for topic, sample in history:
        keys = ("source", "timestamp", *CHARTED[topic])
        truth = charted[topic, sample["source"], sample["timestamp"]]
        assert sample == {key: truth[key] for key in keys}, topic
