"""The page's web server on loopback, and its bridge to the daemon's sockets: messages in, commands out.

A browser on this computer also runs pages of other sites. Such a page may reach us through a host name of its own (DNS
rebinding, visible in the Host header) or send cross-site requests (visible in the Origin header). Every program on this
computer may read and stop; commands that move something need the token.
"""

import asyncio
import contextlib
import hmac
import os
import secrets
import stat
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
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
from shearloop.daemon.messaging.addresses import COMMAND_TIMEOUT_S, SLOW, UNLOCK_TIMEOUT_S, needs_keys
from shearloop.daemon.messaging.callers import caller
from shearloop.daemon.messaging.client import UnansweredError, ask, connect
from shearloop.daemon.messaging.deadlines import CLICK_WITHIN_S, NEVER_LATE, LateRequestError, meant_for
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.refusals import Refusals, TokenBucket
from shearloop.daemon.messaging.stop_client import StopSocketTakenError, send_to_stop_socket
from shearloop.daemon.process import ending_signals
from shearloop.daemon.web.message_store import MessageStore
from shearloop.daemon.web.moments import Moments, UnknownMomentError
from shearloop.errors import UserError
from shearloop.timeouts import timeout
from shearloop.words import is_whole_number

HOST = "127.0.0.1"
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
TOKEN_BYTES = 32
TOKEN_LENGTHS = range(32, 201)
# Requests in progress get this long at the end.
SHUTDOWN_S = 1.0
# A daemon that ends together with the viewer is still shown as ended.
LAST_MESSAGES_S = 0.1
# Names the page as the sender of its commands, together with the viewer's user.
PROGRAM = "the live page"
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
# Wrong tokens that are compared at once, and then per second.
WRONG_BURST, WRONG_PER_S = 20.0, 1.0
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
# The largest message is a heatmap of 200 × 200 float32.
MAX_MESSAGE_BYTES = 1 << 20
HIGH_WATER_MARK = 1000
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


@dataclass(frozen=True, slots=True)
class DaemonAddress:
    """A daemon's sockets, with the keys if it is on the network."""

    publish: str
    commands: str
    keys: ClientKeys | None = None


