"""Each setting has one default, in one place; the wrist's limits reach everything that turns the wrist."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import yaml

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment import TrackTorque
from shearloop.daemon.control.experiment_schema import IdentifyStep
from shearloop.daemon.control.wrist_controller import WristController, controller_settings
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.rig import make_loop, robot_settings
from shearloop.daemon.torques import TorqueSource
from tests.daemon.control.test_margins import FOUND

PACKAGE = Path(__file__).parents[2]
# Simulated devices and plants have properties of their own.
SIMULATED = ("charts", "emulated_calibration")
ROOMS = ("bank", "estimation", "drivers", "daemon", "tools", "studies", "cli")


Place = tuple[str, str]


def module_of(path: Path) -> str:
    return ".".join(("shearloop", *path.relative_to(PACKAGE).with_suffix("").parts))


@cache
def trees() -> dict[str, ast.Module]:
    """Return the syntax trees of all modules but the simulated ones."""
    paths = [path for folder in ROOMS for path in (PACKAGE / folder).rglob("*.py")]
    return {
        module_of(path): ast.parse(path.read_text())
        for path in paths
        if not any(word in str(path) for word in SIMULATED)
    }


@cache
def nodes() -> list[tuple[str, ast.AST]]:
    """Return the nodes of all modules' syntax trees."""
    return [(module, node) for module, tree in trees().items() for node in ast.walk(tree)]


@cache
def constants() -> dict[Place, ast.expr]:
    """Return the values of the modules' constants."""
    found: dict[Place, ast.expr] = {}
    for module, line in [(module, line) for module, tree in trees().items() for line in tree.body]:
        if not isinstance(line, ast.Assign | ast.AnnAssign):
            continue
        targets = line.targets if isinstance(line, ast.Assign) else [line.target]
        for target in targets:
            several = isinstance(target, ast.Tuple) and isinstance(line.value, ast.Tuple)
            several = several and len(target.elts) == len(line.value.elts)
            pairs = zip(target.elts, line.value.elts, strict=True) if several else [(target, line.value)]
            found.update({(module, name.id): value for name, value in pairs if isinstance(name, ast.Name)})
    return found


@cache
def imports() -> dict[Place, Place]:
    """Return where each imported name comes from."""
    return {
        (module, each.asname or each.name): (line.module, each.name)
        for module, line in nodes()
        if isinstance(line, ast.ImportFrom)
        for each in line.names
    }


def origin(module: str, default: ast.expr | None) -> tuple[Place, object] | None:
    """Return where a default is written out, and its value; None for a switch, an empty value and what is computed."""
    match default:
        case ast.Call(func=ast.Name(id="Field")):
            named = [keyword.value for keyword in default.keywords if keyword.arg == "default"]
            return origin(module, next(iter([*named, *default.args]), None))
        case ast.Constant(value=value) if not isinstance(value, bool) and value not in (None, 0, 1, "", ...):
            return (module, f"line {default.lineno}"), value
        case ast.Name(id=name):
            module, name = imports().get((module, name), (module, name))
        case ast.Attribute(value=ast.Name(id=owner), attr=name) if (module, owner) in imports():
            module = ".".join(imports()[module, owner])
        case _:
            return None
    found = origin(module, constants().get((module, name)))
    return found if found is None or found[0][0] != module else ((module, name), found[1])


def defaults() -> Iterator[tuple[str, Place, object]]:
    """Yield the name of each default of a class or of its constructor, where it is written out, and its value."""
    bodies = [(module, node.body) for module, node in nodes() if isinstance(node, ast.ClassDef)]
    for module, line in [(module, line) for module, body in bodies for line in body]:
        pairs: list[tuple[str, ast.expr | None]] = []
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            pairs = [(line.target.id, line.value)]
        elif isinstance(line, ast.FunctionDef) and line.name == "__init__":
            arguments = [*line.args.posonlyargs, *line.args.args][::-1]
            by_position = zip(arguments, line.args.defaults[::-1], strict=False)
            by_name = zip(line.args.kwonlyargs, line.args.kw_defaults, strict=True)
            pairs = [(argument.arg, value) for argument, value in [*by_position, *by_name]]
        for name, value in pairs:
            if (found := origin(module, value)) is not None:
                yield name, *found


def test_equal_defaults_of_one_name_come_from_one_constant():
    """One name may have several values, as in the steps of an experiment; equal values come from one constant."""
    places: dict[tuple[str, object], set[Place]] = defaultdict(set)
    for name, place, value in defaults():
        places[name, value].add(place)
    assert len(places) > 100
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


@pytest.mark.parametrize("stale_after_s", [0.1, 4.0])
def test_the_controller_uses_every_torque_that_is_no_fault(stale_after_s):
    """A torque that it refuses and no fault reports would let the wrist rest without a reason."""
    config, right = LoopConfig(stale_after_s=stale_after_s), TorqueSource(name="right", period_s=0.5, window_s=0.6)
    source = ControlLoop(config, {"right": right}, ("robot",)).wrist.source
    tuned = controller_settings(config, FOUND, source, TrackTorque(0.1, 0.05))
    fresh_s = max(1.25, stale_after_s)
    assert (tuned.fresh_s, tuned.age_limit_s) == (fresh_s, fresh_s + 0.3)


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("where", ["loop", "robot"])
def test_the_wrists_acceleration_reaches_controller_identification_and_robot(where, tmp_path):
    """The lower one of loop and robot counts; half of it is planned with, the robot may use all."""
    settings = yaml.safe_load(Path("config/demo_ur.yaml").read_text())
    if where == "robot":
        settings["limits"]["wrist_acceleration_rad_per_s2"]["inner"] = 1.5
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump(settings))
    loop_config = LoopConfig(wrist_acceleration_rad_per_s2=1.5) if where == "loop" else LoopConfig()
    source = TorqueSource(name="right", period_s=0.5)
    config = DaemonConfig.model_construct(loop=loop_config)
    loop = make_loop(config, robot_settings(tmp_path / "ur.yaml"), {"right": source}, {})
    assert loop.config.wrist_acceleration_rad_per_s2 == 1.5, "sent to the robot"
    tuned = controller_settings(loop.config, FOUND, source, TrackTorque(0.1, 0.05))
    assert tuned.wrist_limit.acceleration_rad_per_s2 == 0.75
    wrist = WristController(source, loop.config)
    wrist.begin_identification(IdentifyStep(do="identify"), 0.5)
    wrist.excitation.command(0, 0.0)
    assert wrist.excitation.command(50_000_000, 1.0) == pytest.approx(-0.75 * 0.05)
