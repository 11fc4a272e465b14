"""The page's server over real sockets: who is answered, with keys or without, what is passed on, what is never done."""

import asyncio
import hashlib
import json
import os
import signal
import socket
import stat
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import zmq.asyncio
from aiohttp import web
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.clock import Clock
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS
from shearloop.daemon.messaging.command_server import CommandRefusedError, CommandServer
from shearloop.daemon.messaging.messages import EitHeatmap, LoadTorque
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.web import bridge as bridge_module
from shearloop.daemon.web import server as server_module
from shearloop.daemon.web.bridge import Bridge, DaemonAddress
from shearloop.daemon.web.message_store import MessageStore
from shearloop.daemon.web.moments import Moments
from shearloop.daemon.web.server import (
    ASKED,
    HEADERS,
    NEEDS_TOKEN,
    host_allowed,
    listen,
    make_app,
    origin_allowed,
    serve,
)
from shearloop.daemon.web.tokens import WRONG_BURST, TokenCheck, default_token_path, load_token, token_valid
from shearloop.errors import UserError
from shearloop.tools.bank_config import FingertipGeometryConfig
from tests.fixtures.daemons import DEADLINE_S, free_port, running_daemon, shearloop
from tests.sample_messages import sample

TOKEN = "the token of this test, long enough for anybody"  # noqa: S105 - opens nothing but this test's page
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@dataclass
class Served:
    """A page's server, and the daemon's sockets that it looks at."""

    publisher: Publisher
    bridge: Bridge
    asked: list[str]
    base: str
    http: aiohttp.ClientSession


@asynccontextmanager
async def served(tmp_path: Path, **other: Any) -> AsyncIterator[Served]:
    """Serve the page before a daemon that accepts every command, but for `pause`, and for `other` handlers."""
    asked: list[str] = []

    def handler(name: str) -> Callable[[Mapping[str, Any]], Any]:
        async def handle(request: Mapping[str, Any]) -> dict[str, Any]:
            asked.append(name)
            if name == "pause":
                raise CommandRefusedError("no experiment is running")
            return {"stopped": "test"} if name == "stop" and request.get("spare_daemon") else {}

        return handle

    async def status(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"tasks": {}}

    publish, commands = f"ipc://{tmp_path}/publish", f"ipc://{tmp_path}/commands"
    handlers = {name: handler(name) for name in (*NEEDS_TOKEN, "stop")} | {"status": status} | other
    with zmq.asyncio.Context() as context:
        publisher = Publisher(context, publish, Clock())
        daemon = CommandServer(context, commands, handlers, Refusals())
        bridge = Bridge(context, DaemonAddress(publish, commands), MessageStore(3.6))
        tasks = [asyncio.create_task(run()) for run in (daemon.run, bridge.run)]
        runner = web.AppRunner(make_app(bridge, TOKEN, {"width_cm": 4.4}, publish), access_log=None, lingering_time=0.0)
        await runner.setup()
        listener = await listen(runner, 0)
        try:
            async with asyncio.timeout(DEADLINE_S), aiohttp.ClientSession() as http:
                yield Served(publisher, bridge, asked, f"http://127.0.0.1:{listener.sockets[0].getsockname()[1]}", http)
        finally:
            listener.close()
            await runner.cleanup()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await bridge.close()
            daemon.close()
            publisher.close()


async def until(is_so: Callable[[], bool]) -> None:
    """Wait for what another thread of libzmq brings about."""
    while not is_so():  # noqa: ASYNC110 - nobody tells it to an event loop
        await asyncio.sleep(0.001)


async def post(page: "Served | Page", path: str, **headers: str) -> tuple[int, dict[str, Any]]:
    if path.startswith("/commands/") and "moment=" not in path and "Authorization" in headers:
        path += f"{'&' if '?' in path else '?'}moment={await moment(page)}"
    async with page.http.post(page.base + path, headers=headers) as response:
        return response.status, await response.json()


