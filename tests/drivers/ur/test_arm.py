"""`UrArm` over fake ur-rtde clients."""

import ctypes
import dataclasses
import importlib
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from shearloop.drivers.ur import library, receiver
from shearloop.drivers.ur import settings as ur
from shearloop.drivers.ur.messages import MoveLinear, RobotLostError, RtdeOutputs, WristSpeed
from shearloop.drivers.ur.script import LOWER, NO_MOTION_TICKS, UPPER
from tests.drivers.ur.handler_bench import SETTINGS, received

SIX = (0.0,) * 6


class Client:
    """Connects to nothing, takes every call of ur-rtde's and answers True or from `answers`; `calls` names them."""

    FLAG_NO_WAIT, FLAG_UPPER_RANGE_REGISTERS, FLAG_NO_EXT_FT = 16, 8, 64
    answers: ClassVar[dict[str, object]] = {}

    # The latest one.
    made: ClassVar["Client"]

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments
        self.calls: list[str] = []
        type(self).made = self

    def __getattr__(self, name: str) -> Callable[..., object]:
        def call(*_: object, **__: object) -> object:
            self.calls.append(name)
            return self.answers.get(name, True)

        return call


class Receiver:
    """Has the same sample for ever, and notes the deadlines."""

    # The latest one.
    made: ClassVar["Receiver"]

    def __init__(self, *_: object) -> None:
        type(self).made = self
        self.connected = True
        self.deadlines: list[int] = []
        # Of a program that ended during a command.
        self.sample = received(1.0, runtime_state=1, script_state=2)

    def latest(self) -> RtdeOutputs:
        return self.sample

    def write_deadline(self, script_ticks: int) -> None:
        self.deadlines.append(script_ticks)


@pytest.fixture
def arm(monkeypatch) -> Iterator[ModuleType]:
    """The module `shearloop.drivers.ur.arm` over fake clients."""
    module = ModuleType("rtde_control")
    module.RTDEControlInterface = Client
    monkeypatch.setitem(sys.modules, "rtde_control", module)
    monkeypatch.setattr(Client, "answers", {})
    # Another test may have imported it over the real clients.
    monkeypatch.delitem(sys.modules, "shearloop.drivers.ur.arm", raising=False)
    # It is the default of an argument, so that it has to be there at the import.
    monkeypatch.setattr(receiver, "RtdeReceiver", Receiver)
    arm = importlib.import_module("shearloop.drivers.ur.arm")
    monkeypatch.setattr(library, "version", lambda _: library.CLIENT_VERSION)
    yield arm
    del sys.modules["shearloop.drivers.ur.arm"]


def test_sample_that_waited_in_the_socket_is_old(arm, monkeypatch):
    reader, now_ns = arm.UrArm(SETTINGS), 10**12
    monkeypatch.setattr(arm.time, "monotonic_ns", lambda: now_ns)
    for number, waited_ns in enumerate([0, 0, 200_000_000]):
        Receiver.made.sample = received(50.0 + 0.008 * number)
        now_ns = 10**12 + 8_000_000 * number + waited_ns
        assert reader.read().age_ns == pytest.approx(waited_ns, abs=3_000_000)


def test_refused_timer_slack_does_not_prevent_connecting(arm, monkeypatch, capsys):
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(prctl=lambda *_: -1))
    assert arm.UrArm(SETTINGS).read().connected
    assert "wake more often than needed" in capsys.readouterr().err


@pytest.mark.parametrize(("rate_hz", "command_timeout_s", "slack_ms"), [(125.0, 0.3, 16), (500.0, 0.01, 3)])
def test_timer_slack_is_a_fraction_of_the_watchdog_time(arm, monkeypatch, rate_hz, command_timeout_s, slack_ms):
    asked: list[int] = []

    def prctl(_option: int, slack: ctypes.c_ulong, *_: int) -> int:
        asked.append(slack.value // 1_000_000)
        return 0

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(prctl=prctl))
    bound = ur.WristSpeedBound(0.01, 0.02)
    limits = dataclasses.replace(SETTINGS.limits, wrist_speed_rad_per_s=bound)
    timeouts = {"command_timeout_s": command_timeout_s, "silence_timeout_s": command_timeout_s}
    arm.UrArm(dataclasses.replace(SETTINGS, limits=limits, rate_hz=rate_hz, **timeouts))
    # 0 is the default again, for what this thread starts later.
    assert asked == [slack_ms, 0]


