"""Requests of the page: a reply, a failure, or a hang that keeps nobody."""

import asyncio
import threading
from typing import Any

import pytest

from shearloop.daemon.errors import UserError
from shearloop.daemon.web import asked
from shearloop.daemon.web.asked import Requests


async def test_a_reply_and_a_failure_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def answers(address: str, content: dict[str, Any], timeout_s: float, keys: object) -> dict[str, Any]:
        assert (timeout_s, keys) == (2.0, None)
        if address == "nowhere":
            raise UserError("no daemon answered")
        return {"ok": True, **content}

    monkeypatch.setattr(asked, "request", answers)
    requests = Requests()
    assert await requests.ask("here", {"command": "stop"}, 2.0, None) == {"ok": True, "command": "stop"}
    with pytest.raises(UserError, match="no daemon answered"):
        await requests.ask("nowhere", {"command": "stop"}, 2.0, None)
    requests.close()


async def test_the_end_waits_for_what_is_on_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    under_way, goes_on, order = threading.Event(), threading.Event(), []

    def slow(*_: object) -> dict[str, Any]:
        under_way.set()
        assert goes_on.wait(20)
        order.append("answered")
        return {"ok": True}

    monkeypatch.setattr(asked, "request", slow)
    monkeypatch.setattr(asked, "GRACE_S", 20.0)
    requests = Requests()
    asking = asyncio.create_task(requests.ask("here", {"command": "stop"}, 0.0, None))
    assert await asyncio.to_thread(under_way.wait, 20)
    ending = threading.Thread(target=lambda: (requests.close(), order.append("ended")))
    ending.start()
    goes_on.set()
    await asyncio.to_thread(ending.join, 20)
    assert order == ["answered", "ended"]
    assert await asking == {"ok": True}


async def test_a_request_that_hangs_is_given_up_and_the_next_one_is_carried(monkeypatch: pytest.MonkeyPatch) -> None:
    goes_on = threading.Event()

    def hangs(_address: str, content: dict[str, Any], _timeout_s: float, _keys: object) -> dict[str, Any]:
        if content["command"] == "tare":
            assert goes_on.wait(20)
        return {"ok": True}

    monkeypatch.setattr(asked, "request", hangs)
    monkeypatch.setattr(asked, "GRACE_S", 0.05)
    requests = Requests()
    with pytest.raises(UserError, match="hangs, and is given up"):
        await requests.ask("here", {"command": "tare"}, 0.0, None)
    monkeypatch.setattr(asked, "GRACE_S", 20.0)
    assert await requests.ask("here", {"command": "stop"}, 0.0, None) == {"ok": True}
    monkeypatch.setattr(asked, "GRACE_S", 0.0)
    requests.close()
    assert not goes_on.is_set(), "the end waits for nothing that hangs"
    assert [one.daemon for one in threading.enumerate() if one.name == "request"] == [True], "nor does the process's"
    goes_on.set()
    monkeypatch.setattr(asked, "GRACE_S", 20.0)
    requests.close()
