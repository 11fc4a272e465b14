"""What `shearloop run` loads of the package, and what the benchmark counts."""

from types import CodeType

import pytest

from benchmarks.call_counts import counts, loaded_by_run
from benchmarks.call_trace import Trace, WayTrace, functions_of
from shearloop import units

# Of the package, in all modules that `shearloop run` loads: for sensors alone, and with a robot.
MAX_LINES, MAX_LINES_WITH_ROBOT = 15_000, 22_800
NOT_ON_THE_ROBOTS_PC = ("emulators", "tools", "studies")


def test_the_daemon_loads_nothing_but_what_runs_on_the_robots_pc():
    loaded = loaded_by_run(robot=True)
    strangers = [name for name in loaded.modules if name.split(".")[1:2] and name.split(".")[1] in NOT_ON_THE_ROBOTS_PC]
    assert strangers == []
    assert "shearloop.daemon.control.control_loop" in loaded.modules
    assert loaded.lines > 1000
    assert loaded.lines <= MAX_LINES_WITH_ROBOT
    assert [name for name in loaded.modules if "skin" in name] == [], "only a rig with a skin loads its modules"
    assert "shearloop.daemon.commissioning_report" not in loaded.modules, "only a configured report is read"
    unneeded = [f"shearloop.daemon.{name}" for name in ("recorder", "sensing.snapshots", "sensing.session_inputs")]
    assert set(unneeded).isdisjoint(loaded.modules), "without a recording nothing of the recorder's is loaded"
    assert "shearloop.drivers.ur.receiver" not in loaded.modules, "the worker talks to the control box"
    of_mistakes = ("shearloop.mistakes", "shearloop.units", "shearloop.yaml_mistakes")
    assert not set(of_mistakes) & set(loaded.modules), "only a mistake in a file needs them"


def test_sensors_alone_load_neither_control_loop_nor_drivers_of_robot_and_gripper():
    loaded = loaded_by_run(robot=False)
    # The summary of a run knows the faults, and the configuration the grippers' models.
    known = ["daemon.control", "daemon.control.faults", "drivers.robotiq", "drivers.robotiq.models"]
    robots = ("shearloop.daemon.control", "shearloop.drivers.ur", "shearloop.drivers.robotiq")
    assert [name.removeprefix("shearloop.") for name in loaded.modules if name.startswith(robots)] == known
    assert loaded.lines <= MAX_LINES


@pytest.fixture
def installed():
    """Install one trace at a time."""
    traces = []

    def install(trace):
        traces.append(trace)
        trace.recording = True
        trace.install()
        return trace

    yield install
    for trace in traces:
        trace.remove()


def test_each_function_of_the_package_counts_once(installed):
    trace = installed(Trace())
    for key in ("torque_nm", "angle_rad"):
        units.unit_of(key)
    sorted([2, 1], key=lambda number: -number)
    trace.remove()
    way = trace.take()
    assert way == (("shearloop/units.py", "unit_of"),)
    assert counts(way) == {"functions": 1, "modules": 1}
    assert trace.take() == ()


def test_the_body_of_a_class_is_no_function():
    module = compile("class Late:\n    def method(self): pass", units.__file__, "exec")
    (body, *_) = [constant for constant in module.co_consts if isinstance(constant, CodeType)]
    (method, *_) = [constant for constant in body.co_consts if isinstance(constant, CodeType)]
    assert functions_of([module, body, method]) == (("shearloop/units.py", "Late.method"),)


def test_a_way_continues_in_other_functions_until_its_end(installed):
    def begin():
        units.unit_of("torque_nm")

    def aside():
        units.unit_hint(1.0, "mm", 0.0, 2.0)

    def go_on():
        end()
        aside()

    def end():
        units.unit_hint(1.0, "rad", 0.0, 2.0)

    trace = WayTrace(lambda frame: frame.f_code is begin.__code__, [go_on.__code__], lambda code: code is end.__code__)
    installed(trace)
    go_on()
    begin()
    aside()
    go_on()
    trace.remove()
    (way,) = trace.ways
    assert way[0] == ("shearloop/units.py", "unit_of")
    assert ("shearloop/units.py", "unit_hint") in way