async def moment(page: "Served | Page") -> str:
    """Return the viewer's present moment, as a page has it."""
    async with page.http.ws_connect(f"{page.base}/stream") as stream:
        return str((await stream.receive_json())["moment"])


async def test_motion_needs_the_token_and_stop_does_not(tmp_path):
    async with served(tmp_path) as page:
        for name in NEEDS_TOKEN:
            assert (await post(page, f"/commands/{name}"))[0] == 403
            assert (await post(page, f"/commands/{name}", Authorization="Bearer wrong"))[0] == 403
        assert page.asked == []
        assert await post(page, "/stop") == (200, {"ok": True, "stopped": "test"})
        assert await post(page, "/commands/start", **BEARER) == (200, {"ok": True})
        assert await post(page, "/commands/pause", **BEARER) == (
            409,
            {"ok": False, "reason": "no experiment is running"},
        )
        # Other commands of the daemon are not the page's.
        for name in ("stop", "status"):
            assert (await post(page, f"/commands/{name}", **BEARER))[0] == 404
        assert page.asked == ["stop", "start", "pause"]


async def test_a_confirmation_is_the_digest_of_a_question(tmp_path):
    requests: list[Mapping[str, Any]] = []

    async def hear(request: Mapping[str, Any]) -> dict[str, Any]:
        requests.append({key: value for key, value in request.items() if key not in ("command", "by")})
        if request.get("digest") == "old":
            raise CommandRefusedError("the file has changed", question="Start?", digest="new", plan=["one"])
        return {}

    async with served(tmp_path, start=hear, release=hear, unlock=hear) as page:
        for words in ("confirmed", "confirmed=false", "digest=a&confirmed=0"):
            for name in ("start", "release", "unlock"):
                status, reply = await post(page, f"/commands/{name}?{words}", **BEARER)
                assert (status, reply["ok"]) == (400, False), words
        assert requests == []
        for path in ("start?experiment=a+b.yaml&digest=", "start?digest=d&experiment=x", "release", "release?digest=d"):
            assert (await post(page, f"/commands/{path}", **BEARER))[0] == 200
        assert requests == [
            {"experiment": "a b.yaml", "ask": True},
            {"digest": "d", "experiment": "x", "confirmed": True},
            {"ask": True},
            {"digest": "d", "confirmed": True},
        ]
        assert await post(page, "/commands/start?digest=old", **BEARER) == (
            409,
            {"ok": False, "reason": "the file has changed", "question": "Start?", "plan": ["one"], "digest": "new"},
        )