class Bridge:
    """Receives the messages of one daemon and sends commands to it."""

    def __init__(self, context: zmq.asyncio.Context, address: DaemonAddress, latest: MessageStore) -> None:
        """Subscribe to the daemon, whether or not it runs; raise UserError for a malformed address."""
        self.latest = latest
        self.moments = Moments()
        self._context = context
        self.address = address
        self._stopping: asyncio.Future[dict[str, Any]] | None = None
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        try:
            connect(self._socket, address.publish, address.keys)
            with context.socket(zmq.DEALER) as commands:
                connect(commands, address.commands, address.keys)
        except UserError:
            self._socket.close()
            raise
        for topic in messages.TOPICS:
            # The daemon computes heatmaps only for subscribers: subscribe while a page is open.
            if topic not in (messages.EitFrame.topic, messages.EitHeatmap.topic):
                self._socket.subscribe(topic)

    async def run(self) -> None:
        """Receive messages until cancelled."""
        while True:
            parts = await self._socket.recv_multipart()
            try:
                topic, payload = parts
                content = messages.decode(payload)
            except ValueError:
                self.latest.refused["malformed message"] += 1
                continue
            self.latest.add(topic.decode(errors="replace"), content, time.monotonic())

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Subscribe to heatmaps while a page is open."""
        # ZeroMQ counts the subscriptions of several pages.
        self._socket.subscribe(messages.EitHeatmap.topic)
        try:
            yield
        finally:
            self._socket.unsubscribe(messages.EitHeatmap.topic)

    async def experiments(self) -> dict[str, Any]:
        """Return the daemon's list of experiments; raise UserError without a reply."""
        return await self._request({"command": "experiments"}, COMMAND_TIMEOUT_S)

    async def command(self, name: str, clicked_ns: int | None, **arguments: bool | int | str) -> dict[str, Any]:
        """Return the daemon's reply to a command; `clicked_ns` is the time of its moment, None if it is never late.

        Raises LateRequestError if it is too old to be sent, UnansweredError if it was sent and no reply came, and
        UserError if no daemon answers.
        """
        content = {"command": name, "by": caller(PROGRAM), **arguments}
        status = await self._request({"command": "status"}, COMMAND_TIMEOUT_S)
        self._check_shown(status.get("daemon", {}).get("process"), "nothing was sent to it")
        # The daemon, or this process, may have stood still since the click.
        age_s = self.moments.since_s(clicked_ns) if clicked_ns is not None else 0.0
        content |= meant_for(status, age_s, CLICK_WITHIN_S)
        return await self._request(content, UNLOCK_TIMEOUT_S if name in SLOW else COMMAND_TIMEOUT_S)

    def _check_shown(self, process: int | None, done: str) -> None:
        """Raise UserError if the page shows another daemon than this process; `done` says what that one did.

        After a restart of the daemon they differ for a second.
        """
        shown = self.latest.process
        if shown is not None and process not in (None, shown):
            raise UserError(
                f"the page shows the daemon at {self.address.publish}, process {shown}, and the one at "
                f"{self.address.commands} is process {process}: {done}. After a restart of the daemon try again; else "
                "start the page with the addresses of one daemon"
            )

    async def stop(self) -> dict[str, Any]:
        """Return the daemon's reply to a stop of all motion; simultaneous calls share one request.

        Raises UserError without a reply.
        """
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.ensure_future(self._request_stop())
        # Shielded: a page that disappears has still requested the stop.
        return await asyncio.shield(self._stopping)

    async def _request_stop(self) -> dict[str, Any]:
        content, address = {"command": "stop", "by": caller(PROGRAM), "spare_daemon": True}, self.address.commands
        reply = None
        if not needs_keys(address):
            # A local daemon accepts it even without valid keys.
            with contextlib.suppress(TimeoutError, StopSocketTakenError):
                reply = await asyncio.to_thread(send_to_stop_socket, address, content, COMMAND_TIMEOUT_S)
        reply = reply or await self._request(content, COMMAND_TIMEOUT_S)
        self._check_shown(reply.get("process"), "that one was stopped")
        return reply

    async def _request(self, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        return await ask(self._context, self.address.commands, content, timeout_s, self.address.keys)

    async def close(self) -> None:
        """Close the socket; wait for a stop that is on its way."""
        self._socket.close()
        if self._stopping is not None:
            await asyncio.gather(self._stopping, return_exceptions=True)


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


class TokenCheck:
    """Checks tokens; after WRONG_BURST wrong ones it refuses all, right or wrong, but for WRONG_PER_S."""

    def __init__(self, token: str) -> None:
        self._token = token
        self._wrong = TokenBucket(WRONG_BURST, WRONG_PER_S)

    def refusal(self, name: str, authorization: str | None, t_ns: int) -> tuple[int, str] | None:
        """Return status and reason if a command with this Authorization header is refused at monotonic time t_ns."""
        if not self._wrong.has_token(t_ns):
            return 429, "too many wrong tokens came; wait a second and try again, or use `shearloop command`"
        if token_valid(authorization, self._token):
            return None
        self._wrong.allow(t_ns)
        return 403, f"{name} needs the token: open the address that `shearloop view` printed"


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
        elif name == "release" or (name in ASKED_IF_NEEDED and "digest" in arguments):
            arguments["confirmed"] = True
        return await self._reply(name, self._bridge.command(name, clicked_ns, **arguments))

    async def _reply(self, name: str, requested: Awaitable[dict[str, Any]]) -> web.Response:
        try:
            reply = await requested
        except LateRequestError as error:
            return self._refuse(409, str(error))
        except UnansweredError as error:
            self._refusals.add("status 504", str(error))
            return web.json_response({"ok": False, "reason": str(error), "unconfirmed": True}, status=504)
        except UserError as error:
            return self._refuse(503, str(error))
        structlog.get_logger().info("command answered", command=name, ok=reply.get("ok"), reason=reply.get("reason"))
        content = {key: reply[key] for key in _SHOWN_KEYS if key in reply}
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


def token_valid(authorization: str | None, token: str) -> bool:
    """Return whether an Authorization header carries the token; compares in constant time."""
    scheme, _, given = (authorization or "").partition(" ")
    return scheme == "Bearer" and hmac.compare_digest(given.encode(errors="replace"), token.encode())


def default_token_path() -> Path:
    """Return the token's default path (XDG Base Directory Specification)."""
    state = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state"
    return folder / "shearloop" / "view-token"


def load_token(path: Path, *, new: bool = False) -> str:
    """Return the token in a file; create a missing one, and replace it with `new`.

    Raises UserError for a file that others may read, that holds no token, or that cannot be written.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if new:
            path.unlink(missing_ok=True)
        try:
            return _read_token(path)
        except FileNotFoundError:
            token = secrets.token_urlsafe(TOKEN_BYTES)
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "w") as file:
                file.write(f"{token}\n")
            return token
    except OSError as error:
        raise UserError(
            f"the token cannot be kept in {path} ({error.strerror}); name another file with --token-file"
        ) from error


def _read_token(path: Path) -> str:
    # Without O_NONBLOCK, opening a pipe would block.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(handle) as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise UserError(
                f"{path} must be a file of your own that no other user may read; "
                "make a new token with --new-token, or name another file with --token-file"
            )
        text = file.read(TOKEN_LENGTHS.stop).strip()
    if not (len(text) in TOKEN_LENGTHS and text.isascii() and text.isprintable() and " " not in text):
        raise UserError(f"{path} holds no token; make a new one with --new-token, or name another file")
    return text