def test_progress_is_queried_only_for_a_linear_move(arm):
    Client.answers["getAsyncOperationProgressEx"] = SimpleNamespace(isAsyncOperationRunning=lambda: True)
    one = arm.UrArm(SETTINGS)
    assert not one.read().moving_linearly
    one.move(MoveLinear(SIX, 0.1, 0.1))
    assert [one.read().moving_linearly for _ in range(3)] == [True] * 3
    Receiver.made.sample = received(2.0)
    one.wrist(WristSpeed(0.1, 1.0), 0.1)
    assert not one.read().moving_linearly
    assert Client.made.calls.count("getAsyncOperationProgressEx") == 3


def test_no_call_blocks_when_no_program_runs(arm):
    """The watchdog has ended the program before it was ready for the next command: a further call would hang."""
    one = arm.UrArm(SETTINGS)
    assert one.zero_wrench()
    assert not one.send_heartbeat()
    assert not one.wrist(WristSpeed(0.1, 1.0), 0.1)
    assert not one.move(MoveLinear(SIX, 0.1, 0.1))
    assert not one.stop_move(1.0)
    assert not one.end_speed(1.0)
    assert not one.zero_wrench()
    assert not one.arm_watchdog()
    one.end_program()
    assert Client.made.calls == ["zeroFtSensor"]


def test_register_is_cleared_once_the_client_knows_that_no_program_runs(arm):
    """Before that, the client would wait for the program."""
    one = arm.UrArm(SETTINGS)
    assert not one.clear_command()
    assert Client.made.calls == ["isProgramRunning"]
    Client.answers["isProgramRunning"] = False
    assert one.clear_command()
    assert Client.made.calls[1:] == ["isProgramRunning", "kickWatchdog"]


def test_sent_script_arms_its_watchdog(arm, monkeypatch):
    sent: list[str] = []
    monkeypatch.setattr(arm.ScriptPort, "send", lambda _, program: sent.append(program))
    for registers, number, flags in ((UPPER, 24, 16 + 8 + 64), (LOWER, 0, 16 + 64)):
        one = arm.UrArm(SETTINGS, registers)
        one.upload()
        armed = f'rtde_set_watchdog("input_int_register_{number}", {SETTINGS.watchdog_hz:g}, "stop")'
        assert armed in sent.pop()
        assert Client.made.arguments[2] == flags


@pytest.mark.parametrize("found", ["1.6.4", "1.7.0"])
def test_another_version_of_the_client_is_refused_by_name(arm, monkeypatch, found):
    """Its commands may have other numbers."""
    monkeypatch.setattr(library, "version", lambda _: found)
    with pytest.raises(RobotLostError, match=rf"is of version {found}, .* ur-rtde==1.6.5") as lost:
        arm.UrArm(SETTINGS)
    assert lost.value.kind == "version"


