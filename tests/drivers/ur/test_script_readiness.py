"""The control script's readiness, from scripted samples in their own time."""

from types import SimpleNamespace

import pytest

from shearloop.drivers.ur import script_readiness as ready_module
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.script_readiness import ScriptReadiness
from tests.drivers.ur.handler_bench import received

READY, DONE = 1, 2
PLAYING, STOPPED, PAUSED = 2, 1, 4


class Samples:
    """Samples every 8 ms with the script's and the program's state; the last one repeats."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *said: tuple[int, int]) -> None:
        self._said = list(said)
        self.connected = True
        self.taken, self.now_s = 0, 5.0
        monkeypatch.setattr(ready_module, "time", SimpleNamespace(monotonic=lambda: self.now_s))

    def latest(self) -> RtdeOutputs:
        script_state, runtime_state = self._said[min(self.taken, len(self._said) - 1)]
        return received(50.0 + 0.008 * self.taken, runtime_state, script_state)

    def wait(self, seconds: float) -> bool:
        self.now_s += min(max(seconds, 0.0), 0.008)
        self.taken += seconds >= 0.008
        return seconds >= 0.008


def test_no_wait_without_a_command(monkeypatch):
    samples = Samples(monkeypatch, (DONE, STOPPED))
    assert ScriptReadiness(samples, 0.1).wait()
    assert samples.taken == 0


def test_only_a_later_sample_shows_readiness(monkeypatch):
    samples = Samples(monkeypatch, (READY, PLAYING), (DONE, PLAYING), (DONE, PLAYING), (READY, PLAYING))
    ready = ScriptReadiness(samples, 0.1)
    ready.command_sent()
    assert ready.wait()
    assert samples.taken == 3
    assert ready.wait()
    assert samples.taken == 3


@pytest.mark.parametrize("runtime_state", [STOPPED, PAUSED])
def test_ended_or_paused_program_is_not_awaited(monkeypatch, runtime_state):
    """After a long pause of the computer the watchdog ends the program during a command."""
    samples = Samples(monkeypatch, (DONE, PLAYING), (DONE, PLAYING), (DONE, runtime_state))
    ready = ScriptReadiness(samples, 0.1)
    ready.command_sent()
    assert not ready.wait()
    assert samples.taken == 2
    assert not ready.wait()


def test_wait_for_readiness_has_a_timeout(monkeypatch):
    samples = Samples(monkeypatch, (DONE, PLAYING))
    ready = ScriptReadiness(samples, 0.1)
    ready.command_sent()
    assert not ready.wait()
    assert samples.now_s == pytest.approx(5.1, abs=0.01)


def test_lost_connection_never_means_ready(monkeypatch):
    samples = Samples(monkeypatch, (READY, PLAYING))
    ready = ScriptReadiness(samples, 0.1)
    ready.command_sent()
    samples.taken, samples.connected = 1, False
    assert not ready.wait()
