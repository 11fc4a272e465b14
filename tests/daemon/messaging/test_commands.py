import asyncio
import os
import re
import socket
import threading
from collections.abc import Mapping
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import pytest
import zmq
import zmq.asyncio

from shearloop.cli.command import DAEMON_COMMANDS, OPTIONS
from shearloop.daemon.clock import Clock
from shearloop.daemon.commands import ARGUMENTS, Answered, Commands
from shearloop.daemon.control.grip import NO_GRIP
from shearloop.daemon.messaging.bound_requests import LateRequestError, meant_for
from shearloop.daemon.messaging.callers import UNKNOWN, caller, caller_of
from shearloop.daemon.messaging.client import ask, receive_messages, send_command
from shearloop.daemon.messaging.command_server import (
    EXPERIMENTS,
    STATUS,
    STOP,
    CommandRefusedError,
    CommandServer,
    RequestExecutor,
)
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.rig_memory import NoMemory
from shearloop.daemon.running_rig import RunningRig
from shearloop.errors import UserError
from tests.fixtures.daemons import bound_handlers
from tests.running import running


def handlers() -> Mapping[str, Any]:
    async def tare(content: Mapping[str, Any]) -> dict[str, Any]:
        if content.get("source") == "left":
            raise CommandRefusedError("there is no fingertip 'left'")
        return {"taring": ["right"]}

    async def unlock(_: Mapping[str, Any]) -> dict[str, Any]:
        raise ZeroDivisionError("nothing to divide")

    return {"tare": tare, "unlock": unlock}


class Unbound(RequestExecutor):
    """The deciding half of the server, without its socket."""

    def __init__(self, executed: Mapping[str, Any] | None = None, *, emulated: bool = False) -> None:
        refusals = Refusals()
        super().__init__(handlers() if executed is None else executed, refusals, emulated=emulated)
        self.refused = refusals.counts

    async def reply(self, payload: bytes, *, t_ns: int = 0) -> dict[str, Any]:
        ready = self.check(b"somebody", [payload], t_ns)
        return ready if isinstance(ready, dict) else await self.execute(*ready)


async def test_each_request_gets_one_reply():
    server = Unbound()
    assert await server.reply(encode({"command": "tare"})) == {"ok": True, "taring": ["right"]}
    for request, why in (
        (encode({"command": "tare", "source": "left"}), "there is no fingertip 'left'"),
        (encode({"command": "jump"}), "there is no command 'jump'; the commands are tare, unlock"),
    ):
        assert await server.reply(request) == {"ok": False, "reason": why}
    assert "not a message" in (await server.reply(b"\x92\x01\x02"))["reason"]
    assert server.refused == {"tare refused": 1, "unknown command": 1, "malformed request": 1}


async def test_req_and_dealer_clients_are_answered():
    with (
        zmq.asyncio.Context() as context,
        closing(CommandServer(context, "tcp://127.0.0.1:*", handlers(), Refusals())) as server,
    ):
        async with running(server.run()):
            reply = await asyncio.to_thread(send_command, server.address, {"command": "tare"}, 5.0)
            assert reply["taring"] == ["right"]
            with context.socket(zmq.REQ) as client:
                client.connect(server.address)
                await client.send(b"\xc1 not msgpack")
                assert not decode(await client.recv())["ok"]