async def test_a_question_is_logged_as_a_question_and_not_as_a_command(tmp_path, log):
    async def reply(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    async with served(tmp_path, start=reply, release=reply) as page:
        for path, event in (
            ("start", "question answered"),
            ("start?digest=d", "command answered"),
            ("release", "question answered"),
            ("release?digest=d", "command answered"),
        ):
            said = len(log.said)
            assert (await post(page, f"/commands/{path}", **BEARER))[0] == 200
            assert [one for one in log.said[said:] if one.endswith("answered")] == [event], path


async def test_a_click_is_carried_out_soon_or_never_whatever_stood_still(tmp_path, monkeypatch):
    begun_ns, slow_ns = 1_000_000_000, [0]
    now_ns = begun_ns
    monkeypatch.setattr(bridge_module, "Moments", lambda: Moments(lambda: now_ns))

    async def slow_status(_request: Mapping[str, Any]) -> dict[str, Any]:
        nonlocal now_ns
        now_ns += slow_ns[0]
        return {"daemon": {"instance": "a1", "now_ns": 5_000_000_000}}

    async with served(tmp_path, status=slow_status) as page:
        clicked = await moment(page)
        now_ns += 2_000_000_000
        for name in NEEDS_TOKEN:
            assert (await post(page, f"/commands/{name}?moment={clicked}", **BEARER))[0] in (200, 409), name
        assert page.asked == [*NEEDS_TOKEN]
        page.asked.clear()
        # A little later, or after a viewer or a network that stood still meanwhile.
        for later_ns, slow_ns[0] in ((1, 0), (-1, 2), (24_000_000_000, 0)):
            now_ns = begun_ns + 2_000_000_000 + later_ns
            for name in (name for name in NEEDS_TOKEN if name != "pause"):
                status, reply = await post(page, f"/commands/{name}?moment={clicked}", **BEARER)
                now_ns = begun_ns + 2_000_000_000 + later_ns
                assert status == 409
                assert "s ago, and nothing begins later than 2 s after that" in reply["reason"], name
        assert page.asked == []
        # What the page does not say, or another viewer has said.
        for unknown in (
            "",
            "1",
            clicked.replace("-", ""),
            clicked + "0" * 30,
            f"{clicked}11",
            "0-0",
            f"{clicked[:-1]}²",
        ):
            assert (await post(page, f"/commands/start?moment={unknown}", **BEARER))[0] == 400, unknown
        assert (await post(page, f"/commands/pause?moment={clicked}", **BEARER))[0] == 409
        assert await post(page, "/stop") == (200, {"ok": True, "stopped": "test"})
        assert page.asked == ["pause", "stop"], "neither is ever too late"


async def test_the_daemon_is_told_how_much_time_a_click_has_left(tmp_path, monkeypatch):
    now_ns = 0
    monkeypatch.setattr(bridge_module, "Moments", lambda: Moments(lambda: now_ns))
    requests: list[Mapping[str, Any]] = []

    async def status(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"daemon": {"instance": "a1", "now_ns": 5_000_000_000}}

    async def start(request: Mapping[str, Any]) -> dict[str, Any]:
        requests.append(request)
        return {}

    async with served(tmp_path, status=status, start=start) as page:
        clicked = await moment(page)
        now_ns += 1_500_000_000
        await post(page, f"/commands/start?digest=d&moment={clicked}", **BEARER)
        assert [(one["instance"], one["until_ns"]) for one in requests] == [("a1", 5_500_000_000)]


async def test_a_command_without_an_answer_is_told_to_be_in_doubt(tmp_path, monkeypatch):
    monkeypatch.setattr(bridge_module, "UNLOCK_TIMEOUT_S", 0.2)

    async def never(_request: Mapping[str, Any]) -> dict[str, Any]:
        await asyncio.Event().wait()
        return {}

    async with served(tmp_path, start=never) as page:
        status, reply = await post(page, "/commands/start?digest=d", **BEARER)
        assert (status, reply["ok"], reply["unconfirmed"]) == (504, False, True)


async def test_a_list_that_there_is_not_is_no_refusal(tmp_path, log, monkeypatch):
    monkeypatch.setattr(bridge_module, "COMMAND_TIMEOUT_S", 0.05)

    async def experiments(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"experiments": [], "configured": "", "unread": "'hold' is running"}

    async with served(tmp_path, experiments=experiments) as page:
        async with page.http.get(f"{page.base}/experiments.json") as response:
            assert (response.status, await response.json()) == (
                200,
                {"ok": True, "experiments": [], "configured": "", "unread": "'hold' is running"},
            )
        # The daemon has ended.
        page.bridge.address = DaemonAddress("", f"ipc://{tmp_path}/nobody")
        async with page.http.get(f"{page.base}/experiments.json") as response:
            assert (response.status, (await response.json())["ok"]) == (200, False)
        assert "refused" not in log.said


async def test_an_unlock_is_sent_at_once_and_confirmed_by_the_digest_of_its_question(tmp_path):
    requests: list[Mapping[str, Any]] = []

    async def unlock(request: Mapping[str, Any]) -> dict[str, Any]:
        requests.append({key: value for key, value in request.items() if key not in ("command", "by")})
        if not request.get("confirmed"):
            raise CommandRefusedError("a tool in it drops", question="Unlock? A tool in it drops.", digest="d")
        return {}

    async with served(tmp_path, unlock=unlock) as page:
        status, reply = await post(page, "/commands/unlock", **BEARER)
        assert (status, reply["question"], reply["digest"]) == (409, "Unlock? A tool in it drops.", "d")
        assert (await post(page, "/commands/unlock?digest=d", **BEARER))[0] == 200
        assert (await post(page, "/commands/unlock?digest=d&stop=7", **BEARER))[0] == 200
        assert requests == [{}, {"confirmed": True, "digest": "d"}, {"confirmed": True, "digest": "d", "stop": 7}]
        for wrong in ("-1", "one", "1.0", "²", "1" * 20):
            assert (await post(page, f"/commands/unlock?stop={wrong}", **BEARER))[0] == 400


async def test_a_command_is_meant_for_the_daemon_that_answered_just_before(tmp_path):
    requests: list[Mapping[str, Any]] = []

    async def status(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"tasks": {}, "daemon": {"process": 22, "instance": "a1", "rig": "bench", "folder": "/"}}

    async def hear(request: Mapping[str, Any]) -> dict[str, Any]:
        requests.append(request)
        return {}

    async with served(tmp_path, status=status, **dict.fromkeys(NEEDS_TOKEN, hear)) as page:
        for name in NEEDS_TOKEN:
            await post(page, f"/commands/{name}", **BEARER)
        assert [(one["command"], one["instance"]) for one in requests] == [(name, "a1") for name in NEEDS_TOKEN]


async def test_a_page_that_shows_one_daemon_moves_no_other_one_and_says_which_it_stopped(tmp_path):
    async def status(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"tasks": {}, "daemon": {"process": 22, "instance": "a1", "rig": "other", "folder": "/"}}

    async def stop(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"stopped": "hold", "process": 22, "instance": "a1"}

    async with served(tmp_path, status=status, stop=stop) as page:
        shown = {"source": "daemon", "timestamp": 0.0, "t_mono_ns": 0, "seq": 0, "topic": "health"}
        # Each process in a container may have the same number.
        for instance, answers in (("a1", 200), ("b2", 503)):
            page.bridge.latest.add("health", {**shown, "process": 22, "instance": instance}, 0.0)
            for name in NEEDS_TOKEN:
                digest = "?digest=d" if name in ASKED else ""
                code, _ = await post(page, f"/commands/{name}{digest}", **BEARER)
                assert code == (409 if (name, answers) == ("pause", 200) else answers), name
            code, reply = await post(page, "/stop")
            assert (code, reply["ok"]) == (answers, answers == 200)
        assert "process 22: that one was stopped" in reply["reason"]
        assert len(page.asked) == len(NEEDS_TOKEN), "nothing was sent to the other daemon"


async def test_a_refusal_is_told_as_it_is_and_not_as_another_daemons(tmp_path):
    async def refuse(_request: Mapping[str, Any]) -> dict[str, Any]:
        raise CommandRefusedError("too many requests")

    async with served(tmp_path, status=refuse, stop=refuse) as page:
        shown = {"source": "daemon", "timestamp": 0.0, "t_mono_ns": 0, "seq": 0, "topic": "health"}
        page.bridge.latest.add("health", {**shown, "process": 22, "instance": "a1"}, 0.0)
        code, reply = await post(page, "/stop")
        assert (code, reply["reason"]) == (409, "too many requests")
        code, reply = await post(page, "/commands/pause", **BEARER)
        assert (code, reply["reason"]) == (503, "too many requests. `pause` was not sent")


async def test_wrong_tokens_are_soon_refused_unread_and_seldom_logged(tmp_path, log):
    async with served(tmp_path) as page:
        statuses = [(await post(page, "/commands/start", Authorization="Bearer wrong"))[0] for _ in range(200)]
        assert statuses[0] == 403
        assert statuses[-1] == 429
        assert log.said.count("refused") <= 6
        assert await post(page, "/stop") == (200, {"ok": True, "stopped": "test"})
        assert page.asked == ["stop"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example:7760"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Host": "evil.example", "Origin": "http://evil.example"},
    ],
)
async def test_pages_of_other_sites_get_nothing(headers, tmp_path):
    async with served(tmp_path) as page:
        for path in ("/", "/assets/app.js", "/settings.json"):
            async with page.http.get(page.base + path, headers=headers) as response:
                assert response.status in (403, 421)
                assert "shearloop" not in (await response.text()).replace("127.0.0.1", "")
        assert (await post(page, "/stop", **headers))[0] in (403, 421)
        assert (await post(page, "/commands/start", **BEARER, **headers))[0] in (403, 421)
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await page.http.ws_connect(f"{page.base}/stream", headers=headers)
        assert page.asked == []


