"""The program for the robot: its structure, what it answers, and how it stops.

No interpreter of URScript is at hand here, so that the text is checked as strictly as text can be. The emulated
controller checks names and arguments when it starts a program (`emulators/urscript_names.py`).
"""

import ast
import asyncio
import dataclasses
import itertools
import math
import re
import sys
from collections import Counter
from pathlib import Path

import pytest

from shearloop.drivers.ur import script, settings
from shearloop.drivers.ur.script import LOWER, UPPER, control_program
from shearloop.emulators.ur_robot import ControllerSpec, Robot
from tests.drivers.ur import robots
from tests.drivers.ur.robots import DELIVERED, ROOT, control_script, do, moving_asynchronously, send

TEXT = Path(script.__file__).with_name("control.script").read_text(encoding="ascii")
CODE = re.sub(r"#.*", "", TEXT)
CB3_LIMITS = dataclasses.replace(
    DELIVERED.limits, force_n=settings.ForceBound(40.0, 60.0), torque_nm=settings.TorqueBound(8.0, 12.0)
)
CB3 = dataclasses.replace(DELIVERED, limits=CB3_LIMITS, generation="cb3")
# The numbers that ur-rtde 1.6.5 writes for the calls of `drivers/ur/arm.py` (include/ur_rtde/rtde.h); a client that
# kicks the watchdog writes 0.
NUMBERS = {
    "kickWatchdog": 0,
    "moveL": robots.MOVE_L,
    "zeroFtSensor": robots.ZERO_FT,
    "speedJ": robots.SPEED_J,
    "speedStop": robots.SPEED_STOP,
    "stopJ": robots.STOP_J,
    "setWatchdog": robots.SET_WATCHDOG,
    "stopScript": 255,
}
# Calls that write no command.
READS = {"isConnected", "isProgramRunning", "getAsyncOperationProgressEx"}
UNKNOWN = sorted({*range(1, 100), 254, 256, -1} - set(NUMBERS.values()))
# Uploads the script, and is gone before the watchdog is armed by a command.
DIES_TOO_SOON = """
import os, sys
from shearloop.drivers.ur.arm import UrArm
from tests.drivers.ur.robots import settings_for
arm = UrArm(settings_for(sys.argv[1]))
while not arm.clear_command():
    pass
arm.upload()
os._exit(0)
"""


def functions_of(program: str) -> dict[str, str]:
    """Return the text of each function and thread of a program, by name, in their order."""
    found = re.findall(r"^  (?:def|thread) (\w+)\(.*?\):\n(.*?)^  end\n", program, re.MULTILINE | re.DOTALL)
    return dict(found)


def names_in(code: str) -> set[str]:
    """Return the words of a text outside its strings."""
    return set(re.findall(r"[A-Za-z_]\w*", re.sub(r'"[^"\n]*"', "", code)))


# --- structure ---


@pytest.mark.parametrize("rig", [DELIVERED, CB3], ids=["e-series", "cb3"])
def test_each_block_has_its_end_at_its_own_depth(rig):
    open_blocks: list[str] = []
    for line in control_program(rig).splitlines():
        code = line.partition("#")[0].rstrip()
        if not code:
            continue
        word = code.split()[0].rstrip(":")
        if word in {"end", "elif", "else"}:
            opener = open_blocks.pop()
            assert word == "end" or opener in {"if", "elif"}, line
        assert len(code) - len(code.lstrip()) == 2 * len(open_blocks), line
        assert code.endswith(":") == (word in {"def", "thread", "while", "if", "elif", "else"}), line
        if code.endswith(":"):
            open_blocks.append(word)
    assert not open_blocks


def test_text_is_plain():
    """No sign that is not ASCII, no tab, no place for a value that was not filled in, no line that is too long."""
    program = control_program(DELIVERED)
    assert program.isascii()
    assert not re.search(r"[{}\t%$]", re.sub(r'"[^"\n]*"|#.*', "", program))
    assert max(map(len, TEXT.splitlines())) <= 120
    assert program.endswith("\nend\n")
    # A controller takes the first end in the first column for the program's.
    assert program.count("\nend\n") == 1


def test_every_setting_and_every_variable_is_used():
    program = re.sub(r"#.*", "", control_program(DELIVERED))
    declared = Counter(re.findall(r"^  global (\w+) =", program, re.MULTILINE))
    assert set(declared.values()) == {1}
    uses = Counter(re.findall(r"\b\w+\b", re.sub(r'"[^"\n]*"', "", program)))
    assert [name for name in declared if uses[name] < 2] == []
    # Names that functions have for themselves are not those of global variables.
    parameters = {name for inside in re.findall(r"(?:def|thread) \w+\((.*?)\)", CODE) for name in names_in(inside)}
    assert not parameters & declared.keys()