@pytest.mark.parametrize("address", ["ipc://{}/commands", "tcp://127.0.0.1:*"])
async def test_nobody_waits_for_a_daemon_that_has_ended(address, tmp_path, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.messaging.client._GONE_AFTER_MS", 20)
    request = {"command": "start", "confirmed": True}
    with zmq.asyncio.Context() as context:
        with context.socket(zmq.ROUTER) as daemon:
            daemon.bind(address.format(tmp_path))
            bound = daemon.getsockopt_string(zmq.LAST_ENDPOINT)
            asked = asyncio.create_task(ask(context, bound, request, 150.0, None))
            await daemon.recv_multipart()
        with pytest.raises(UserError, match="ended, or the connection to it, before it answered") as refused:
            await asyncio.wait_for(asked, 20.0)
    assert "may have carried it out" in str(refused.value)


async def test_only_a_request_that_was_sent_may_still_be_carried_out(tmp_path):
    request = {"command": "release", "confirmed": True}
    with zmq.asyncio.Context() as context, context.socket(zmq.ROUTER) as silent:
        silent.bind(f"ipc://{tmp_path}/silent")
        for name, sent in (("nobody", False), ("silent", True)):
            with pytest.raises(UserError, match="no daemon answered") as refused:
                await ask(context, f"ipc://{tmp_path}/{name}", request, 0.2, None)
            assert ("may have carried it out" in str(refused.value)) is sent


@pytest.mark.parametrize("name", sorted({*DAEMON_COMMANDS} - {STATUS, STOP, EXPERIMENTS}))
async def test_a_request_for_an_earlier_daemon_is_refused(name):
    """The daemon was restarted between the status that a person has seen and the command."""
    commands = Commands(None, None, None, None, asyncio.Event(), None)
    with pytest.raises(CommandRefusedError, match="is meant for an earlier daemon, and this one has begun since"):
        await commands.handlers()[name]({"command": name, "instance": "of the earlier one"})


async def test_a_stop_is_for_every_daemon_and_another_request_may_be():
    health = SimpleNamespace(tasks=dict, rig="bench")
    commands = Commands(None, SimpleNamespace(tareable={}), None, health, asyncio.Event(), lambda **_: "held")
    status = await commands.handlers()[STATUS]({})
    for bound in (meant_for(status, 0.0, 2.0), {}):
        with pytest.raises(CommandRefusedError, match="held"):
            await commands.handlers()["tare"](bound)
    assert (await commands.handlers()[STOP]({"instance": "another", "spare_daemon": True}))["stopped"] == ""


@pytest.mark.parametrize("missing", ["instance", "until_ns", "instance and until_ns"])
async def test_nothing_moves_for_a_request_that_does_not_say_of_when_it_is_and_for_which_daemon(missing):
    health = SimpleNamespace(tasks=dict, rig="bench")
    sensors = SimpleNamespace(tareable={})
    commands = Commands(None, sensors, None, health, asyncio.Event(), lambda **_: "tare is asked for")
    bound = meant_for(await commands.handlers()[STATUS]({}), 0.0, 2.0)
    request = {key: value for key, value in bound.items() if key not in missing}
    named = " and ".join(f"`{key}`" for key in missing.split(" and "))
    found = {}
    for name in {*DAEMON_COMMANDS} - {STATUS, STOP, EXPERIMENTS}:
        with pytest.raises(CommandRefusedError) as refused:
            await commands.handlers()[name](request)
        found[name] = f"{named} " in str(refused.value) and "missing" in str(refused.value)
    moves = {"start", "resume", "unlock", "release"}
    assert {name for name, is_refused in found.items() if is_refused} == moves
    for name in ("start", "release"):
        with pytest.raises(CommandRefusedError) as refused:
            await commands.handlers()[name]({**request, "ask": True})
        assert "missing" not in str(refused.value), "a question moves nothing"


@pytest.mark.parametrize("name", sorted({*DAEMON_COMMANDS} - {STATUS, STOP, EXPERIMENTS}))
async def test_what_is_asked_for_too_long_ago_is_refused_unless_it_lets_nothing_move(name):
    """The request, the client or the daemon stood still after the operator's word."""
    health = SimpleNamespace(tasks=dict, rig="bench")
    now_ns = 7_000_000_000
    commands = Commands(None, None, None, health, asyncio.Event(), None, now_ns=lambda: now_ns)
    request = {"command": name, **meant_for(await commands.handlers()[STATUS]({}), 0.5, 2.0)}
    now_ns += 1_600_000_000
    with pytest.raises(CommandRefusedError) as refused:
        await commands.handlers()[name](request)
    assert ("it came 0.1 s too late" in str(refused.value)) is (name != "pause")


@pytest.mark.parametrize("name", ["start", "resume", "unlock", "release"])
async def test_a_request_whose_time_is_of_another_clock_is_refused(name):
    """By Unix time it would never be too late."""
    rig = SimpleNamespace(tasks=dict, rig="bench")
    commands = Commands(None, None, None, rig, asyncio.Event(), None, now_ns=lambda: 7_000_000_000)
    bound = meant_for(await commands.handlers()[STATUS]({}), 0.0, 2.0)
    with pytest.raises(CommandRefusedError, match=rf"more than a day ahead.* and this {name} would never be too late"):
        await commands.handlers()[name]({**bound, "until_ns": 1_800_000_000_000_000_000})


@pytest.mark.parametrize("name", ["start", "resume", "unlock", "release"])
async def test_a_stop_ends_every_request_that_was_asked_for_before_it(name):
    """The daemon stood still for a moment, and read the stop before the older request."""
    now_ns, rig = 7_000_000_000, SimpleNamespace(tasks=dict, rig="bench")
    commands = Commands(None, None, None, rig, asyncio.Event(), None, now_ns=lambda: now_ns)
    handlers = commands.handlers()

    async def refusal(request: dict[str, Any]) -> str:
        with pytest.raises(CommandRefusedError) as refused:
            await handlers[name](request)
        return str(refused.value)

    of_before = meant_for(await handlers[STATUS]({}), 0.1, 2.0)
    stopped_before = "a stop came after it was asked for; look at the rig, and send it again"
    assert await refusal(of_before) != stopped_before
    now_ns += 200_000_000
    await handlers[STOP]({"spare_daemon": True})
    assert await refusal(of_before) == stopped_before
    # The reply to `status` came after the stop, and the operator's word before it.
    now_ns += 100_000_000
    assert await refusal(meant_for(await handlers[STATUS]({}), 0.2, 2.0)) == stopped_before
    of_now = meant_for(await handlers[STATUS]({}), 0.05, 2.0)
    assert await refusal(of_now) != stopped_before
    undated = {key: of_now[key] for key in ("instance", "until_ns")}
    assert "a stop came 0.1 s ago, and without `asked_ns` by the daemon's clock nothing shows" in await refusal(undated)
    # Unix time, by mistake, is later than any stop.
    other_clock = {**of_now, "asked_ns": 1_800_000_000_000_000_000}
    assert "a stop came 0.1 s ago, and without `asked_ns` by the daemon's clock" in await refusal(other_clock)
    now_ns += 5_000_000_000
    undated["until_ns"] = now_ns + 1
    assert "a stop came" not in await refusal(undated)


async def test_a_pause_ends_a_resume_that_was_asked_for_before_it():
    """The daemon read the pause before the older resume, and the wrist turned on after it."""
    now_ns, paused = 7_000_000_000, []
    loop = SimpleNamespace(pause=lambda: paused.append(True), resume=paused.clear)
    commands = Commands(
        SimpleNamespace(control_loop=loop), None, None, None, asyncio.Event(), None, now_ns=lambda: now_ns
    )
    handlers = commands.handlers()

    def asked(at_ns: int) -> dict[str, int | str]:
        return {"instance": commands.running_rig.instance, "asked_ns": at_ns, "until_ns": now_ns + 1_000_000_000}

    before_ns = now_ns - 1
    await handlers["pause"](asked(now_ns))
    with pytest.raises(CommandRefusedError, match=r"^a pause came after it was asked for; look at the rig"):
        await handlers["resume"](asked(before_ns))
    assert paused
    undated = {key: value for key, value in asked(now_ns).items() if key != "asked_ns"}
    with pytest.raises(CommandRefusedError, match=r"^a pause came 0\.0 s ago, and without `asked_ns`.* the pause$"):
        await handlers["resume"](undated)
    # An older pause lets nothing move.
    await handlers["pause"](asked(before_ns))
    now_ns += 1_000_000
    await handlers["resume"](asked(now_ns))
    assert not paused


async def test_a_stop_that_is_sent_again_is_reported_once():
    """The one that ends an idle daemon is sent again with its time, and was recorded twice."""
    told: list[Answered] = []
    commands = Commands(None, None, None, None, asyncio.Event(), None, told.append, now_ns=lambda: 7)
    stop = commands.handlers()[STOP]
    for number in (1, 2):
        request = {"command": STOP, "by": "ann", "request_id": f"a{number}"}
        first = await stop(request)
        await stop(request | meant_for(first, 0.5, 2.0))
        assert [one.request["request_id"] for one in told] == ["a1", "a2"][:number]
    # Of stops without a name each is one of its own.
    for _ in range(2):
        await stop({"command": STOP, "by": "ann"})
    assert len(told) == 4


async def test_only_a_stop_that_is_known_to_be_fresh_ends_a_daemon_in_which_nothing_moves():
    """One that timed out at its client may arrive when somebody else works with the daemon."""
    now_ns, ends = 7_000_000_000, asyncio.Event()
    commands = Commands(None, None, None, None, ends, None, now_ns=lambda: now_ns)
    stop = commands.handlers()[STOP]
    first = await stop({"command": STOP, "by": "ann"})
    assert (first["stopped"], first["idle"]) == ("", True), "its age is not known"
    fresh = meant_for(first, 0.5, 2.0)
    for other in ({"instance": "of the earlier one"}, {"until_ns": now_ns - 1}, {"until_ns": True}, {"until_ns": "9"}):
        assert (await stop({**fresh, **other}))["idle"]
    assert "ended" not in await stop({**fresh, "spare_daemon": True})
    assert (await stop(fresh))["ended"]
    async with asyncio.timeout(10):
        await ends.wait()


async def test_nothing_is_sent_that_was_asked_for_too_long_ago():
    with pytest.raises(LateRequestError, match=r"asked for 2\.1 s ago, and nothing begins later than 2 s after that"):
        meant_for({"daemon": {"instance": "a1", "now_ns": 1}}, 2.1, 2.0)
    assert meant_for({"daemon": {"instance": "a1", "now_ns": 1}}, 0.5, 2.0) == {
        "instance": "a1",
        "asked_ns": -499_999_999,
        "until_ns": 1_500_000_001,
    }
    assert meant_for({}, 0.5, 2.0) == {}


def test_an_address_in_use_is_an_error():
    with zmq.Context() as context, context.socket(zmq.PUB) as taken:
        taken.bind("tcp://127.0.0.1:*")
        address = taken.getsockopt_string(zmq.LAST_ENDPOINT)
        with pytest.raises(UserError, match=rf"`publish: {address}` is already in use; is another daemon"):
            Publisher(context, address, Clock())
        # Many tries: libzmq frees a closed socket's addresses later, in its own thread.
        for _ in range(1000):
            with pytest.raises(UserError, match="cannot be bound"):
                Publisher(context, "carrier-pigeon", Clock())


async def test_a_failing_handler_is_a_refusal():
    server = Unbound()
    assert "unlock failed (ZeroDivisionError" in (await server.reply(encode({"command": "unlock"})))["reason"]
    assert server.refused == {"unlock failed": 1}
    assert (await server.reply(encode({"command": "tare"})))["ok"]


def test_binding_to_ipc_keeps_files_and_running_daemons(tmp_path):
    letter = tmp_path / "letter.txt"
    letter.write_text("dear reader")
    with zmq.Context() as context:
        with pytest.raises(UserError, match=r"`publish: ipc://.*letter.txt exists and is no socket"):
            Publisher(context, f"ipc://{letter}", Clock())
        assert letter.read_text() == "dear reader"
        first = Publisher(context, f"ipc://{tmp_path}/publish", Clock())
        with pytest.raises(UserError, match="is already in use; is another daemon running"):
            Publisher(context, f"ipc://{tmp_path}/publish", Clock())
        first.close()


def test_the_socket_of_a_killed_daemon_is_reused(tmp_path):
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(os.fspath(tmp_path / "publish"))
    with zmq.Context() as context:
        Publisher(context, f"ipc://{tmp_path}/publish", Clock()).close()


def test_foreign_messages_are_an_error(tmp_path):
    with zmq.Context() as context, context.socket(zmq.XPUB) as stranger:
        stranger.bind(f"ipc://{tmp_path}/stranger")
        for content in ([b"one frame"], [b"a", b"\xc1"], [b"a", encode({"timestamp": 1.0})], [b"1", b"2", b"3"]):
            heard = receive_messages(f"ipc://{tmp_path}/stranger", (), 5.0)
            sending = threading.Thread(target=lambda sent=content: (stranger.recv(), stranger.send_multipart(sent)))
            sending.start()
            with pytest.raises(UserError, match="are not shearloop's"):
                next(heard)
            sending.join()
            stranger.recv()


def test_every_command_has_a_handler_and_a_description_and_the_page_knows_it():
    server = pytest.importorskip("shearloop.daemon.web.server", reason="the live page needs the extra `view`")
    handled = Commands(
        rig=None, sensors=None, experiment=None, health=None, daemon_end=None, tare_refusal=None
    ).handlers()
    assert set(DAEMON_COMMANDS) == set(handled) == {*server.NEEDS_TOKEN, STATUS, STOP, EXPERIMENTS}


def test_the_options_of_a_command_are_the_arguments_that_the_daemon_takes():
    for argument, (_, commands) in OPTIONS.items():
        assert {*commands} == {name for name, own in ARGUMENTS.items() if argument in own}, argument


async def test_commands_are_reported_with_their_answer_and_questions_are_not():
    reported: list[tuple[str, str | None]] = []
    sensors = SimpleNamespace(tareable={"right": SimpleNamespace(tare=lambda **_: None)})
    handlers = Commands(
        rig=None,
        sensors=sensors,
        experiment=None,
        health=SimpleNamespace(tasks=dict, rig="bench"),
        daemon_end=asyncio.Event(),
        tare_refusal=lambda **_: None,
        report=lambda answered: reported.append((answered.name, answered.refusal)),
    ).handlers()
    await handlers["tare"]({"by": "ann"})
    await handlers[STATUS]({})
    for name, request_ in (("tare", {"source": "left"}), ("start", {}), ("start", {"ask": True})):
        with pytest.raises(CommandRefusedError):
            await handlers[name](request_)
    assert [name for name, _ in reported] == ["tare", "tare", "start"]
    assert reported[0][1] is None
    assert "there is no sensor 'left' to tare" in str(reported[1][1])


async def test_a_command_that_crashes_or_is_cut_off_is_reported_as_not_carried_out():
    reported: list[str | None] = []
    begun, never = asyncio.Event(), asyncio.Event()

    def crash() -> None:
        raise ZeroDivisionError("nothing to divide")

    class Runner:
        def release_refusal(self) -> None:
            return None

        async def release(self, _deadline: Deadline) -> None:
            begun.set()
            await never.wait()

    no_gripper = SimpleNamespace(has_gripper=False, held=None, activates=False, grip=NO_GRIP)
    operator = SimpleNamespace(tool=no_gripper, inputs=SimpleNamespace(arm=None, gripper=None))
    loop = SimpleNamespace(operator=operator, pause=crash)
    rig = SimpleNamespace(runner=Runner(), control_loop=loop, occasion=tuple, memory=NoMemory())
    handlers = bound_handlers(
        Commands(
            rig=rig,
            sensors=None,
            experiment=None,
            health=None,
            daemon_end=asyncio.Event(),
            tare_refusal=None,
            report=lambda answered: reported.append(answered.refusal),
        )
    )
    with pytest.raises(ZeroDivisionError):
        await handlers["pause"]({})
    releasing = asyncio.create_task(handlers["release"]({"confirmed": True}))
    await begun.wait()
    releasing.cancel()
    await asyncio.gather(releasing, return_exceptions=True)
    assert reported == [
        "pause failed (ZeroDivisionError: nothing to divide); see the daemon's log",
        "release was ended before it was done",
    ]


@pytest.mark.parametrize(
    ("by", "shown"),
    [("ann@rig, a script", "ann@rig, a script"), ("a\nb\x1b[2J", "a b\\u001b[2J"), ("", UNKNOWN), (7, UNKNOWN)],
)
def test_who_sends_a_command_is_one_printable_line(by, shown):
    assert caller_of({"by": by}) == shown
    assert len(caller_of({"by": "x" * 500})) <= 80
    assert caller("shearloop command").endswith(f"@{os.uname().nodename}, shearloop command")


@pytest.mark.parametrize(
    ("name", "request_", "why"),
    [
        ("release", {"confirmed": "no"}, "`confirmed` is 'no', and has to be true or false"),
        ("release", {"confirmed": 1}, "has to be true or false"),
        ("tare", {"confirmed": "no"}, "has to be true or false"),
        ("start", {"exper1ment": "a.yaml"}, "`start` has no argument 'exper1ment'; it has experiment, confirmed"),
        ("start", {"confirmed": "yes"}, "`confirmed` is 'yes', and has to be true or false"),
        ("pause", {"confirmed": True}, "`pause` has no argument 'confirmed'"),
        ("start", {"experiment": ""}, "`experiment` is '', and has to be text"),
        ("start", {"experiment": False}, "has to be text"),
        ("unlock", {"ask": True}, "`unlock` has no argument 'ask'; it has confirmed, digest"),
    ],
)
async def test_an_argument_that_a_command_does_not_have_moves_nothing(name, request_, why):
    commands = Commands(
        rig=None, sensors=None, experiment=None, health=None, daemon_end=asyncio.Event(), tare_refusal=None
    )
    with pytest.raises(CommandRefusedError, match=re.escape(why)):
        await commands.handlers()[name]({"command": name, "by": "ann", **request_})


@pytest.mark.parametrize("emulated", [False, True])
async def test_replies_and_refusals_of_an_emulated_rig_say_so(emulated):
    health, ending = SimpleNamespace(tasks=dict), asyncio.Event()
    rig = RunningRig("bench", emulated)
    sensors = SimpleNamespace(tareable={})
    handlers = Commands(None, sensors, None, health, ending, lambda **_: None, running_rig=rig).handlers()
    server = Unbound(handlers, emulated=emulated)
    replies = {name: await server.reply(encode({"command": name})) for name in (*handlers, "jump")}
    assert {name for name, reply in replies.items() if reply["ok"]} == {STATUS, STOP}
    malformed = await server.reply(b"\x92\x01\x02")
    for reply in (*replies.values(), malformed):
        assert reply.get("emulated", False) is emulated
    assert replies[STATUS]["daemon"]["emulated"] is emulated


async def test_tare_is_refused_during_an_experiment():
    tared: list[str] = []
    refusal: list[str | None] = ["the experiment 'hold' is running, and a new zero would change its torques"]
    sensors = {name: SimpleNamespace(tare=lambda name=name, **_: tared.append(name)) for name in ("right", "load_cell")}
    commands = Commands(
        rig=None,
        sensors=SimpleNamespace(tareable=sensors),
        experiment=None,
        health=SimpleNamespace(tasks=lambda: {"right": {"connected": True}}),
        daemon_end=asyncio.Event(),
        tare_refusal=lambda *, confirmed: None if confirmed else refusal[0],
    )
    tare = commands.handlers()["tare"]
    for request_ in ({}, {"source": "load_cell"}):
        with pytest.raises(
            CommandRefusedError, match="the experiment 'hold' is running, and a new zero would change its"
        ):
            await tare(request_)
    assert tared == []
    assert await tare({"confirmed": True}) == {"taring": ["right", "load_cell"]}
    tared.clear()
    refusal[0] = None
    assert await tare({"source": "load_cell"}) == {"taring": ["load_cell"]}
    assert await tare({}) == {"taring": ["right", "load_cell"]}
    assert tared == ["load_cell", "right", "load_cell"]