async def test_every_response_has_the_security_headers(tmp_path):
    async with served(tmp_path) as page:
        for path in ("/", "/assets/view.css", "/settings.json", "/assets/..%2Fserver.py", "/none", "/stop"):
            async with page.http.get(page.base + path) as response:
                assert {key: response.headers[key] for key in HEADERS} == HEADERS, path
                assert response.status == 200 or path not in ("/", "/assets/view.css", "/settings.json")
                assert "Access-Control-Allow-Origin" not in response.headers
        assert "unsafe" not in HEADERS["Content-Security-Policy"]
        async with page.http.get(f"{page.base}/assets/..%2Fserver.py") as response:
            assert response.status == 404


def test_the_page_uses_no_external_resources():
    assets = resources.files("shearloop.daemon.web") / "assets"
    for item in assets.iterdir():
        if item.name.endswith((".html", ".css", ".js")):
            text = item.read_text()
            # The library's own address stands in its head, as a comment.
            assert "//" not in text.replace("// ", "").replace("ws://", "").removeprefix("/*! https://"), item.name
            assert "eval(" not in text, item.name
    assert "MIT" in (assets / "uPlot.LICENSE.txt").read_text()
    record = Path("docs/decisions/0070-live-view.md").read_text()
    for name in ("uPlot.iife.min.js", "uPlot.min.css"):
        assert f"{hashlib.sha256((assets / name).read_bytes()).hexdigest()}  {name}" in record
    html = (assets / "index.html").read_text()
    assert "style=" not in html
    assert "onclick" not in html


