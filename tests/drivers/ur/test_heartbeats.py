"""Heartbeats to the worker: as often as needed, none while commands come."""

import asyncio
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from shearloop.drivers.ur import client
from shearloop.drivers.ur.client import WorkerConnection
from shearloop.drivers.ur.messages import Heartbeat, encode
from tests.drivers.ur.flight import SETTINGS

LONGEST_S = SETTINGS.silence_timeout_s / 4


class Played:
    """A worker that gets a command each 8 ms until `commands_until_s`, and a clock that only sleeping advances."""

    def __init__(self, commands_until_s: float, ends_s: float) -> None:
        self.now_s = 0.0
        self.connection: Any = None
        self.heartbeats_s: list[float] = []
        self._commands_until_s, self._ends_s = commands_until_s, ends_s

    def get_pipe_transport(self, _fd: int) -> Any:
        return self

    def write(self, data: bytes) -> None:
        """Note a heartbeat."""
        if data == encode(Heartbeat()):
            self.heartbeats_s.append(self.now_s)

    async def sleep(self, seconds: float) -> None:
        """Let time pass."""
        assert seconds > 0
        # No sleep is as short as what rounding leaves.
        self.now_s += max(seconds, 1e-6)
        if self.now_s < self._commands_until_s:
            self.connection._sent_s = self.now_s - self.now_s % 0.008
        if self.now_s >= self._ends_s:
            raise asyncio.CancelledError


async def heartbeats_s(monkeypatch: pytest.MonkeyPatch, commands_until_s: float, ends_s: float) -> list[float]:
    """Return the times of the heartbeats."""
    played: Any = Played(commands_until_s, ends_s)
    monkeypatch.setattr(client, "time", SimpleNamespace(monotonic=lambda: played.now_s))
    played.connection = WorkerConnection(SETTINGS, lambda *_: None)
    played.connection.connection_made(played)
    with monkeypatch.context() as patched:
        patched.setattr(asyncio, "sleep", played.sleep)
        with pytest.raises(asyncio.CancelledError):
            await played.connection.keep_alive()
    return played.heartbeats_s


async def test_no_heartbeats_while_commands_come(monkeypatch: pytest.MonkeyPatch) -> None:
    assert await heartbeats_s(monkeypatch, commands_until_s=10.0, ends_s=9.0) == []


async def test_heartbeats_start_after_the_last_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    signs = await heartbeats_s(monkeypatch, commands_until_s=1.0, ends_s=3.0)
    last_command_s = 1.0 - 0.008
    assert len(signs) > 1.5 / LONGEST_S
    assert signs[0] - last_command_s <= LONGEST_S + 0.008
    assert all(later - one == pytest.approx(LONGEST_S, abs=1e-5) for one, later in pairwise(signs))
