"""Clients of a daemon: receive its messages, send it a command."""

import asyncio
import enum
import logging
import math
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from difflib import get_close_matches
from typing import Any, TypeAlias

import zmq
import zmq.asyncio
from zmq.utils.monitor import parse_monitor_message

from shearloop.daemon.messaging.addresses import LARGEST_PORT, PUBLISH_ADDRESS, READ_ONLY, has_valid_port, needs_keys
from shearloop.daemon.messaging.bound_requests import TYPED_WITHIN_S
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.messages import ENVELOPE, TOPICS, decode, encode
from shearloop.daemon.messaging.stop_client import foreign_reply, is_open_to_network, other_listeners
from shearloop.errors import UserError
from shearloop.timeouts import timeout

TopicContent: TypeAlias = tuple[str, dict[str, Any]]
# A running daemon sends `health` every second.
QUIET_S = 3.0
# A publisher that runs accepts a connection in less.
PROBE_S = 0.3
LONGEST_TIMEOUT_S = 86_400.0
# While a reply is awaited, the connection is looked at this often.
_GONE_AFTER_MS = 1000
_ALLOW = "`sudo shearloop keys allow FILE` on the daemon's computer"


class UnreachedError(UserError):
    """No message of a daemon came; its sentence names no option of the command line."""


class UnansweredError(UserError):
    """A request was sent and no reply came: whether it was carried out is not known."""


class Subscriber(AbstractContextManager["Subscriber", None], Iterator[TopicContent], AsyncIterator[TopicContent]):
    """Messages of a daemon as (topic, content), for `for` and for `async for`; close it, or use `with`.

    It receives one topic or several, or all: `topics` are names, such as `eit.estimate`, or their first part, such as
    `eit`. Raises UserError for an unknown topic, for a malformed address, for messages of another program, and if no
    message arrives for `timeout_s`. Without `timeout_s` it waits, and calls `on_quiet` once with a sentence if no
    message has come in QUIET_S; by default that is a warning.
    """

    def __init__(
        self,
        address: str = PUBLISH_ADDRESS,
        topics: str | Iterable[str] = (),
        timeout_s: float | None = None,
        keys: ClientKeys | None = None,
        on_quiet: Callable[[str], None] | None = None,
    ) -> None:
        """Connect; an address on another computer needs keys."""
        self._topics = _names(topics)
        prefixes = [prefix_of(topic) for topic in self._topics]
        # A connection takes a moment: without any time no message comes.
        if timeout_s is not None and _milliseconds(timeout_s) == 0:
            raise _no_such_time(timeout_s)
        self._address, self._timeout_s, self._keys = address, timeout_s, keys
        self._on_quiet = on_quiet or logging.getLogger(__name__).warning
        self._has_waited = timeout_s is not None
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._blocking: zmq.Socket[bytes] = zmq.Socket.shadow(self._socket.underlying)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            connect(self._socket, address, keys)
        except Exception:
            self.close()
            raise
        for prefix in prefixes or [b""]:
            self._socket.setsockopt(zmq.SUBSCRIBE, prefix)

    def wait(self, timeout_s: float | None) -> bool:
        """Return whether a message arrives within these seconds; None waits without end.

        Raises UserError for seconds out of range.
        """
        return bool(self._blocking.poll(_milliseconds(timeout_s)))

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()
        self._context.term()

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self.close()

    def __next__(self) -> TopicContent:
        """Wait for the next message and return it."""
        if not self._has_waited:
            self._has_waited = True
            if not self.wait(QUIET_S):
                self._on_quiet(self._why_quiet(self._probed()))
        if not self.wait(self._timeout_s):
            raise self._no_message(self._probed())
        return self._decoded(self._blocking.recv_multipart())

    async def __anext__(self) -> TopicContent:
        """Wait for the next message and return it."""
        if not self._has_waited:
            self._has_waited = True
            if not await self._socket.poll(_milliseconds(QUIET_S)):
                self._on_quiet(self._why_quiet(await self._probed_meanwhile()))
        if not await self._socket.poll(_milliseconds(self._timeout_s)):
            raise self._no_message(await self._probed_meanwhile())
        return self._decoded(await self._socket.recv_multipart())

    def _probed(self) -> "_Found":
        with _Probe(self._address, self._keys) as probe:
            return probe.found(came=bool(probe.blocking.poll(_milliseconds(PROBE_S))))

    async def _probed_meanwhile(self) -> "_Found":
        with _Probe(self._address, self._keys) as probe:
            return probe.found(came=bool(await probe.events.poll(_milliseconds(PROBE_S))))

    def _why_quiet(self, found: "_Found") -> str:
        nothing = f"no message came from {self._address} in {QUIET_S:g} s; waiting"
        if found is _Found.PUBLISHER:
            return f"{nothing}. A daemon is there; does it publish {' or '.join(self._topics) or 'anything'}?"
        if self._keys is not None or is_open_to_network(self._address):
            return f"{nothing}. Is a daemon running there? If one is, {_key_cause(self._keys)}"
        return f"{nothing}. Is a daemon running there?"

    def _no_message(self, found: "_Found") -> UserError:
        nothing = f"no message came from {self._address} for {self._timeout_s:g} s"
        if found is _Found.PUBLISHER:
            wanted = f"no {' or '.join(self._topics)}" if self._topics else "nothing"
            return UserError(
                f"{nothing}: a daemon is there and publishes {wanted} now; its configuration may have no device for "
                "it, and `shearloop listen` shows what it publishes"
            )
        if found is _Found.OTHER:
            address = "the address of the daemon's `publish` key, not of its `commands`"
            if self._keys is None:
                hint = f"; give {address}{_keys_hint(self._keys)}"
            else:
                hint = f": {_key_cause(self._keys)}; or give {address}"
            return UnreachedError(f"{nothing}: the program there does not publish to this client{hint}")
        if others := other_listeners(self._address):
            listens = f"a program of this computer listens at {others[0]}: if it is the daemon, give that address"
            return UnreachedError(f"{nothing}: {listens}{_keys_hint(self._keys)}")
        return UnreachedError(
            f"{nothing}: no daemon publishes there; {_how_to_start(self._address)}, or give the address of its "
            f"`publish` key{_keys_hint(self._keys)}"
        )

    def _decoded(self, parts: list[bytes]) -> TopicContent:
        try:
            name, payload = parts
            content = decode(payload)
            if missing := ENVELOPE - content.keys():
                raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        except ValueError as error:
            raise UnreachedError(
                f"the messages of {self._address} are not shearloop's ({error}); give the address of the daemon's "
                "`publish` key"
            ) from error
        return name.decode(errors="replace"), content