def test_a_client_without_a_version_is_refused(arm, monkeypatch):
    def missing(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(library, "version", missing)
    with pytest.raises(RobotLostError, match="is of version unknown"):
        arm.UrArm(SETTINGS)


def test_wrench_of_a_cb3_is_zeroed_without_its_controller(arm):
    """`zero_ftsensor` would end its program."""
    limits = dataclasses.replace(SETTINGS.limits, torque_nm=ur.TorqueBound(8.0, 12.0))
    one = arm.UrArm(dataclasses.replace(SETTINGS, limits=limits, generation="cb3"))
    Receiver.made.sample = dataclasses.replace(received(1.0), wrench=(1.0, 2.0, 3.0, 0.0, 0.0, 1.0))
    assert one.zero_wrench()
    Receiver.made.sample = dataclasses.replace(received(1.1), wrench=(1.0, 2.5, 3.0, 0.0, 0.0, 3.0))
    assert one.read().wrench == (0.0, 0.5, 0.0, 0.0, 0.0, 2.0)
    assert "zeroFtSensor" not in Client.made.calls


def test_the_zero_of_a_cb3_is_the_mean_of_its_noisy_samples(arm):
    limits = dataclasses.replace(SETTINGS.limits, torque_nm=ur.TorqueBound(8.0, 12.0))
    one = arm.UrArm(dataclasses.replace(SETTINGS, limits=limits, generation="cb3"))
    noise_nm = np.random.default_rng(0).uniform(-5.0, 5.0, 300)
    for number, each_nm in enumerate(noise_nm):
        Receiver.made.sample = dataclasses.replace(
            received(number / 125), wrench=(0.0, 0.0, 0.0, 0.0, 0.0, 0.3 + each_nm)
        )
        one.read()
    assert one.zero_wrench()
    last = round(0.5 * SETTINGS.rate_hz)
    assert one.wrench_zero[5] == pytest.approx(0.3 + noise_nm[-last:].mean())
    assert abs(one.wrench_zero[5] - 0.3) < 1.5
    # What a motion has measured is no part of the next zero.
    turning = {"wrench": (0.0, 0.0, 0.0, 0.0, 0.0, 6.0), "qd_rad_per_s": (0.0,) * 5 + (0.2,)}
    resting = {"wrench": (0.0, 0.0, 0.0, 0.0, 0.0, 0.4)}
    for number, state in enumerate([turning] * 80 + [resting] * 2):
        Receiver.made.sample = dataclasses.replace(received(3.0 + number / 125), **state)
        one.read()
    assert one.zero_wrench()
    assert one.wrench_zero[5] == pytest.approx(0.4)


def rest(one, at_s: float, wrench: ur.Six, noise_nm: float = 0.0) -> None:
    """Let an arm be read for a second at rest, from a time of its controller on."""
    random = np.random.default_rng(round(at_s))
    for number in range(round(SETTINGS.rate_hz)):
        *rest_of_it, torque_nm = wrench
        torque_nm += random.uniform(-noise_nm, noise_nm)
        Receiver.made.sample = dataclasses.replace(received(at_s + number / 125), wrench=(*rest_of_it, torque_nm))
        one.read()


def start_program(one, at_s: float, wrench: ur.Six, noise_nm: float = 0.0) -> None:
    """Let the program that was sent answer, and be read for a second."""
    Receiver.made.sample = dataclasses.replace(received(at_s), wrench=wrench)
    one.script_readiness.waiting = False
    one.arm_watchdog()
    rest(one, at_s, wrench, noise_nm)
    one.script_readiness.waiting = False
    assert one.arm_watchdog()


def test_a_load_is_known_after_a_second_of_samples(arm):
    one = arm.UrArm(SETTINGS)
    assert one.knows_load(held=False)
    assert not one.knows_load(held=True)
    rest(one, 1.0, SIX)
    assert one.knows_load(held=True)
    one.measure_load_anew()
    assert not one.knows_load(held=True)


@pytest.mark.parametrize("held", [True, False])
def test_the_kept_zero_is_known_to_less_than_the_noise_of_one_sample(arm, monkeypatch, held):
    """One sample before the program's start and one after it put it off by up to twice the noise."""
    monkeypatch.setattr(arm.ScriptPort, "send", lambda *_: None)
    one = arm.UrArm(SETTINGS)
    rest(one, 1.0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.3), noise_nm=0.2)
    one.upload(held=held)
    Receiver.made.sample = received(2.0)
    assert one.arm_watchdog() is not held, "with a load it waits for a second of samples"
    assert one.read().wrench[5] == pytest.approx(0.3 if held else 0.0, abs=0.05), "no state is without the load"
    start_program(one, 2.1, SIX, noise_nm=0.2)
    assert -one.wrench_zero[5] == pytest.approx(0.3 if held else 0.0, abs=0.03)


def test_the_wait_for_the_load_of_a_new_program_takes_one_command_and_then_heartbeats(arm, monkeypatch):
    """Each command that is carried out once takes several cycles, and the wait is a second of cycles."""
    monkeypatch.setattr(arm.ScriptPort, "send", lambda *_: None)
    one = arm.UrArm(SETTINGS)
    one.upload(held=True)
    Client.made.calls.clear()
    for number in range(round(SETTINGS.rate_hz)):
        Receiver.made.sample = received(2.0 + number / 125)
        assert not one.arm_watchdog()
        one.read()
    one.script_readiness.waiting = False
    assert one.arm_watchdog()
    sent = [name for name in Client.made.calls if name != "isConnected"]
    assert sent == ["setWatchdog"] + ["kickWatchdog"] * round(SETTINGS.rate_hz)


def test_a_program_that_plays_after_ours_has_to_answer_too(arm, monkeypatch):
    """It can be another daemon's, and ur-rtde sends it a heartbeat in any case."""
    monkeypatch.setattr(arm.ScriptPort, "send", lambda *_: None)
    one = arm.UrArm(SETTINGS)
    one.upload(held=True)
    Receiver.made.sample = received(2.0)
    one.read()
    assert not one.arm_watchdog(), "it answers, and its zero is measured first"
    Receiver.made.sample = received(2.1, runtime_state=1)
    one.read()
    rest(one, 3.0, SIX)
    Client.made.calls.clear()
    one.script_readiness.waiting = False
    assert not one.arm_watchdog()
    assert Client.made.calls == ["setWatchdog"]


