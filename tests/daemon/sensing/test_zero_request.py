"""A request for a zero: its states, and what those who wait for it are told."""

import asyncio

import pytest
from structlog.testing import capture_logs

from shearloop.daemon.sensing.zero_request import ZeroRequest, ZeroState
from tests.running import running

ENDS = {
    ZeroState.TAKEN: lambda zero: zero.take(),
    ZeroState.FAILED: lambda zero: zero.fail("it is loaded"),
    ZeroState.EXPIRED: lambda zero: zero.expire("nothing came"),
    ZeroState.REPLACED: lambda zero: zero.replace(ZeroRequest(0, 1)),
}


def test_only_an_open_request_is_under_way_until_its_time_is_over():
    zero = ZeroRequest(10, 20)
    for state in (ZeroState.REQUESTED, ZeroState.COLLECTING):
        assert zero.state is state
        assert zero.is_open
        assert [zero.is_under_way(t_ns) for t_ns in (5, 20, 21)] == [True, True, False]
        for t_ns in (5, 20):
            zero.expire_if_late(t_ns, lambda: "too late")
        assert zero.is_open
        zero.collect()
    with capture_logs() as logs:
        for t_ns in (21, 22):
            zero.expire_if_late(t_ns, lambda: "too late")
    assert (zero.state, zero.reason) == (ZeroState.EXPIRED, "too late")
    assert [log["event"] for log in logs] == ["too late"]


@pytest.mark.parametrize("state", ENDS)
def test_a_request_ends_once(state):
    zero = ZeroRequest(10, 20)
    ENDS[state](zero)
    reason = zero.reason
    late = (lambda zero: zero.expire_if_late(21, lambda: "too late"),)
    for end in (*ENDS.values(), *late, lambda zero: zero.collect()):
        end(zero)
    assert (zero.state, zero.reason) == (state, reason)
    assert not zero.is_open
    assert not zero.is_under_way(15)


@pytest.mark.parametrize(
    ("state", "told"),
    [(ZeroState.TAKEN, None), (ZeroState.FAILED, "it is loaded"), (ZeroState.EXPIRED, "nothing came")],
)
async def test_waiting_for_a_replaced_request_returns_the_end_of_the_latest_one(state, told):
    first = ZeroRequest(0, 10)
    async with running(first.wait(60.0, lambda: "too late")) as (waiting,):
        await asyncio.sleep(0)
        second = ZeroRequest(1, 11, first)
        third = ZeroRequest(2, 12, second)
        ENDS[state](third)
        async with asyncio.timeout(10):
            assert await waiting == told
    assert (first.state, second.state) == (ZeroState.REPLACED, ZeroState.REPLACED)


async def test_a_wait_that_takes_too_long_ends_its_request_and_no_later_one():
    first = ZeroRequest(0, 10)
    async with running(first.wait(0.01, lambda: "too late")) as (waiting,):
        await asyncio.sleep(0)
        second = ZeroRequest(1, 11, first)
        assert await waiting == "too late"
    assert second.is_open
    assert await second.wait(0.01, lambda: "nothing came") == "nothing came"
    assert (second.state, second.reason) == (ZeroState.EXPIRED, "nothing came")


async def test_a_wait_that_is_cancelled_ends_its_request_and_gives_no_zero_to_others():
    first = ZeroRequest(0, 10)
    async with running(first.wait(60.0, lambda: "too late")) as (waiting,):
        await asyncio.sleep(0)
        second = ZeroRequest(1, 11, first)
        async with running(second.wait(60.0, lambda: "too late")):
            await asyncio.sleep(0)
        assert second.state is ZeroState.EXPIRED
        async with asyncio.timeout(10):
            assert await waiting == "the zero was asked for again, and that was called off"