def _names(topics: str | Iterable[str]) -> list[str]:
    """Return one topic or several as a list; raises UserError for what is neither a text nor a list."""
    if isinstance(topics, str):
        return [topics]
    if isinstance(topics, bytes) or not isinstance(topics, Iterable):
        raise UserError(
            f"topics is {topics!r}; give the name of a topic, such as {next(iter(TOPICS))!r}, or a list of names, or "
            "leave it out to receive all"
        )
    return list(topics)


def prefix_of(topic: str) -> bytes:
    """Return what a topic, or the topics of a first part, begin with; raises UserError if there is none.

    ZeroMQ compares beginnings. So a first part ends with its point, and no topic begins with another one.
    """
    if not isinstance(topic, str):
        raise UserError(f"{topic!r} is no topic; give the name of one, such as {next(iter(TOPICS))!r}")
    name = topic.removesuffix(".")
    if name in TOPICS:
        return name.encode()
    if any(known.startswith(f"{name}.") for known in TOPICS) and "." not in name:
        return f"{name}.".encode()
    near = "".join(f"; did you mean {known}?" for known in get_close_matches(topic, TOPICS, 1)) or "."
    raise UserError(f"there is no topic {topic!r}{near} The topics are {', '.join(TOPICS)}")


class _Found(enum.Enum):
    """What a probe finds at an address."""

    NOTHING = enum.auto()
    PUBLISHER = enum.auto()
    # It ended the connection: it has another kind of socket, or other keys.
    OTHER = enum.auto()


