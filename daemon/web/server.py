"""The page's web server on loopback: what the daemon says goes to pages, and their commands to the daemon.

A browser on this computer also runs pages of other sites. Such a page may reach us through a host name of its own (DNS
rebinding, visible in the Host header) or send cross-site requests (visible in the Origin header). Every program on this
computer may read and stop; commands that move something need the token.
"""

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import structlog
import zmq
import zmq.asyncio
from aiohttp import WSCloseCode, web

from shearloop.bank.fingertip import Fingertip
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.bound_requests import LateRequestError
from shearloop.daemon.messaging.client import UnansweredError
from shearloop.daemon.messaging.deadlines import NEVER_LATE
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_client import nothing_moved
from shearloop.daemon.process import ending_signals
from shearloop.daemon.web.bridge import Bridge, DaemonAddress
from shearloop.daemon.web.message_store import MessageStore
from shearloop.daemon.web.moments import UnknownMomentError
from shearloop.daemon.web.tokens import TokenCheck
from shearloop.errors import UserError
from shearloop.timeouts import timeout
from shearloop.words import is_whole_number

HOST = "127.0.0.1"
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
# Requests in progress get this long at the end.
SHUTDOWN_S = 1.0
# A daemon that ends together with the viewer is still shown as ended.
LAST_MESSAGES_S = 0.1
# Commands that move something, or change what moves it.
NEEDS_TOKEN = ("tare", "start", "pause", "resume", "unlock", "release")
# Those that the page asks about first, with the daemon's question. The confirmation gives back the question's digest.
ASKED = ("start", "release")
# What a request may say of each command; a word that is not known must not pass for a confirmation.
WORDS = {"start": ("experiment", "digest"), "unlock": ("digest", "stop"), "release": ("digest",)}
# Those that are carried out at once, unless the daemon's refusal has a question; the digest answers it.
ASKED_IF_NEEDED = ("unlock",)
# The words of every command: the latest moment that the page had when it was clicked on, and the page's own name of the
# request.
MOMENT, REQUEST_ID = "moment", "request_id"
# The parts of a question, which a refusal has as well where another one is to be answered.
QUESTION = ("question", "plan", "digest")
# The parts of a daemon's reply that a page shows.
_SHOWN_KEYS = ("ok", "reason", "stopped", "taring", "not_connected", "experiment", *QUESTION)
_LIST_KEYS = ("ok", "reason", "experiments", "configured", "unread")
# Maximum redraw rate of a page.
BATCHES_PER_S = 30.0
# A page gets a batch at least this often.
HEARTBEAT_S = 0.25
# A page that accepts nothing for this long is disconnected.
SEND_TIMEOUT_S = 5.0
MAX_PAGES = 16
# At this number of connections, the oldest that waits for a request is closed for a new one.
MAX_CONNECTIONS, ACCEPTED_AT_ONCE = 128, 16
MAX_BODY_BYTES = 4096
# Of the number of a stop.
_MAX_DIGITS = 9
# Health comes once a second. After a longer silence the page shows a dead daemon, within 2 s in all.
DEAD_AFTER_S = 1.6
# Allows for the delay through this process and the browser.
MIN_STALE_S = 0.5

_ASSETS = Path(__file__).with_name("assets")
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


async def serve(
    address: DaemonAddress, port: int, token: str, fingertip: Fingertip, on_ready: Callable[[int], None]
) -> None:
    """Serve the page, call `on_ready` with its port, and return after SIGINT, SIGTERM or SIGHUP.

    Raises UserError for a port that is in use and for a malformed address.
    """
    loop = asyncio.get_running_loop()
    async with contextlib.AsyncExitStack() as opened:
        context = opened.enter_context(zmq.asyncio.Context())
        bridge = Bridge(context, address, MessageStore(fingertip.height_cm))
        opened.push_async_callback(bridge.close)
        app = make_app(bridge, token, asdict(fingertip.outline()), address.publish)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=SHUTDOWN_S, lingering_time=0.0)
        opened.push_async_callback(runner.cleanup)
        await runner.setup()
        try:
            listener = await listen(runner, port)
        except OSError as error:
            raise UserError(
                f"the page cannot be served on {HOST}:{port} ({error.strerror}); give another --port"
            ) from error
        opened.callback(listener.close)
        receiving = asyncio.create_task(bridge.run(), name="messages")
        opened.callback(receiving.cancel)
        for number in ending_signals():
            loop.add_signal_handler(number, partial(loop.call_later, LAST_MESSAGES_S, receiving.cancel))
            opened.callback(loop.remove_signal_handler, number)
        on_ready(listener.sockets[0].getsockname()[1])
        # Without its subscription the page would show stale data: an error there ends the server.
        with contextlib.suppress(asyncio.CancelledError):
            await receiving


