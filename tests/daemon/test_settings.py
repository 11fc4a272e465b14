"""Each setting has one default, in one place; the wrist's limits reach everything that turns the wrist."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.experiment import TrackTorque
from shearloop.daemon.control.experiment_schema import IdentifyStep
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.loop_inputs import LoopConfig, TorqueSource
from shearloop.daemon.control.wrist_controller import WristController, controller_settings
from shearloop.daemon.rig import make_loop

PACKAGE = Path(__file__).parents[2]
# Simulated devices and plants have properties of their own.
SIMULATED = ("emulators", "charts", "synthetic")


def literal(default: ast.expr | None) -> object:
    """Return a default that is written out, a number other than 0 and 1 or a text; None for a name."""
    if isinstance(default, ast.Call) and isinstance(default.func, ast.Name) and default.func.id == "Field":
        named = [keyword.value for keyword in default.keywords if keyword.arg == "default"]
        default = next(iter([*named, *default.args]), None)
    if not isinstance(default, ast.Constant) or isinstance(default.value, bool) or default.value in (0, 1, ""):
        return None
    return default.value


def defaults(path: Path) -> Iterator[tuple[str, object, bool]]:
    """Yield the name and the value of each default of a class, and whether it is an argument of its constructor."""
    bodies = [node.body for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ClassDef)]
    for line in [line for body in bodies for line in body]:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            if "ClassVar" not in ast.unparse(line.annotation) and (value := literal(line.value)) is not None:
                yield line.target.id, value, False
        elif isinstance(line, ast.FunctionDef) and line.name == "__init__":
            arguments = [*line.args.posonlyargs, *line.args.args][::-1]
            pairs = [*zip(arguments, line.args.defaults[::-1], strict=False)]
            for argument, default in [*pairs, *zip(line.args.kwonlyargs, line.args.kw_defaults, strict=True)]:
                if (value := literal(default)) is not None:
                    yield argument.arg, value, True


def test_no_default_stands_twice():
    """Two models may use one name with different values, as the steps do; a constructor repeats no default."""
    places: dict[str, dict[Path, tuple[object, bool]]] = defaultdict(dict)
    for path in [path for folder in ("bank", "drivers", "daemon") for path in (PACKAGE / folder).rglob("*.py")]:
        if not any(word in str(path) for word in SIMULATED):
            for name, value, of_constructor in defaults(path):
                places[name][path] = value, of_constructor
    twice = {
        name: sorted(str(path.relative_to(PACKAGE)) for path in found)
        for name, found in places.items()
        if len({value for value, _ in found.values()}) < len(found)
        or (len(found) > 1 and any(of_constructor for _, of_constructor in found.values()))
    }
    assert twice == {}


@pytest.mark.parametrize("where", ["loop", "robot"])
def test_the_wrists_acceleration_reaches_controller_identification_and_robot(where, tmp_path):
    """The lower one of loop and robot counts; half of it is planned with, the robot may use all."""
    settings = yaml.safe_load(Path("config/ur.yaml").read_text())
    if where == "robot":
        settings["limits"]["wrist_acceleration_rad_per_s2"]["inner"] = 1.5
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump(settings))
    loop_config = LoopConfig(wrist_acceleration_rad_per_s2=1.5) if where == "loop" else LoopConfig()
    source = TorqueSource(name="right", period_s=0.5)
    loop = make_loop(DaemonConfig.model_construct(robot=tmp_path / "ur.yaml", loop=loop_config), {"right": source})
    assert loop.config.wrist_acceleration_rad_per_s2 == 1.5, "sent to the robot"
    found = ToolModel(
        stiffness_nm_per_rad=0.25, stiffness_std=0.01, lag_s=0.0, lag_std_s=0.1, age_s=0.3, actuation_s=0.02,
        noise_nm=0.012, sample_period_s=0.5, angle_rad=0.0, torque_nm=0.0, torque_std_nm=0.003,
    )  # fmt: skip
    tuned = controller_settings(loop.config, found, source, TrackTorque(0.1, 0.05), 0.5)
    assert tuned.acceleration_limit_rad_per_s2 == 0.75
    wrist = WristController(source, loop.config)
    wrist.begin_identification(IdentifyStep(do="identify"), 0.5)
    assert wrist.excitation.settings.acceleration_rad_per_s2 == 0.75
