"""A request that waited while the daemon stood still is not carried out when it returns."""

from contextlib import closing

import pytest
import zmq
import zmq.asyncio

from shearloop.daemon.messaging import command_server
from shearloop.daemon.messaging.command_server import CommandServer
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.daemon.messaging.late_requests import LONGEST_STANDSTILL_S, READ_WITHIN_S, LateRequests
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.refusals import Refusals
from tests.running import running

SECOND = 1_000_000_000


def test_a_standstill_is_known_for_as_long_as_its_requests_are_read():
    late = LateRequests(0)
    for t_s in (0.2, 0.2 + LONGEST_STANDSTILL_S):
        assert late.why_late(round(t_s * SECOND)) is None
    back_s = 0.3 + 2 * LONGEST_STANDSTILL_S
    assert f"stood still for {back_s - 0.2 - LONGEST_STANDSTILL_S:.1f} s" in late.why_late(round(back_s * SECOND))
    late.alive(round((back_s + 0.2) * SECOND))
    assert late.why_late(round((back_s + 0.9 * READ_WITHIN_S) * SECOND)) is not None
    assert late.why_late(round((back_s + 1.1 * READ_WITHIN_S) * SECOND)) is None


@pytest.mark.parametrize(
    ("name", "carried_out"), [("start", False), ("release", False), ("status", True), ("stop", True), ("pause", True)]
)
async def test_what_is_sent_to_a_daemon_that_stands_still_is_refused_unless_it_lets_nothing_move(
    name, carried_out, monkeypatch
):
    done: list[str] = []
    now_ns = [0]
    monkeypatch.setattr(command_server, "boot_ns", lambda: now_ns[0])

    async def handle(request) -> dict[str, bool]:
        done.append(request["command"])
        return {}

    handlers = dict.fromkeys(("start", "release", "status", "stop", "pause"), handle)
    with (
        zmq.asyncio.Context() as context,
        closing(CommandServer(context, "tcp://127.0.0.1:*", handlers, Refusals())) as server,
        context.socket(zmq.DEALER) as client,
    ):
        client.connect(server.address)

        async def reply_to(command: str) -> dict[str, object]:
            await client.send(encode({"command": command}))
            return decode((await client.recv_multipart())[-1])

        async with running(server.run()):
            await reply_to("status")
            done.clear()
            now_ns[0] += 5 * SECOND
            reply = await reply_to(name)
            assert (reply["ok"], done) == (carried_out, [name] * carried_out)
            assert carried_out or "stood still for 5.0 s" in reply["reason"]
            now_ns[0] += SECOND
            assert (await reply_to(name))["ok"], "sent again, it is carried out"


@pytest.mark.parametrize(
    ("stood_s", "cause"), [(0.0, "reading its file took 3.0 s"), (3.0, "the daemon stood still for 3.0 s")]
)
def test_a_request_that_expired_in_a_standstill_blames_no_drive(stood_s, cause):
    deadline = Deadline(2 * 10**9, 0, lambda: 3 * 10**9)
    assert (deadline.why_passed("reading its file", "copy the file; ", stood_s) or "").startswith(cause)