async def listen(runner: web.AppRunner, port: int) -> asyncio.Server:
    """Listen on a port with a bounded number of connections; raises OSError."""
    server = runner.server
    if server is None:
        raise RuntimeError("the runner is not set up")

    def accept() -> web.RequestHandler:
        idle = [one for one in server.connections if one not in runner.app[_BUSY]]
        for one in idle[: max(0, len(server.connections) - MAX_CONNECTIONS + 1)]:
            one.force_close()
        return server()

    return await asyncio.get_running_loop().create_server(accept, HOST, port, backlog=ACCEPTED_AT_ONCE)


def make_app(bridge: Bridge, token: str, fingertip: dict[str, Any], publish: str) -> web.Application:
    """Return the web application; the page draws the fingertip's outline and shows the address `publish`."""
    page = _Page(bridge, token, fingertip, publish)
    app = web.Application(middlewares=[page.check_access], client_max_size=MAX_BODY_BYTES)
    app[_BUSY] = page.busy
    app.router.add_get("/", page.index)
    app.router.add_static("/assets", _ASSETS, follow_symlinks=True)
    app.router.add_get("/settings.json", page.settings)
    app.router.add_get("/experiments.json", page.experiments)
    app.router.add_get("/stream", page.stream)
    app.router.add_post("/stop", page.stop)
    app.router.add_post("/commands/{name}", page.command)
    app.on_shutdown.append(page.disconnect)
    return app


# Connections with a request in progress.
_BUSY = web.AppKey("_BUSY", set[web.RequestHandler])


