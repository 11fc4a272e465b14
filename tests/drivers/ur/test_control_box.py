"""Closed ports, the dashboard's own words, and the names of modes."""

import asyncio
import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.control_box import check_generation, check_ports, probe_controller, query_controller
from shearloop.drivers.ur.dashboard import REMOTE_CURE, command_dashboard, serial_number_in
from shearloop.drivers.ur.fitness import why_unfit
from shearloop.drivers.ur.messages import ROBOT_MODES, RUNTIME_STATES, SAFETY_MODES, RobotLostError, Unlock
from shearloop.drivers.ur.ports import SERVICES, closed_ports_sentence, explain_failure, probe_ports
from shearloop.drivers.ur.rtde import registers_in_use
from shearloop.drivers.ur.settings import TorqueBound, UrSettings
from shearloop.emulators.ur_controller import Controller
from shearloop.emulators.ur_robot import Robot
from tests.drivers.ur.handler_bench import AT_REST, LIMITS, SETTINGS, enabled
from tests.emulator_process import own_address

HOST = own_address(7)
TIMEOUT_S = 2.0
MENU = "Settings → Security → Services"


@asynccontextmanager
async def serving(robot: Robot | None = None, closed_ports: tuple[int, ...] = ()) -> AsyncIterator[Controller]:
    """Serve a robot, and close its ports only when no connection is being accepted any more."""
    controller = Controller(robot or Robot(), host=HOST, closed_ports=closed_ports)
    async with controller.open():
        yield controller
        await asyncio.sleep(0)
        while left := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(left)


@pytest.mark.parametrize("port", list(SERVICES))
@pytest.mark.parametrize("version", [(5, 12, 0, 0), (5, 4, 0, 0), (3, 15, 0, 0)])
async def test_a_closed_port_is_named_with_the_menu_that_opens_it(port, version):
    robot = Robot()
    robot.change(replace(robot.spec, version=version))
    async with serving(robot, closed_ports=(port,)):
        found = await asyncio.to_thread(probe_ports, HOST, TIMEOUT_S)
        with pytest.raises(RobotLostError) as refused:
            await asyncio.to_thread(check_ports, HOST, TIMEOUT_S)
    assert {one for one, reason in found.items() if reason} == {port}
    assert found[port] == "Connection refused"
    said = str(refused.value)
    assert f"does not serve port {port} ({SERVICES[port]})" in said
    assert (f"enable {SERVICES[port]} under {MENU}" in said) == (version >= (5, 10))
    assert ("has no menu for them" in said) == (version < (5, 10))
    assert ("a CB3" in said) == (version[0] == 3)
    assert "; " in said, "a cure of its own"


async def test_every_way_to_a_closed_port_names_it():
    async with serving(closed_ports=(29999,)):
        for ask in (query_controller, lambda *args: command_dashboard(*args, ("power on",))):
            with pytest.raises(RobotLostError, match=rf"29999 \(Dashboard Server\).*{MENU}"):
                await asyncio.to_thread(ask, HOST, TIMEOUT_S)
    async with serving(closed_ports=(30004,)):
        with pytest.raises(RobotLostError, match=rf"30004 \(RTDE\).*{MENU}"):
            await asyncio.to_thread(probe_controller, HOST, TIMEOUT_S)


async def test_a_controller_that_serves_all_or_none_of_its_ports():
    async with serving():
        await asyncio.to_thread(check_ports, HOST, TIMEOUT_S)
    await asyncio.to_thread(check_ports, HOST, TIMEOUT_S)
    with pytest.raises(RobotLostError, match=f"switched on.*{MENU}"):
        await asyncio.to_thread(probe_controller, HOST, TIMEOUT_S)


async def test_a_controller_without_a_dashboard_that_cannot_be_driven_is_named_by_its_version():
    """PolyScope X has no such port, and no menu for it."""
    async with serving(closed_ports=(29999,)) as controller:
        controller.command("version 10.11.0.0")
        with pytest.raises(RobotLostError, match=r"has PolyScope 10\.11\.0\.0, which cannot be driven"):
            await asyncio.to_thread(check_ports, HOST, TIMEOUT_S)


@pytest.mark.parametrize(
    ("generation", "version", "cure"),
    [("e-series", "3.15.8.0", "generation: cb3"), ("cb3", "5.17.3.0", "generation: e-series")],
)
def test_controller_of_the_other_generation_is_named(generation, version, cure):
    limits = replace(LIMITS, torque_nm=TorqueBound(8.0, 12.0))
    with pytest.raises(RobotLostError, match=f"PolyScope {version}.*{cure}") as lost:
        check_generation(UrSettings("10.0.0.1", limits, generation=generation), version)
    assert lost.value.kind == "version"
    own = "3.15.8.0" if generation == "cb3" else "5.17.3.0"
    check_generation(UrSettings("10.0.0.1", limits, generation=generation), own)


def test_several_closed_ports_are_named_in_one_sentence():
    said = closed_ports_sentence("arm", [30004, 29999], ())
    assert "30004 (RTDE) and 29999 (Dashboard Server)" in said
    assert f"enable RTDE and Dashboard Server under {MENU}" in said
    assert "CB3" in said