async def test_messages_reach_open_pages_and_heatmaps_need_one(tmp_path):
    async with served(tmp_path) as page:
        await until(lambda: page.publisher.has_subscriber("load.torque"))
        assert not page.publisher.has_subscriber(EitHeatmap.topic)
        async with page.http.ws_connect(f"{page.base}/stream") as stream:
            first = await stream.receive_json()
            assert (first["first"], first["messages"], first["quiet_s"]) == (True, [], None)
            await until(lambda: page.publisher.has_subscriber(EitHeatmap.topic))
            page.publisher.publish(sample(LoadTorque, torque_nm=0.1))
            while not (batch := await stream.receive_json())["messages"]:
                continue
            assert not batch["first"]
            assert batch["messages"][0]["content"]["torque_nm"] == 0.1
        async with page.http.ws_connect(f"{page.base}/stream") as again:
            first = await again.receive_json()
            assert first["messages"][0]["content"]["torque_nm"] == 0.1, "a page that comes later gets what is known"
            assert first["history"][0]["content"]["torque_nm"] == 0.1
        await until(lambda: not page.publisher.has_subscriber(EitHeatmap.topic))


async def test_many_stops_share_one_request_and_overtake_hanging_commands(tmp_path, monkeypatch):
    monkeypatch.setattr(bridge_module, "COMMAND_TIMEOUT_S", 30.0)
    released, all_in, stops, wanted = asyncio.Event(), asyncio.Event(), 0, 0

    async def hang(_: Mapping[str, Any]) -> dict[str, Any]:
        await released.wait()
        return {}

    async def stop(_: Mapping[str, Any]) -> dict[str, Any]:
        nonlocal stops
        stops += 1
        await all_in.wait()
        return {}

    async def counted() -> dict[str, Any]:
        nonlocal wanted
        wanted += 1
        if wanted == 50:
            all_in.set()
        return await passed_on()

    async with served(tmp_path, tare=hang, stop=stop) as page:
        hanging = [asyncio.create_task(post(page, "/commands/tare", **BEARER)) for _ in range(6)]
        passed_on = page.bridge.stop
        monkeypatch.setattr(page.bridge, "stop", counted)
        replies = await asyncio.gather(*(post(page, "/stop") for _ in range(50)))
        assert {status for status, _ in replies} == {200}
        assert stops == 1
        released.set()
        assert {status for status, _ in await asyncio.gather(*hanging)} == {200}