class _Page:
    def __init__(self, bridge: Bridge, token: str, fingertip: dict[str, Any], publish: str) -> None:
        self._bridge = bridge
        self._tokens = TokenCheck(token)
        self._refusals = Refusals()
        regular = [topic for topic, kind in messages.TOPICS.items() if kind.rate_hz is not None]
        self._settings = {
            "fingertip": fingertip,
            "publish": publish,
            "dead_after_s": DEAD_AFTER_S,
            "stale_after_periods": messages.STALE_AFTER_PERIODS,
            "operator_stop": FaultCode.OPERATOR_STOP.text,
            "units": {topic: dict(messages.units(topic)) for topic in messages.TOPICS},
            "stale_after_s": {topic: max(messages.stale_after_s(topic), MIN_STALE_S) for topic in regular},
        }
        self._open: set[web.WebSocketResponse] = set()
        self.busy: set[web.RequestHandler] = set()

    @web.middleware
    async def check_access(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Refuse requests of other sites, and add the security headers to every response."""
        host = request.headers.get("Host")
        if not host_allowed(host):
            return self._refuse(421, f"{host!r} is not this computer's loopback; open http://127.0.0.1:PORT/")
        if not origin_allowed(request.headers.get("Origin"), host):
            return self._refuse(403, "requests from other sites are not answered")
        self.busy.add(request.protocol)
        try:
            response = await handler(request)
        except web.HTTPException as error:
            response = self._refuse(error.status, error.reason)
        finally:
            self.busy.discard(request.protocol)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _refuse(self, status: int, reason: str) -> web.Response:
        # Any program may send any number of wrong requests.
        self._refusals.add(f"status {status}", reason, frequent=status < 500)
        return web.json_response({"ok": False, "reason": reason}, status=status, headers=HEADERS)

    async def index(self, _request: web.Request) -> web.FileResponse:
        return web.FileResponse(_ASSETS / "index.html")

    async def settings(self, _request: web.Request) -> web.Response:
        return web.json_response(self._settings)

    async def experiments(self, _request: web.Request) -> web.Response:
        """Return the experiments that `start` may name, and the configured one, or the reason without a list.

        It is no refusal: pages ask by themselves, also while the daemon ends.
        """
        try:
            reply = await self._bridge.experiments()
        except UserError as error:
            reply = {"ok": False, "reason": str(error)}
        return web.json_response({key: reply[key] for key in _LIST_KEYS if key in reply})

    async def stop(self, _request: web.Request) -> web.Response:
        """Stop all motion; needs no token."""
        structlog.get_logger().info("stop requested")
        return await self._reply("stop", self._bridge.stop())

    async def command(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in NEEDS_TOKEN:
            return self._refuse(404, f"there is no command {name!r} here; there are {', '.join(NEEDS_TOKEN)}")
        refusal = self._tokens.refusal(name, request.headers.get("Authorization"), time.monotonic_ns())
        if refusal is not None:
            return self._refuse(*refusal)
        clicked_ns = None
        if name not in NEVER_LATE:
            try:
                clicked_ns = self._bridge.moments.given_ns(request.query.get(MOMENT, ""))
            except UnknownMomentError:
                reason = "the page does not say when it was clicked on; look at the rig, and click again"
                return self._refuse(400, reason)
        words = (MOMENT, REQUEST_ID, *WORDS.get(name, ()))
        if unknown := [word for word in request.query if word not in words]:
            return self._refuse(400, f"`{name}` has no word {unknown[0][:40]!r} here; there are {', '.join(words)}")
        own_words = {word: text for word, text in request.query.items() if text and word != MOMENT}
        arguments: dict[str, bool | int | str] = {**own_words}
        if "stop" in arguments:
            number = request.query["stop"]
            if not is_whole_number(number, _MAX_DIGITS):
                return self._refuse(400, f"`stop` is {number[:40]!r}, and has to be a whole number")
            arguments["stop"] = int(number)
        # The first press asks the question, the second press confirms it.
        if name in ASKED and "digest" not in arguments:
            arguments["ask"] = True
        elif name in ASKED or (name in ASKED_IF_NEEDED and "digest" in arguments):
            arguments["confirmed"] = True
        asks = "ask" in arguments
        return await self._reply(name, self._bridge.command(name, clicked_ns, **arguments), asks=asks)

    async def _reply(self, name: str, requested: Awaitable[dict[str, Any]], *, asks: bool = False) -> web.Response:
        try:
            reply = await requested
        except LateRequestError as error:
            return self._refuse(409, str(error))
        except UnansweredError as error:
            self._refusals.add("status 504", str(error))
            return web.json_response({"ok": False, "reason": str(error), "unconfirmed": True}, status=504)
        except UserError as error:
            return self._refuse(503, str(error))
        answered = "question answered" if asks else "command answered"
        structlog.get_logger().info(answered, command=name, ok=reply.get("ok"), reason=reply.get("reason"))
        content = {key: reply[key] for key in _SHOWN_KEYS if key in reply}
        if "ended_by_itself" in reply or "stopped_before" in reply:
            content["moved"] = nothing_moved(reply)
        return web.json_response(content, status=200 if reply.get("ok") else 409)

    async def stream(self, request: web.Request) -> web.StreamResponse:
        if len(self._open) >= MAX_PAGES:
            return self._refuse(503, f"{MAX_PAGES} pages are open already; close one")
        socket = web.WebSocketResponse(heartbeat=SEND_TIMEOUT_S, max_msg_size=MAX_BODY_BYTES, compress=False)
        await socket.prepare(request)
        self._open.add(socket)
        sending = asyncio.create_task(self._send(socket))
        try:
            # A page sends nothing; reading notices when it disconnects.
            async for _ in socket:
                continue
        finally:
            self._open.discard(socket)
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        return socket

    async def _send(self, socket: web.WebSocketResponse) -> None:
        latest, sent, first, sent_s = self._bridge.latest, 0, True, 0.0
        with self._bridge.watching():
            while not socket.closed:
                now_s = time.monotonic()
                if first or latest.number > sent or now_s - sent_s >= HEARTBEAT_S:
                    history = latest.history(now_s) if first else []
                    moment = self._bridge.moments.present()
                    text = latest.batch(sent, now_s, first=first, now=time.time(), moment=moment, history=history)
                    sent, first, sent_s = latest.number, False, now_s
                    try:
                        async with timeout(SEND_TIMEOUT_S):
                            await socket.send_str(text)
                    except (TimeoutError, ConnectionError):
                        structlog.get_logger().warning("a page accepts no data and is disconnected")
                        await socket.close(code=WSCloseCode.TRY_AGAIN_LATER)
                        return
                await asyncio.sleep(1.0 / BATCHES_PER_S)

    async def disconnect(self, _app: web.Application) -> None:
        """Close the connection of every page."""
        for socket in tuple(self._open):
            await socket.close(code=WSCloseCode.GOING_AWAY)


def host_allowed(host: str | None) -> bool:
    """Return whether a Host header names loopback, on any port (a tunnel has its own)."""
    if not host or any(letter in host for letter in "@/?#\\"):
        return False
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname, parts.port
    except ValueError:
        return False
    return name in LOOPBACK_NAMES


def origin_allowed(origin: str | None, host: str | None) -> bool:
    """Return whether a request comes from the page itself, or from a program that sends no Origin header."""
    return origin is None or (host is not None and origin.lower() == f"http://{host.lower()}")