@pytest.mark.parametrize("request_", ["power on", "brake release", "unlock protective stop", "stop", "close popup"])
async def test_a_request_in_local_control_is_refused_with_the_controllers_own_words(request_):
    async with serving() as controller:
        controller.command("local-control")
        with pytest.raises(DriverError) as refused:
            await asyncio.to_thread(command_dashboard, HOST, TIMEOUT_S, (request_,))
    assert "in local control: switch it to remote control" in str(refused.value)
    assert "Settings → System → Remote Control" in str(refused.value)
    assert "please switch robot to Remote Control mode" in str(refused.value)
    assert f"`{request_}`" in str(refused.value)


async def test_a_dashboard_request_returns_nothing_if_done_and_raises_the_refusal():
    robot = Robot()
    async with serving(robot):
        for requests in (("close popup", "close safety popup"), ("stop",), ("power on",), ("brake release",)):
            assert await asyncio.to_thread(command_dashboard, HOST, TIMEOUT_S, requests) == ""
        robot.protective_stop("a test")
        with pytest.raises(DriverError, match="“Cannot unlock protective stop until 5s") as refused:
            await asyncio.to_thread(command_dashboard, HOST, TIMEOUT_S, ("unlock protective stop",))
    assert "local control" not in str(refused.value)


def test_a_refused_request_ends_the_recovery_at_once_with_its_words():
    bench = enabled()
    bench.arm.be(robot_mode=3, runtime_state=1)
    bench.arm.refuses["power on"] = "The controller answered “not now” to `power on`: look at the teach pendant."
    since_ns = bench.now_ns
    assert bench.ask(Unlock()).refusal == bench.arm.refuses["power on"]
    assert bench.now_ns - since_ns < 1e9


def test_a_recovery_that_times_out_names_the_modes_and_quotes_the_last_refusal(monkeypatch):
    bench = enabled()
    bench.arm.be(robot_mode=3, runtime_state=4)
    bench.arm.ignores["close popup"] = "The controller answered “no popup” to `close popup`"
    monkeypatch.setattr(bench.arm, "ask_dashboard", lambda *requests: bench.arm.ignores.get(requests[0], ""))
    refusal = bench.ask(Unlock()).refusal
    assert "robot mode: power off, safety mode: normal, program: paused" in refusal
    assert "“no popup” to `close popup`" in refusal


@pytest.mark.parametrize("mode", [*range(1, 14), -1, 99])
def test_every_safety_mode_has_its_words(mode):
    sample = replace(AT_REST, safety_mode=mode)
    why = why_unfit(sample, SETTINGS)
    assert (why == "") == (mode in (1, 2))
    if mode in SAFETY_MODES:
        assert not re.search(r"\d+\.|mode \d", why)
        assert sample.safety_mode_name == SAFETY_MODES[mode]
    else:
        assert f"unknown mode {mode}" in why


@pytest.mark.parametrize("mode", [*range(-1, 9), 99])
def test_every_robot_mode_has_its_words(mode):
    sample = replace(AT_REST, robot_mode=mode)
    assert ROBOT_MODES.get(mode, f"unknown mode {mode}") == sample.robot_mode_name
    assert (sample.robot_mode_name in why_unfit(sample, SETTINGS)) == (mode != 7)


def test_the_tables_are_complete_and_the_page_has_the_same_words():
    assert (set(ROBOT_MODES), set(SAFETY_MODES)) == ({*range(-1, 9)}, {*range(1, 14)})
    assert set(RUNTIME_STATES) == {*range(6)}
    text = (Path(__file__).parents[3] / "daemon/web/assets/panels.js").read_text()
    for name, expected in (("ROBOT_MODES", ROBOT_MODES), ("SAFETY_MODES", SAFETY_MODES)):
        (table,) = re.findall(rf"const {name} = ({{.*?}});", text)
        shown = json.loads(re.sub(r"(?<=[{ ])(\d+):", r'"\1":', table))
        assert {int(mode): words for mode, words in shown.items()} == expected


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        ("20195500123", "20195500123"),
        ("0" * 16, "EMULATED"),
        ("00000000000", "00000000000"),
        ("EMULATED", ""),
        ("could not understand: 'get serial number'", ""),
    ],
)
def test_only_the_emulated_controllers_own_answer_makes_it_an_emulated_one(answer, found):
    assert serial_number_in(answer) == found


def test_a_menu_is_named_as_both_generations_have_it():
    """A controller that does not answer says no version, and the menus of a CB3 differ."""
    with pytest.raises(RobotLostError, match="on a CB3 Setup Robot → Network"), explain_failure("10.0.0.1", 1.0, "it"):
        raise ConnectionRefusedError
    assert "(Installation → Fieldbus, on a CB3 under Installation)" in str(registers_in_use("10.0.0.1"))
    assert "a CB3 has no such mode" in REMOTE_CURE


def test_no_sentence_names_a_menu_of_one_generation_alone():
    """Each menu is a constant, whose name every sentence has."""
    rooms = ("drivers", "tools", "daemon", "cli")
    texts = {path: path.read_text(encoding="utf-8") for room in rooms for path in sorted(Path(room).rglob("*.py"))}
    named = {path.as_posix() for path, text in texts.items() if re.search(r"(Settings|Installation) → ", text)}
    # The URCap is for an e-Series from 5.17 on alone, as its sentence says.
    assert named == {"drivers/ur/ports.py", "drivers/ur/dashboard.py", "drivers/robotiq/socket_client.py"}
