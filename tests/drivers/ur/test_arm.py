"""`UrArm` over fake ur-rtde clients."""

import ctypes
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from shearloop.drivers.ur.controller import ProbeError, ReceivedSample
from shearloop.drivers.ur.messages import MoveLinear, WristSpeed
from shearloop.drivers.ur.script import NO_MOTION_S
from tests.drivers.ur.flight import SETTINGS

SIX = (0.0,) * 6
FIVE = (SIX,) * 5
TOOL = (1.0, (0.0, 0.0, 0.06), SIX)
VERSION = "5.17.3.0"


class Client:
    """Connects to nothing."""

    FLAG_NO_WAIT = 0

    def __init__(self, *_: object) -> None:
        self.connected = True

    def getScript(self) -> str:  # noqa: N802 - ur-rtde's name
        return "    thread speed_thread():\n    end\n        keep_running = True\n"

    def write_deadline(self, script_s: float) -> None:
        """Take it."""

    def latest(self) -> ReceivedSample:
        """Return a sample of a program that ended during a command."""
        return ReceivedSample(1.0, *FIVE, 7, 1, 1, 1.0, *TOOL, 2)


@pytest.fixture
def arm(monkeypatch) -> Iterator[ModuleType]:
    """The module `shearloop.drivers.ur.arm` over fake clients."""
    for name, kind in (("rtde_control", "RTDEControlInterface"), ("script_client", "ScriptClient")):
        module = ModuleType(name)
        setattr(module, kind, Client)
        monkeypatch.setitem(sys.modules, name, module)
    # Another test may have imported it over the real clients.
    monkeypatch.delitem(sys.modules, "shearloop.drivers.ur.arm", raising=False)
    arm = importlib.import_module("shearloop.drivers.ur.arm")
    monkeypatch.setattr(arm, "RtdeReceiver", Client)
    yield arm
    del sys.modules["shearloop.drivers.ur.arm"]


def test_sample_that_waited_in_the_socket_is_old(arm, monkeypatch):
    reader, now_ns = arm.UrArm(SETTINGS, VERSION), 10**12
    monkeypatch.setattr(arm.time, "monotonic_ns", lambda: now_ns)
    monkeypatch.setattr(reader, "_control", SimpleNamespace(isConnected=lambda: True))
    for number, waited_ns in enumerate([0, 0, 200_000_000]):
        sample = ReceivedSample(50.0 + 0.008 * number, *FIVE, 7, 1, 2, 1.0, *TOOL, 1)
        monkeypatch.setattr(reader, "_receiver", SimpleNamespace(latest=lambda it=sample: it, connected=True))
        now_ns = 10**12 + 8_000_000 * number + waited_ns
        assert reader.read().age_ns == pytest.approx(waited_ns, abs=3_000_000)


def test_refused_timer_slack_does_not_prevent_connecting(arm, monkeypatch, capsys):
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(prctl=lambda *_: -1))
    assert arm.UrArm(SETTINGS, VERSION)._control.connected
    assert "wake more often than needed" in capsys.readouterr().err


@pytest.mark.parametrize(("watchdog_hz", "slack_ms"), [(2.0, 16), (10.0, 16), (40.0, 4)])
def test_timer_slack_is_a_fraction_of_the_watchdog_time(arm, monkeypatch, watchdog_hz, slack_ms):
    asked: list[int] = []

    def prctl(_option: int, slack: ctypes.c_ulong, *_: int) -> int:
        asked.append(slack.value // 1_000_000)
        return 0

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(prctl=prctl))
    arm.UrArm(dataclasses.replace(SETTINGS, watchdog_hz=watchdog_hz), VERSION)
    # 0 is the default again, for what this thread starts later.
    assert asked == [slack_ms, 0]


class Controlled(Client):
    """Takes every command and reports a linear move; `asked` counts the queries."""

    asked = 0

    def isConnected(self) -> bool:  # noqa: N802 - ur-rtde's name
        return True

    def speedJ(self, *_: object) -> bool:  # noqa: N802
        return True

    def moveL(self, *_: object, **__: object) -> bool:  # noqa: N802
        return True

    def getAsyncOperationProgressEx(self) -> SimpleNamespace:  # noqa: N802
        self.asked += 1
        return SimpleNamespace(isAsyncOperationRunning=lambda: True)


