"""Every number that people write in a file has a range, and a number in another unit is refused with the unit."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.cli.config_schema import MODELS, schema_of
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import read_settings
from shearloop.errors import UserError
from tests.fixtures.robots import filled_in

# The designs of banks and fingertips move nothing; their meshes have no largest size that we know.
MOVING = sorted(MODELS.keys() - {"bank", "fingertip"})


def numbers(schema: Mapping[str, Any], path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield each number of a JSON schema, with its path."""
    if schema.get("type") in ("number", "integer"):
        yield path, schema
    for key, inner in schema.get("properties", {}).items():
        yield from numbers(inner, f"{path}.{key}")
    for group in ("anyOf", "prefixItems"):
        for inner in schema.get(group, ()):
            yield from numbers(inner, path)
    if isinstance(schema.get("items"), Mapping):
        yield from numbers(schema["items"], f"{path}[]")


@pytest.mark.parametrize("kind", MOVING)
def test_every_number_has_a_lower_and_an_upper_bound(kind):
    schema = schema_of(kind)
    sections = {"": schema, **schema.get("$defs", {})}
    found = [one for name, section in sections.items() for one in numbers(section, name)]
    assert len(found) > 10
    unbounded = [
        path
        for path, number in found
        if not ({"minimum", "exclusiveMinimum"} & number.keys() and {"maximum", "exclusiveMaximum"} & number.keys())
    ]
    assert unbounded == []


def robot(folder: Path, place: str, value: object) -> Path:
    """Return the delivered robot's settings with one other value."""
    content = filled_in()
    *sections, key = place.split(".")
    section = content
    for name in sections:
        section = section[name]
    section[key] = value
    path = folder / "ur.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


SIX_DEGREES = [360.0] * 6


@pytest.mark.parametrize(
    ("place", "value", "hint"),
    [
        ("limits.joints.upper_rad", SIX_DEGREES, "did you mean 6.283, 360 degrees in rad?"),
        ("limits.joints.margin_rad", 5, "did you mean 0.08727, 5 degrees in rad?"),
        ("limits.workspace.lower_m", [-800, -800, 0], "did you mean -0.8, -800 mm in m?"),
        ("limits.workspace.margin_m", 20, "did you mean 0.02, 20 mm in m?"),
        ("limits.wrist_speed_rad_per_s", {"inner": 30, "hard": 40}, "did you mean 0.5236, 30 degrees/s in rad/s?"),
        ("limits.wrist_acceleration_rad_per_s2", {"inner": 230, "hard": 460}, "230 degrees/s² in rad/s²?"),
        ("limits.linear_speed_m_per_s", {"inner": 100, "hard": 150}, "did you mean 0.1, 100 mm/s in m/s?"),
        ("limits.linear_acceleration_m_per_s2", {"inner": 500, "hard": 1000}, "did you mean 0.5, 500 mm/s² in m/s²?"),
        ("limits.force_n", {"inner": 40, "hard": 1000}, "hard: 1000 is too large; allowed: above 0 to 250"),
        ("limits.torque_nm", {"inner": 4000, "hard": 6000}, "did you mean 4, 4000 mN·m in N·m?"),
        ("tool.payload_kg", 1000, "did you mean 1, 1000 g in kg?"),
        ("tool.payload_cog_m", [0, 0, 60], "tool.payload_cog_m[2]: 60 is too large; allowed: from -1 to 1; did you"),
        ("tool.tcp_offset", [0, 0, 150, 0, 0, 0], "did you mean 0.15, 150 mm in m?"),
        ("tool.tcp_offset", [0, 0, 0, 0, 180, 0], "did you mean 3.142, 180 degrees in rad?"),
        ("limits.force_n", {"inner": 1e300, "hard": 1.1e300}, "is too large"),
    ],
)
def test_a_limit_in_another_unit_is_refused_with_what_was_meant(tmp_path, place, value, hint):
    with pytest.raises(DriverError) as refused:
        read_settings(robot(tmp_path, place, value))
    assert hint in str(refused.value)


def test_a_whole_turn_is_a_range_of_a_joint(tmp_path):
    turn = [6.2832] * 6
    assert read_settings(robot(tmp_path, "limits.joints.upper_rad", turn)).limits.joints.upper_rad[5] > math.tau


@pytest.mark.parametrize(
    ("step", "hint"),
    [
        ({"do": "approach", "pose_m_rad": [0.4, 0.1, 488, 0, 3.1, 0]}, "did you mean 0.488, 488 mm in m?"),
        ({"do": "retreat", "pose_m_rad": [1e300, 0.1, 0.4, 0, 3.1, 0]}, "pose_m_rad[0]: 1e+300 is too large"),
        ({"do": "approach", "pose_m_rad": [0.4, 0.1, 0.4, 0, 180, 0]}, "did you mean 3.142, 180 degrees in rad?"),
        # 90 is an angle in degrees only where an angle stands.
        ({"do": "approach", "pose_m_rad": [90, 0.1, 0.4, 0, 3.1, 0]}, "did you mean 0.09, 90 mm in m?"),
        ({"do": "approach", "along_tool_m": 30}, "did you mean 0.03, 30 mm in m?"),
        ({"do": "turn_to", "angle_rad": 360}, "did you mean 6.283, 360 degrees in rad?"),
        ({"do": "hold_torque", "torque_nm": 120}, "did you mean 0.12, 120 mN·m in N·m?"),
        ({"do": "grip", "width_mm": 1e300}, "is too large"),
    ],
)
def test_a_step_in_another_unit_is_refused_with_what_was_meant(tmp_path, step, hint):
    path = tmp_path / "experiment.yaml"
    path.write_text(yaml.safe_dump({"name": "one", "steps": [step]}), encoding="utf-8")
    with pytest.raises(UserError) as refused:
        load_yaml_model(path, ExperimentFile)
    assert hint in str(refused.value)