class _Probe(AbstractContextManager["_Probe", None]):
    """A new connection that finds out which program is at an address; it takes the monitor's events."""

    def __init__(self, address: str, keys: ClientKeys | None) -> None:
        self._context = zmq.asyncio.Context()
        self._socket = self._context.socket(zmq.SUB)
        ends = zmq.EVENT_DISCONNECTED
        failed = zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        failed |= zmq.EVENT_HANDSHAKE_FAILED_AUTH
        self.events = self._socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | ends | failed)
        self.blocking: zmq.Socket[bytes] = zmq.Socket.shadow(self.events.underlying)
        connect(self._socket, address, keys)

    def found(self, *, came: bool) -> _Found:
        """Return which program is there; `came` says that an event can be read."""
        if not came:
            return _Found.NOTHING
        event = parse_monitor_message(self.blocking.recv_multipart())
        return _Found.PUBLISHER if event["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED else _Found.OTHER

    def __exit__(self, *_: object) -> None:
        """Disconnect."""
        self._socket.disable_monitor()
        self._context.destroy(linger=0)


def _milliseconds(timeout_s: float | None) -> int | None:
    if timeout_s is None:
        return None
    if not isinstance(timeout_s, int | float) or not 0 <= timeout_s <= LONGEST_TIMEOUT_S:
        raise _no_such_time(timeout_s)
    return math.ceil(1000 * timeout_s)


def _no_such_time(timeout_s: float) -> UserError:
    allowed = f"seconds above 0 and up to {LONGEST_TIMEOUT_S:g}, or None to wait without end"
    return UserError(f"timeout_s is {timeout_s!r}; give {allowed}")


def receive_messages(
    address: str,
    topics: Iterable[str],
    timeout_s: float | None = None,
    keys: ClientKeys | None = None,
    on_quiet: Callable[[str], None] = lambda _: None,
) -> Iterator[TopicContent]:
    """Yield the messages of a Subscriber for a command; calls `on_quiet` if none arrives in the first QUIET_S."""
    try:
        with Subscriber(address, topics, timeout_s, keys, on_quiet) as subscriber:
            yield from subscriber
    except UnreachedError as error:
        raise UserError(f"{error}; see --connect, --key and --server-key") from error


def send_command(
    address: str, content: Mapping[str, Any], timeout_s: float, keys: ClientKeys | None = None
) -> dict[str, Any]:
    """Send one command and return the daemon's reply; raises as `ask`, which an event loop calls instead."""

    async def ask_once() -> dict[str, Any]:
        with zmq.asyncio.Context() as context:
            return await ask(context, address, content, timeout_s, keys)

    return asyncio.run(ask_once())


async def ask(
    context: zmq.asyncio.Context, address: str, content: Mapping[str, Any], timeout_s: float, keys: ClientKeys | None
) -> dict[str, Any]:
    """Send one command and return the daemon's reply; raises UserError if no reply comes in time."""
    may_act = content.get("command") not in READ_ONLY and not content.get("ask")
    with context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        # Nothing waits in this socket for a daemon that begins later.
        socket.setsockopt(zmq.IMMEDIATE, 1)
        connect(socket, address, keys)
        sent = False
        try:
            async with timeout(timeout_s):
                await socket.send(encode(content))
                sent = True
                while not await socket.poll(_GONE_AFTER_MS):
                    # With IMMEDIATE nothing can be sent without a connection.
                    if not int(socket.getsockopt(zmq.EVENTS)) & zmq.POLLOUT:
                        raise ConnectionResetError
                return decode(await socket.recv())
        except (TimeoutError, ConnectionResetError) as error:
            in_doubt = may_act and sent
            late = ". One that runs may have carried it out: see `shearloop command status`" if in_doubt else ""
            if content.get("command") == "stop":
                late = ". Nothing says that the arm stands: use the emergency stop. If the stop still arrives, it "
                late += f"stops what moves then; {_end_sentence(content)}"
            what = f"no daemon answered at {address} within {timeout_s:g} s"
            if isinstance(error, ConnectionResetError):
                what = f"the daemon at {address} ended, or the connection to it, before it answered"
            kind = UnansweredError if in_doubt else UserError
            raise kind(f"{what}; {_cure(address, keys)}{late}") from error
        except ValueError as error:
            raise foreign_reply(address, error) from error


def _cure(address: str, keys: ClientKeys | None) -> str:
    """Return the cure of a command without a reply, from the programs that listen on this computer."""
    options = "--key and --server-key"
    if is_open_to_network(address):
        if keys is None:
            return (
                f"a daemon that is open to the network, as the program there is, answers only with keys: give {options}"
            )
        return f"a program listens there: if it is the daemon, {_key_cause(keys)} ({options})"
    if others := other_listeners(address):
        return f"a program of this computer listens at {others[0]}: if it is the daemon, give --connect {others[0]}"
    address_of = f"the address of its `commands` key with --connect{_keys_hint(keys)} ({options})"
    return f"{_how_to_start(address)}, or give {address_of}"


def _how_to_start(address: str) -> str:
    """Return how a person starts the daemon of an address, which may be on another computer."""
    where = " on its computer" if needs_keys(address) else ""
    return f"start it{where} with `shearloop run CONFIG`"


def _end_sentence(stop: Mapping[str, Any]) -> str:
    """Return whether a stop without a reply can still end a daemon in which nothing runs."""
    if "until_ns" in stop:
        return f"a daemon in which nothing runs ends only if it arrives within {TYPED_WITHIN_S:g} s of the command"
    return "it ends no daemon"


def connect(socket: "zmq.Socket[Any]", address: str, keys: ClientKeys | None = None) -> None:
    """Connect a socket; raises UserError for a malformed address and for a network address without keys."""
    if not isinstance(address, str):
        raise UserError(f"{address!r} is no address; it looks like {PUBLISH_ADDRESS}")
    if not has_valid_port(address):
        raise UserError(
            f"{address} has no valid port (a whole number from 1 to {LARGEST_PORT}); give one such as tcp://127.0.0.1:7761"
        )
    if keys is not None:
        keys.apply(socket)
    elif needs_keys(address):
        raise UserError(
            f"{address} is an address of the network: give your key and the daemon's, as `ClientKeys`; "
            "`shearloop keys client` makes yours, docs/service.md shows the rest"
        )
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        raise UserError(
            f"{address!r} is not an address ({error.strerror}); it looks like tcp://127.0.0.1:7761"
        ) from error


def _key_cause(keys: ClientKeys | None) -> str:
    """Return why a daemon that is open to the network does not answer."""
    if keys is None:
        return "it answers only with keys"
    return f"your key is not allowed ({_ALLOW} allows it), or your server.key is another daemon's"


def _keys_hint(keys: ClientKeys | None) -> str:
    """Return a hint about keys: a daemon on the network does not answer a wrong key at all."""
    if keys is None:
        return "; a daemon with a network address answers only with keys"
    return f"; it answers only keys that {_ALLOW} has added"