def test_progress_is_queried_only_for_a_linear_move(arm, monkeypatch):
    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Controlled)
    times_s = iter(range(1, 100))
    monkeypatch.setattr(
        arm,
        "RtdeReceiver",
        lambda *_: SimpleNamespace(
            connected=True,
            latest=lambda: ReceivedSample(float(next(times_s)), *FIVE, 7, 1, 2, 1.0, *TOOL, 1),
            write_deadline=lambda _: None,
        ),
    )
    one = arm.UrArm(SETTINGS, VERSION)
    assert not one.read().moving_linearly
    one.move(MoveLinear(SIX, 0.1, 0.1))
    assert [one.read().moving_linearly for _ in range(3)] == [True] * 3
    one.wrist(WristSpeed(0.1, 1.0), 0.1)
    assert not one.read().moving_linearly
    assert one._control.asked == 3


class Hanging(Client):
    """Hangs in each call but the first; `calls` names them."""

    def __init__(self, *_: object) -> None:
        super().__init__()
        self.calls: list[str] = []
        self.knows_of_the_end = False

    def __getattr__(self, name: str) -> Callable[..., bool]:
        def call(*_: object, **__: object) -> bool:
            assert not self.calls, f"{name} does not come back"
            self.calls.append(name)
            return True

        return call

    def isProgramRunning(self) -> bool:  # noqa: N802
        return not self.knows_of_the_end


def test_no_call_blocks_when_no_program_runs(arm, monkeypatch):
    """The watchdog has ended the program before it was ready for the next command."""
    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Hanging)
    one = arm.UrArm(SETTINGS, VERSION)
    assert one.zero_wrench()
    assert not one.send_heartbeat()
    assert not one.wrist(WristSpeed(0.1, 1.0), 0.1)
    assert not one.move(MoveLinear(SIX, 0.1, 0.1))
    assert not one.stop_move(1.0)
    assert not one.end_speed(1.0)
    assert not one.zero_wrench()
    assert not one.arm_watchdog()
    one.end_program()
    assert one._control.calls == ["zeroFtSensor"]


def test_register_is_cleared_once_the_client_knows_that_no_program_runs(arm, monkeypatch):
    """Before that, the client would wait for the program."""
    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Hanging)
    one = arm.UrArm(SETTINGS, VERSION)
    assert not one.clear_command()
    assert one._control.calls == []
    one._control.knows_of_the_end = True
    assert one.clear_command()
    assert one._control.calls == ["kickWatchdog"]


def test_sent_script_arms_its_watchdog(arm, monkeypatch):
    class Sending(Client):
        sent = ""

        def setCustomScriptFile(self, path: str) -> None:  # noqa: N802 - ur-rtde's name
            self.sent = Path(path).read_text()

    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Sending)
    one = arm.UrArm(SETTINGS, VERSION)
    assert one.upload()
    assert 'rtde_set_watchdog("input_int_register_0", 10, "stop")' in one._control.sent


def test_unknown_script_is_refused(arm, monkeypatch):
    """Without its deadline the wrist could turn on."""
    monkeypatch.setattr(arm.script_client.ScriptClient, "getScript", lambda _: "of another form\n")
    with pytest.raises(ProbeError, match="unknown, so that its limits"):
        arm.UrArm(SETTINGS, VERSION)


def test_deadline_counts_from_the_latest_sample(arm, monkeypatch):
    written: list[float] = []
    sample = ReceivedSample(1.0, *FIVE, 7, 1, 2, 1.0, *TOOL, 1, 20.0)
    receiver = SimpleNamespace(latest=lambda: sample, write_deadline=written.append, connected=True)
    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Controlled)
    monkeypatch.setattr(arm, "RtdeReceiver", lambda *_: receiver)
    one = arm.UrArm(SETTINGS, VERSION)
    assert one.wrist(WristSpeed(0.1, 1.0), 0.07)
    one.withdraw_deadline()
    assert written == [pytest.approx(20.07), NO_MOTION_S]


def test_connection_that_takes_no_script_is_lost(arm, monkeypatch, capsys):
    """Only a new worker opens the connection again."""

    class Closed(Controlled):
        def setCustomScriptFile(self, _path: str) -> None:  # noqa: N802 - ur-rtde's name
            raise RuntimeError("write: Broken pipe")

    monkeypatch.setattr(arm.rtde_control, "RTDEControlInterface", Closed)
    one = arm.UrArm(SETTINGS, VERSION)
    assert one.read().connected
    assert not one.upload()
    assert not one.read().connected
    assert "could not be sent: write: Broken pipe" in capsys.readouterr().err