async def test_a_stop_without_a_daemon_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(bridge_module, "COMMAND_TIMEOUT_S", 0.05)
    async with served(tmp_path) as page:
        page.bridge.address = DaemonAddress("", f"ipc://{tmp_path}/nobody")
        status, reply = await post(page, "/stop")
        assert (status, reply["ok"]) == (503, False)
        assert "no daemon answered" in reply["reason"]


async def test_a_stop_that_may_still_arrive_is_told_to_be_in_doubt(tmp_path, monkeypatch):
    """The daemon stands still, and takes it from its socket when it goes on."""
    monkeypatch.setattr(bridge_module, "COMMAND_TIMEOUT_S", 0.05)

    def waits(*_: Any) -> None:
        raise TimeoutError

    monkeypatch.setattr(bridge_module, "send_to_stop_socket", waits)
    async with served(tmp_path) as page:
        page.bridge.address = DaemonAddress("", f"ipc://{tmp_path}/nobody")
        status, reply = await post(page, "/stop")
        assert (status, reply["ok"], reply["unconfirmed"]) == (504, False, True)


async def test_a_command_that_never_left_says_so(tmp_path, monkeypatch):
    """The viewer asks for the daemon's state first: nothing moves later."""
    monkeypatch.setattr(bridge_module, "COMMAND_TIMEOUT_S", 0.05)
    async with served(tmp_path) as page:
        page.bridge.address = DaemonAddress("", f"ipc://{tmp_path}/nobody")
        status, reply = await post(page, "/commands/start?digest=d", **BEARER)
        assert (status, reply["ok"], "unconfirmed" in reply) == (503, False, False)
        assert reply["reason"].endswith("`start` was not sent")


async def test_a_stop_that_found_nothing_moving_says_what_moved_before(tmp_path):
    async def stop(_request: Mapping[str, Any]) -> dict[str, Any]:
        return {"stopped": "", "ended_by_itself": "hold", "because": "the daemon itself was not running"}

    async with served(tmp_path, stop=stop) as page:
        _, reply = await post(page, "/stop")
        stopped = "'hold' had just been stopped, because the daemon itself was not running"
        assert reply["moved"] == f"nothing moves any more: {stopped}"


async def test_half_open_requests_do_not_keep_a_stop(tmp_path):
    async with served(tmp_path) as page, AsyncExitStack() as stack:
        port = int(page.base.rpartition(":")[2])
        stream = await stack.enter_async_context(page.http.ws_connect(f"{page.base}/stream"))
        without_body = b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n"
        for text, times in ((b"GET / HT", 4), (without_body, 1)):
            for _ in range(times * server_module.MAX_CONNECTIONS):
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                stack.callback(writer.close)
                writer.write(text)
        async with asyncio.timeout(5.0):
            assert (await post(page, "/stop"))[0] == 200
        # The clients' own, and those of the server.
        assert len(os.listdir("/proc/self/fd")) < 6.5 * server_module.MAX_CONNECTIONS, "the oldest are closed"
        assert (await stream.receive()).type is aiohttp.WSMsgType.TEXT


async def test_pages_and_their_messages_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "MAX_PAGES", 1)
    async with served(tmp_path) as page:
        async with page.http.ws_connect(f"{page.base}/stream") as stream:
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await page.http.ws_connect(f"{page.base}/stream")
            await stream.send_str("x" * 10_000)
            while (message := await stream.receive()).type is aiohttp.WSMsgType.TEXT:
                continue
            assert message.type is aiohttp.WSMsgType.CLOSE
        async with page.http.post(f"{page.base}/stop", data=b"x" * 100_000) as response:
            assert response.status in (200, 413)