def test_a_sample_that_is_read_twice_is_measured_once(arm):
    """Each command reads the latest sample again: half a second of samples would pass for a second."""
    one = arm.UrArm(SETTINGS)
    for number in range(round(SETTINGS.rate_hz) - 1):
        Receiver.made.sample = received(1.0 + number / 125)
        one.read()
        one.read()
    assert not one.knows_load(held=True)
    Receiver.made.sample = received(3.0)
    one.read()
    assert one.knows_load(held=True)


@pytest.mark.parametrize("held", [True, False])
def test_wrench_of_what_is_held_outlives_the_zero_of_a_new_program(arm, monkeypatch, held):
    """An e-Series zeroes its wrench as a program starts."""
    sent: list[str] = []
    monkeypatch.setattr(arm.ScriptPort, "send", lambda _, program: sent.append(program))
    one = arm.UrArm(SETTINGS)
    load = (1.0, 0.0, 3.0, 0.0, 0.0, 1.5)
    Receiver.made.sample = dataclasses.replace(received(1.0), wrench=load)
    one.upload(held=held)
    assert ("global keeps_load = True\n  global load_before = [1.000000, 0.000000, 3.000000, " in sent[0]) == held
    start_program(one, 2.0, SIX)
    assert one.read().wrench == (load if held else SIX)
    # The next worker goes on with this zero, and a new one ends it.
    another = arm.UrArm(SETTINGS)
    another.wrench_zero = one.wrench_zero
    Receiver.made.sample = dataclasses.replace(received(3.0), wrench=SIX)
    assert another.read().wrench == (load if held else SIX)
    another.script_readiness.waiting = False
    assert another.zero_wrench()
    assert another.read().wrench == SIX


def test_a_program_that_is_sent_again_keeps_the_wrench_from_before_the_first(arm, monkeypatch):
    """The controller may start the first one late, or end it before it answers."""
    monkeypatch.setattr(arm.ScriptPort, "send", lambda *_: None)
    one = arm.UrArm(SETTINGS)
    load = (1.0, 0.0, 3.0, 0.0, 0.0, 1.5)
    Receiver.made.sample = dataclasses.replace(received(1.0), wrench=load)
    one.upload(held=True)
    # It has started, and has zeroed the wrench.
    Receiver.made.sample = dataclasses.replace(received(3.0), wrench=SIX)
    one.upload(held=True)
    start_program(one, 3.1, SIX)
    assert one.read().wrench == load
    # A program that never answers, and another tool: the load of before is over.
    Receiver.made.sample = dataclasses.replace(received(5.0), wrench=SIX)
    one.upload(held=True)
    one.forget_load()
    Receiver.made.sample = dataclasses.replace(received(6.0), wrench=(0.0, 0.0, 0.0, 0.0, 0.0, 0.5))
    before = one.read().wrench
    one.upload(held=True)
    start_program(one, 7.0, SIX)
    assert one.read().wrench == before
    one.wrench_zero = (-1.0, 0.0, -3.0, 0.0, 0.0, -1.5)
    # Another program, later, begins with the load of its own time.
    rest(one, 9.0, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    one.upload(held=True)
    start_program(one, 10.0, SIX)
    assert one.read().wrench == (2.0, 0.0, 3.0, 0.0, 0.0, 1.5)


def test_deadline_counts_from_the_latest_sample(arm):
    one = arm.UrArm(SETTINGS)
    Receiver.made.sample = received(1.0, script_ticks=10_000)
    assert one.wrist(WristSpeed(0.1, 1.0), 0.07)
    one.withdraw_deadline()
    assert Receiver.made.deadlines == [10_035, NO_MOTION_TICKS]


def test_script_port_is_read_until_the_program_plays(arm, monkeypatch):
    calls: list[str] = []
    for name in ("send", "drain", "close"):
        monkeypatch.setattr(arm.ScriptPort, name, lambda *_, name=name: calls.append(name))
    one = arm.UrArm(SETTINGS)
    one.upload()
    one.read()
    Receiver.made.sample = received(2.0, runtime_state=2)
    one.read()
    assert calls == ["send", "drain", "drain", "close"]