def test_functions_come_before_their_calls():
    functions = functions_of(CODE)
    assert len(functions) == len(re.findall(r"^ *(?:def|thread) ", CODE, re.MULTILINE))
    known: set[str] = set()
    for name, body in functions.items():
        assert names_in(body) & functions.keys() <= known, name
        known.add(name)
    main = CODE[CODE.index("\n  if keeps_load:") :]
    assert functions.keys() <= {name for body in (*functions.values(), main) for name in names_in(body)}


def test_each_register_is_accessed_in_one_place():
    accesses = Counter(re.findall(r"(?:read|write)_(?:in|out)put_\w+_register\(first[^,)]*", CODE))
    assert set(accesses.values()) == {1}
    assert len(re.findall(r"_register\(", CODE)) == sum(accesses.values())
    types = {"integer": "int", "float": "double"}
    places = {
        f"{way}put_{types[kind]}_register_{UPPER.first + int(offset or 0)}"
        for way, kind, offset in re.findall(r"(?:read|write)_(in|out)put_(\w+)_register\(first(?: \+ (\d+))?[,)]", CODE)
    }
    ours = {UPPER.command, UPPER.state, UPPER.deadline, UPPER.clock, UPPER.step}
    assert places == ours | {"input_int_register_25", "output_int_register_26"}


def test_critical_sections_end_and_take_no_time():
    for body in functions_of(CODE).values():
        sections = re.findall(r"enter_critical\n(.*?)exit_critical\n", body, re.DOTALL)
        assert len(sections) == body.count("enter_critical") == body.count("exit_critical")
        for section in sections:
            lasting = {"sync", "speedj", "movel", "stopj", "stopl", "halt", "while", "stop_arm", "stop_and_halt"}
            assert not names_in(section) & lasting


def test_halt_comes_after_the_motion_thread_has_ended_and_the_arm_has_stopped():
    functions = functions_of(CODE)
    (place,) = (name for name, body in functions.items() if "halt" in body.split())
    order = [re.split(r"\W", line.strip())[0] for line in functions[place].splitlines()]
    steps = ["textmsg", "end_motion_thread", "stopj", "halt"]
    assert [word for word in order if word in steps] == steps


@pytest.mark.parametrize(
    ("registers", "rig"), [(UPPER, DELIVERED), (LOWER, DELIVERED), (UPPER, CB3)], ids=["upper", "lower", "cb3"]
)
def test_the_watchdog_is_armed_by_the_first_statement(registers, rig):
    armed = f'rtde_set_watchdog("{registers.command}", {rig.watchdog_hz:g}, "stop")'
    program = control_program(rig, registers)
    assert program.splitlines()[1].strip() == armed
    assert program.count("rtde_set_watchdog(") == 1


def test_functions_of_the_e_series_are_not_in_a_program_for_a_cb3():
    text = control_program(CB3)
    assert "zero_ftsensor" not in text
    assert "get_steptime" not in text
    assert "zero_ftsensor()" in control_program(DELIVERED)
    assert "get_steptime()" in control_program(DELIVERED)


def test_every_call_of_the_client_has_its_number_in_the_script():
    """Whoever calls another one of ur-rtde's functions is reminded of the script."""
    tree = ast.parse((ROOT / "drivers" / "ur" / "arm.py").read_text(encoding="utf-8"))
    calls = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "_control"
    }
    assert calls == NUMBERS.keys() | READS
    assert sorted(map(int, re.findall(r"global command_\w+ = (\d+)", CODE))) == sorted(NUMBERS.values())