async def test_a_used_port_and_an_invalid_address_are_one_sentence(tmp_path):
    def ready(_: int) -> None:
        raise AssertionError

    tip = load_yaml_model(Path("config/fingertips/paper.yaml"), FingertipGeometryConfig).fingertip()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"cannot be served on 127.0.0.1:{port}"):
            await serve(DaemonAddress(PUBLISH_ADDRESS, f"ipc://{tmp_path}/c"), port, TOKEN, tip, ready)
    for wrong, said in (("nonsense", "'nonsense' is not an address"), ("tcp://127.0.0.1:70000", "has no valid port")):
        for publish, commands in ((wrong, PUBLISH_ADDRESS), (PUBLISH_ADDRESS, wrong)):
            with pytest.raises(UserError, match=said):
                await serve(DaemonAddress(publish, commands), 0, TOKEN, tip, ready)


@pytest.mark.long
@pytest.mark.usefixtures("default_signals")
async def test_view_prints_its_address_and_ends_on_a_signal(tmp_path):
    token = tmp_path / "token"
    addresses = ("--connect", f"ipc://{tmp_path}/p", "--commands", f"ipc://{tmp_path}/c")
    async with shearloop("view", "--port", "0", "--json", "--token-file", str(token), *addresses) as view:
        printed = json.loads(await view.stdout.readline())
        assert printed["url_with_token"] == f"{printed['url']}#token={token.read_text().strip()}"
        async with aiohttp.ClientSession() as http, http.ws_connect(f"{printed['url']}stream") as stream:
            assert (await stream.receive_json())["first"]
            view.send_signal(signal.SIGTERM)
            while (message := await stream.receive()).type is aiohttp.WSMsgType.TEXT:
                continue
            assert message.type is aiohttp.WSMsgType.CLOSE
        assert await view.wait() == 0
        assert token.read_text().strip() not in (await view.stdout.read()).decode()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:7760", "localhost:9000", "LOCALHOST:1", "[::1]:7760"])
def test_loopback_hosts_are_allowed_on_any_port(host):
    assert host_allowed(host)


@pytest.mark.parametrize(
    "host",
    [
        *(None, "", "evil.example", "127.0.0.1.evil.example:7760", "evil.example@127.0.0.1", "localhost.evil.example"),
        *("192.168.1.5:7760", "0.0.0.0:7760", "127.0.0.1:99999", "[::1", "127.0.0.1/@evil.example", "127.0.0.1:x"),
    ],
)
def test_foreign_hosts_are_refused(host):
    assert not host_allowed(host)


@given(st.text(max_size=40))
def test_any_host_header_gives_a_boolean(host):
    assert isinstance(host_allowed(host), bool)


def test_foreign_origins_are_refused():
    assert origin_allowed(None, "127.0.0.1:7760")
    assert origin_allowed("http://127.0.0.1:7760", "127.0.0.1:7760")
    for origin in (
        "null",
        "",
        "http://127.0.0.1:7761",
        "https://127.0.0.1:7760",
        "http://localhost:7760",
        "http://a.b",
    ):
        assert not origin_allowed(origin, "127.0.0.1:7760"), origin


def test_only_the_complete_token_is_valid():
    assert token_valid("Bearer abc", "abc")
    for header in (None, "", "abc", "Bearer", "Bearer ", "Bearer ab", "Bearer abcd", "Basic abc", "Bearer äbc"):
        assert not token_valid(header, "abc"), header


def test_the_token_is_made_once_and_readable_by_its_owner_only(tmp_path):
    path = tmp_path / "state" / "shearloop" / "view-token"
    token = load_token(path)
    assert len(token) >= 43
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_token(path) == token
    assert load_token(path, new=True) != token
    # Any other file, which a person named by mistake.
    path.write_text("lines of a table\n" * 20)
    with pytest.raises(UserError, match="holds more than a token: it was not changed"):
        load_token(path, new=True)
    assert path.read_text() == "lines of a table\n" * 20
    path.unlink()


