"""The page before a daemon whose sockets are open to the network: by keys, with keys not allowed, and without any."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from tests.daemon.conftest import running_daemon, shearloop


@dataclass
class Page:
    """What `shearloop view` serves, asked as a browser asks."""

    http: aiohttp.ClientSession
    address: str
    token: str

    async def post(self, path: str, *, token: bool = False) -> tuple[int, dict[str, Any]]:
        headers = {"Authorization": f"Bearer {self.token}"} if token else {}
        async with self.http.post(f"{self.address}{path}", headers=headers) as reply:
            return reply.status, await reply.json()

    async def hears(self) -> bool:
        """Return whether a message of the daemon comes to the page within two seconds."""
        async with self.http.ws_connect(f"{self.address}stream") as stream:
            async with asyncio.timeout(2.0):
                async for batch in stream:
                    if batch.json()["messages"]:
                        return True
        return False


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def places(keys, ran) -> dict[str, str]:
    """A daemon's addresses, on the network; its keys, and those of ada, who is allowed, and of eve, who is not."""
    ran("keys", "client", "--dir", keys / "eve")
    return {key: f"tcp://0.0.0.0:{free_port()}" for key in ("publish", "commands")}


@asynccontextmanager
async def page_of(places: dict[str, str], folder: Path, who: str | None) -> AsyncIterator[Page]:
    """Serve a page with somebody's keys, or with none."""
    near = {key: address.replace("0.0.0.0", "127.0.0.1") for key, address in places.items()}  # noqa: S104
    words = ["view", "--connect", near["publish"], "--commands", near["commands"], "--port", "0", "--json"]
    words += ["--token-file", str(folder / f"token-{who}")]
    if who is not None:
        words += ["--key", str(folder / who / "client.key_secret"), "--server-key", str(folder / "keys" / "server.key")]
    async with shearloop(*words) as view, aiohttp.ClientSession() as http:
        printed = json.loads(await view.stdout.readline())
        yield Page(http, printed["url"], printed["url_with_token"].partition("#token=")[2])


async def test_over_the_network_motion_needs_key_and_token_and_stop_neither(config, places, tmp_path):
    curve = {"server_key": str(tmp_path / "keys/server.key_secret"), "clients": str(tmp_path / "keys/clients")}
    async with running_daemon(config(**places, curve=curve)) as daemon:
        async with page_of(places, tmp_path, "ada") as page:
            assert await page.hears()
            for command in ("tare", "start", "pause", "resume", "unlock"):
                assert (await page.post(f"commands/{command}"))[0] == 403, command
            assert await page.post("commands/tare", token=True) == (200, {"ok": True, "tared": ["right"]})
            # It came to the daemon, which has nothing to start.
            status, reply = await page.post("commands/start", token=True)
            assert status == 409
            assert reply["reason"].startswith("no experiment is given")
            assert await page.post("stop") == (200, {"ok": True, "stopped": ""})
        for who in ("eve", None):
            async with page_of(places, tmp_path, who) as page:
                status, reply = await page.post("commands/tare", token=True)
                assert (status, reply["ok"]) == (503, False), who
                assert await page.post("stop") == (200, {"ok": True, "stopped": ""}), who
        assert daemon.health.tasks()["commands"]["errors"]["key is not allowed"] >= 1
        assert not daemon._end.is_set(), "a stop from a page ends what moves, and not the daemon"