@pytest.mark.parametrize("rig", [DELIVERED, CB3], ids=["e-series", "cb3"])
def test_every_literal_has_the_type_of_its_variable(rig):
    """A whole number of the settings is no integer on the robot."""
    whole = dataclasses.replace(
        rig.limits,
        wrist_acceleration_rad_per_s2=settings.WristAccelerationBound(4, 8),
        force_n=settings.ForceBound(40, 60),
    )
    program = control_program(dataclasses.replace(rig, limits=whole, command_timeout_s=1), load=(1, 2, 3, 0, 0, 0))
    head = program[: program.index("global cycle_s")]
    kinds = {
        name: re.sub(r"-?\d+\.\d{6}", "float", value)
        for name, value in re.findall(r"^  global (\w+) = (.+)$", head, re.MULTILINE)
    }
    assert kinds.pop("first") == "24"
    assert kinds.pop("keeps_load") == "True"
    assert kinds.pop("load_before") == f"[{', '.join(['float'] * 6)}]"
    assert set(kinds.values()) == {"float"}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_no_program_is_made_of_what_is_no_number(value):
    with pytest.raises(ValueError, match="no number"):
        control_program(DELIVERED, load=(0.0, 0.0, value, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("part", ["_HEAD", "_ZEROES", "_CANNOT_ZERO"])
def test_the_hash_of_a_report_changes_with_every_statement_around_the_script(monkeypatch, part):
    before = script.own_script_hash()
    monkeypatch.setattr(script, part, getattr(script, part) + "  sync()\n")
    assert script.own_script_hash() != before


def test_the_hash_of_a_report_has_the_names_of_a_rigs_values_and_not_the_values(monkeypatch):
    hashes = []
    for names, value in (("ab", 1.0), ("ab", 2.0), ("ac", 1.0)):
        values = {name: lambda _, value=value: value for name in names}
        monkeypatch.setattr(script, "_FROM_SETTINGS", values)
        hashes.append(script.own_script_hash())
    assert hashes[0] == hashes[1] != hashes[2]


def test_the_hash_of_a_report_changes_with_the_script(monkeypatch, tmp_path):
    before = script.own_script_hash()
    changed = tmp_path / "control.script"
    changed.write_text(f"{TEXT}  # changed\n")
    monkeypatch.setattr(script, "_CONTROL_SCRIPT", changed)
    assert script.own_script_hash() != before


# --- answers ---


def playing(text: str, spec: ControllerSpec | None = None) -> Robot:
    """Return a robot that plays a program and has taken no command yet."""
    robot = Robot(spec)
    send(robot, 0)
    robot.upload(text)
    for _ in range(5):
        robot.step(robots.STEP_S)
    assert robot.program_running, robot.events
    robot.take_events()
    return robot


def extend(robot: Robot, seconds: float) -> None:
    until = robot.registers[UPPER.clock] + int(seconds / robots.STEP_S)
    robot.registers.write(UPPER.deadline, until, robot.time_s)


def trace(robot: Robot, written: list[int], numbers: tuple[float, ...], seconds: float) -> list[tuple[int, bool]]:
    """Write commands one after the other, and return the successive states and whether a motion is reported."""
    found: list[tuple[int, bool]] = []
    for command in written:
        for cycle in range(round(seconds / robots.STEP_S)):
            if cycle % 4 == 0:
                extend(robot, 0.1)
                send(robot, command, *numbers, asynchronous=True)
            robot.step(robots.STEP_S)
            state = max(int(robot.registers[half.state]) for half in (LOWER, UPPER))
            now = state, moving_asynchronously(robot)
            found += [now] if not found or found[-1] != now else []
    return found


def line(robot: Robot, length_m: float, speed: float, acceleration: float) -> tuple[float, ...]:
    x, y, z, *turned = robot.arm.pose
    return (x, y, z - length_m, *turned, speed, acceleration)


@pytest.mark.parametrize("call", [name for name in NUMBERS if name not in {"stopScript", "kickWatchdog"}])
def test_the_client_sees_what_it_sees_of_its_own_script(call):
    """The states, and the report of a motion, while a command is written and after it was cleared.

    ur-rtde's script reports a motion one cycle after its command, and none in the cycle between a move and its stop.
    """
    found = []
    for rig in (DELIVERED, None):
        robot = playing(control_script(rig))
        numbers = {
            "moveL": line(robot, 0.01, 0.05, 0.5),
            "speedJ": (0, 0, 0, 0, 0, 0.2, 4.0, 0),
            "setWatchdog": (DELIVERED.watchdog_hz,),
        }.get(call, (2.0,))
        if call == "stopJ":
            trace(robot, [robots.MOVE_L, 0], line(robot, 0.2, 0.05, 0.5), 0.1)
        found.append(trace(robot, [0, NUMBERS[call], 0], numbers, 0.5))
    ours, own = found
    assert successive(ours, 0) == successive(own, 0)
    assert successive(ours, 1) == {"moveL": [False, True, False], "stopJ": [True, False]}.get(call, [False])
    assert successive(own, 1)[-2:] == successive(ours, 1)[-2:]


def successive(found: list[tuple[int, bool]], column: int) -> list[int]:
    """Return one column of a trace without repetitions."""
    return [value for value, _ in itertools.groupby(entry[column] for entry in found)]


def test_a_command_is_carried_out_once_until_the_client_clears_it():
    robot = playing(control_script(DELIVERED))
    robot.arm.load[5] = 1.0
    trace(robot, [robots.ZERO_FT, robots.ZERO_FT, 0, robots.ZERO_FT], (), 0.05)
    assert [event.name for event in robot.take_events()].count("wrench-zeroed") == 2


def test_the_end_that_the_client_asks_for_is_an_end_of_the_program():
    robot = playing(control_script(DELIVERED))
    send(robot, 255)
    robot.step(robots.STEP_S)
    robot.step(robots.STEP_S)
    assert [(event.name, event.detail) for event in robot.take_events()][-1] == (
        "program-ended",
        "it has run to its end",
    )


def turning(spec: ControllerSpec | None = None) -> Robot:
    """Return a robot whose wrist turns."""
    robot = playing(control_script(DELIVERED), spec)
    trace(robot, [robots.SPEED_J], (0, 0, 0, 0, 0, 0.5, 4.0, 0), 0.3)
    assert robot.arm.qd_rad_per_s[5] == pytest.approx(0.5)
    robot.take_events()
    return robot


def run_out(robot: Robot, seconds: float = 0.2) -> list[str]:
    """Extend the deadline and let time pass; return the robot's events."""
    for _ in range(round(seconds / robots.STEP_S)):
        extend(robot, 0.1)
        robot.step(robots.STEP_S)
    return [event.name for event in robot.take_events()]


@pytest.mark.parametrize("command", UNKNOWN)
def test_an_unknown_command_stops_the_arm_and_ends_the_program(command):
    robot = turning()
    robot.protects_abrupt_ends = True
    send(robot, command)
    assert run_out(robot) == ["motion-stopped", "program-ended"]
    refused, reason = [*robot.log][-2:]
    assert refused == f"shearloop: refused command {command}"
    assert "does not carry out this command" in reason


@pytest.mark.parametrize(
    ("command", "numbers", "asynchronous"),
    [
        # It waits for its end; it has no speed.
        (robots.MOVE_L, (0.1, 0.2, 0.3, 0, 3.1, 0, 0.05, 0.5), False),
        (robots.MOVE_L, (0.1, 0.2, 0.3, 0, 3.1, 0, 0.0, 0.5), True),
        (robots.STOP_J, (4.0,), False),
    ],
)
def test_a_command_in_a_form_that_the_driver_never_sends_is_refused(command, numbers, asynchronous):
    robot = turning()
    send(robot, command, *numbers, asynchronous=asynchronous)
    assert run_out(robot) == ["motion-stopped", "program-ended"]


def test_a_cb3_refuses_to_zero_its_wrench():
    robot = playing(control_script(CB3), ControllerSpec(version=(3, 15, 8, 0)))
    send(robot, robots.ZERO_FT)
    assert run_out(robot) == ["program-ended"]
    assert robot.log[0] == f"shearloop: refused command {robots.ZERO_FT}"


def test_a_straight_move_has_the_limits_of_the_settings():
    robot = playing(control_script(DELIVERED))
    do(robot, robots.MOVE_L, *line(robot, 0.2, 3.0, 100.0), asynchronous=True)
    speeds = []
    for _ in range(250):
        extend(robot, 0.1)
        send(robot, 0)
        robot.step(robots.STEP_S)
        speeds.append(float(robot.arm.speed[2]))
    limits = DELIVERED.limits
    assert -min(speeds) == pytest.approx(limits.linear_speed_m_per_s.inner, rel=0.01)
    steps = [abs(later - earlier) / robots.STEP_S for earlier, later in itertools.pairwise(speeds)]
    assert max(steps) <= 1.05 * limits.linear_acceleration_m_per_s2.inner


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("turn", "line"),
        ("line", "turn"),
        ("line", "line"),
        ("brake", "line"),
        ("brake", "turn"),
        ("brake", "brake"),
        ("turn", "brake"),
        ("line", "end"),
    ],
)
def test_another_motion_ends_the_one_before(first, second):
    """The driver ends each motion itself; two threads that move the arm would end the program."""
    robot = playing(control_script(DELIVERED))

    def ask(motion: str) -> None:
        commands = {
            "turn": (robots.SPEED_J, (0, 0, 0, 0, 0, 0.3, 4.0, 0)),
            "line": (robots.MOVE_L, line(robot, 0.1, 0.05, 0.5)),
            "brake": (robots.STOP_J, (1.0,)),
            "end": (robots.SPEED_STOP, (2.0,)),
        }
        command, numbers = commands[motion]
        trace(robot, [command], numbers, 0.1)

    if first == "brake":
        ask("line")
    ask(first)
    trace(robot, [0], (), 0.01)
    ask(second)
    assert robot.program_running, robot.events
    trace(robot, [0], (), 0.3)
    assert robot.program_running, robot.events
    assert robot.arm.moving == (second in {"turn", "line"})
    assert robot.arm.qd_rad_per_s[5] == pytest.approx(0.3 if second == "turn" else 0.0, abs=0.01)


@pytest.mark.real_time
async def test_program_of_a_worker_killed_before_arming_ends(controller):
    """Nothing moves: the register was cleared before."""
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DIES_TOO_SOON, controller.host, cwd=ROOT, stdout=asyncio.subprocess.DEVNULL
    )
    assert await process.wait() == 0
    started = await controller.event("program-started", 0)
    ended = await controller.event("program-ended", started["t_mono_ns"])
    assert "watchdog" in ended["detail"]
    assert not controller.happened("motion-started", 0)
