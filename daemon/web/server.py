"""The page's web server: files, a stream of messages for each page, and commands, on loopback alone."""

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from importlib import resources
from typing import Any

import structlog
from aiohttp import WSCloseCode, web

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.topics import STALE_AFTER_PERIODS, TOPICS, stale_after_s
from shearloop.daemon.web.access import host_allowed, origin_allowed, token_given
from shearloop.daemon.web.bridge import Bridge, BusyError

# What may move something, or change what moves it.
NEEDS_TOKEN = ("tare", "start", "pause", "resume", "unlock")
# A page draws no more often than this; between two batches only the latest of each topic counts.
BATCHES_PER_S = 30.0
# So often a page hears from us when nothing else is new.
HEARTBEAT_S = 0.25
# A page that takes nothing for so long is gone.
SEND_TIMEOUT_S = 5.0
MOST_PAGES = 16
LARGEST_BODY_BYTES = 4096
# Health comes once a second: longer silence than this is a daemon that is dead, and the page says so within 2 s.
DEAD_AFTER_S = 1.6
# What a message may take through us and the browser: nothing on the page is called old before.
LEAST_STALE_S = 0.5

_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
Answer = Callable[[web.Request], Awaitable[web.StreamResponse]]


def make_app(bridge: Bridge, token: str, fingertip: dict[str, Any], publish: str) -> web.Application:
    """Return the application; fingertip is the outline that the page draws, publish the address that it tells."""
    page = _Page(bridge, token, fingertip, publish)
    app = web.Application(middlewares=[_guarded], client_max_size=LARGEST_BODY_BYTES)
    app.router.add_get("/", page.file)
    app.router.add_get("/assets/{name}", page.file)
    app.router.add_get("/settings.json", page.settings)
    app.router.add_get("/stream", page.stream)
    app.router.add_post("/stop", page.stop)
    app.router.add_post("/commands/{name}", page.command)
    app.on_shutdown.append(page.hang_up)
    return app


@web.middleware
async def _guarded(request: web.Request, handler: Answer) -> web.StreamResponse:
    """Answer only the page itself and programs of this computer; say everywhere what a browser may do with it."""
    host = request.headers.get("Host")
    if not host_allowed(host):
        return _refused(421, f"{host!r} is not this computer's loopback; open http://127.0.0.1:PORT/")
    if not origin_allowed(request.headers.get("Origin"), host):
        return _refused(403, "requests from other sites are not answered")
    try:
        response = await handler(request)
    except web.HTTPException as error:
        response = _refused(error.status, error.reason)
    if not response.prepared:
        response.headers.update(HEADERS)
    return response


def _refused(status: int, why: str) -> web.Response:
    structlog.get_logger().warning("request refused", status=status, why=why)
    return web.json_response({"ok": False, "why": why}, status=status, headers=HEADERS)


class _Page:
    def __init__(self, bridge: Bridge, token: str, fingertip: dict[str, Any], publish: str) -> None:
        self._bridge = bridge
        self._token = token
        self._settings = {
            "fingertip": fingertip,
            "publish": publish,
            "dead_after_s": DEAD_AFTER_S,
            "stale_after_periods": STALE_AFTER_PERIODS,
            "stale_after_s": {
                topic: max(stale_after_s(topic), LEAST_STALE_S)
                for topic, kind in TOPICS.items()
                if kind.rate_hz is not None
            },
        }
        self._open: set[web.WebSocketResponse] = set()
        folder = resources.files("shearloop.daemon.web") / "assets"
        # Only what is there at the start is ever sent: no name from outside becomes a path.
        self._files = {
            item.name: (item.read_bytes(), _TYPES[item.name.rsplit(".", 1)[-1]])
            for item in folder.iterdir()
            if item.name.rsplit(".", 1)[-1] in _TYPES
        }

    async def file(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        if name not in self._files:
            return _refused(404, "there is no such file")
        body, kind = self._files[name]
        return web.Response(body=body, content_type=kind, charset="utf-8")

    async def settings(self, _request: web.Request) -> web.Response:
        return web.json_response(self._settings)

    async def stop(self, _request: web.Request) -> web.Response:
        """Stop what moves: for everyone on this computer, without a token."""
        structlog.get_logger().info("stop wanted")
        return await self._answered("stop", self._bridge.stop())

    async def command(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in NEEDS_TOKEN:
            return _refused(404, f"there is no command {name!r} here; there are {', '.join(NEEDS_TOKEN)}")
        if not token_given(request.headers.get("Authorization"), self._token):
            return _refused(403, f"{name} needs the token: open the address that `shearloop view` printed")
        return await self._answered(name, self._bridge.command(name))

    async def _answered(self, name: str, asked: Awaitable[dict[str, Any]]) -> web.Response:
        try:
            reply = await asked
        except BusyError:
            return _refused(429, "too many commands at once; wait for their answers")
        except UserError as error:
            return _refused(503, str(error))
        structlog.get_logger().info("command answered", command=name, ok=reply.get("ok"), why=reply.get("why"))
        # A status has nothing that JSON lacks, and of other replies only what was asked for is told.
        told = {key: reply.get(key) for key in ("ok", "why", "stopped", "tared", "experiment") if key in reply}
        return web.Response(
            text=json.dumps(told, default=str), status=200 if reply.get("ok") else 409, content_type="application/json"
        )

    async def stream(self, request: web.Request) -> web.StreamResponse:
        if len(self._open) >= MOST_PAGES:
            return _refused(503, f"{MOST_PAGES} pages are open already; close one")
        socket = web.WebSocketResponse(heartbeat=SEND_TIMEOUT_S, max_msg_size=LARGEST_BODY_BYTES, compress=False)
        await socket.prepare(request)
        self._open.add(socket)
        sending = asyncio.create_task(self._send(socket))
        try:
            # A page says nothing; reading tells when it has gone.
            async for _ in socket:
                continue
        finally:
            self._open.discard(socket)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        return socket

    async def _send(self, socket: web.WebSocketResponse) -> None:
        latest, sent, first, told_s = self._bridge.latest, 0, True, 0.0
        with self._bridge.watching():
            while not socket.closed:
                now_s = time.monotonic()
                if first or latest.number > sent or now_s - told_s >= HEARTBEAT_S:
                    history = latest.history(now_s) if first else []
                    text = latest.batch(sent, now_s, first=first, now=time.time(), history=history)
                    sent, first, told_s = latest.number, False, now_s
                    try:
                        async with asyncio.timeout(SEND_TIMEOUT_S):
                            await socket.send_str(text)
                    except (TimeoutError, ConnectionError):
                        structlog.get_logger().warning("a page takes nothing any more and is left")
                        await socket.close(code=WSCloseCode.TRY_AGAIN_LATER)
                        return
                await asyncio.sleep(1.0 / BATCHES_PER_S)

    async def hang_up(self, _app: web.Application) -> None:
        """Tell every page that we go."""
        for socket in tuple(self._open):
            await socket.close(code=WSCloseCode.GOING_AWAY)