def test_readable_or_invalid_token_files_are_refused(tmp_path):
    path = tmp_path / "token"
    load_token(path)
    path.chmod(0o640)
    with pytest.raises(UserError, match="that no other user may read"):
        load_token(path)
    for content in ("", "short", "x" * 500, "a token with spaces in it, long enough as it is"):
        path.write_text(content)
        path.chmod(0o600)
        with pytest.raises(UserError, match="holds no token"):
            load_token(path)


def test_links_and_pipes_are_refused_as_token_files(tmp_path):
    load_token(tmp_path / "other")
    (tmp_path / "link").symlink_to(tmp_path / "other")
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, why in (("link", "cannot be kept"), ("pipe", "must be a file")):
        with pytest.raises(UserError, match=why):
            load_token(tmp_path / name)


def test_the_default_token_path_follows_xdg(monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert default_token_path() == Path("/state/shearloop/view-token")
    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert default_token_path() == Path("/home/somebody/.local/state/shearloop/view-token")


def test_guessing_the_token_is_slowed_to_one_try_per_second():
    tokens, guesses = TokenCheck("abc"), 1000
    statuses = [tokens.refusal("start", f"Bearer {number}", number * 1_000_000)[0] for number in range(guesses)]
    assert Counter(statuses) == {403: WRONG_BURST, 429: guesses - WRONG_BURST}, "1000 guesses in a second"
    assert tokens.refusal("start", "Bearer abc", 999_000_000)[0] == 429, "the right one waits too"
    assert tokens.refusal("start", "Bearer abc", 3 * 10**9) is None
    assert tokens.refusal("start", "Bearer abc", 3 * 10**9) is None, "the right one is never counted"


@dataclass
class Page:
    """What `shearloop view` serves, asked as a browser asks."""

    http: aiohttp.ClientSession
    base: str
    token: str

    async def hears(self) -> bool:
        """Return whether a message of the daemon comes to the page within two seconds."""
        async with self.http.ws_connect(f"{self.base}/stream") as stream:
            async with asyncio.timeout(2.0):
                async for batch in stream:
                    if batch.json()["messages"]:
                        return True
        return False


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
        yield Page(http, printed["url"].rstrip("/"), printed["url_with_token"].partition("#token=")[2])


@pytest.mark.long
async def test_over_the_network_motion_needs_key_and_token_and_stop_neither(config, places, tmp_path):
    curve = {"server_key": str(tmp_path / "keys/server.key_secret"), "clients": str(tmp_path / "keys/clients")}
    async with running_daemon(config(**places, curve=curve)) as daemon:
        async with page_of(places, tmp_path, "ada") as page:
            assert await page.hears()
            for command in ("tare", "start", "pause", "resume", "unlock", "release"):
                assert (await post(page, f"/commands/{command}"))[0] == 403, command
            bearer = {"Authorization": f"Bearer {page.token}"}
            status, reply = await post(page, "/commands/tare", **bearer)
            assert (status, reply["reason"]) == (409, "not connected: right; connect it, then send the tare again")
            # It came to the daemon, which has nothing to start.
            status, reply = await post(page, "/commands/start", **bearer)
            assert status == 409
            assert reply["reason"].startswith("no experiment is given")
            assert await post(page, "/stop") == (200, {"ok": True, "stopped": ""})
        for who in ("eve", None):
            async with page_of(places, tmp_path, who) as page:
                status, reply = await post(page, "/commands/tare", Authorization=f"Bearer {page.token}")
                assert (status, reply["ok"]) == (503, False), who
                assert await post(page, "/stop") == (200, {"ok": True, "stopped": ""}), who
        assert daemon.health.tasks()["commands"]["errors"]["key is not allowed"] >= 1
        assert not daemon.ending.is_set(), "a stop from a page ends what moves, and not the daemon"
