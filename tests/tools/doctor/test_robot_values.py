"""What the doctor says of the robot's settings: what is left open, and which limits nobody has changed."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.daemon.config import load_daemon_config
from shearloop.tools.doctor.robot_values import check_example_addresses, check_robot_values
from tests.fixtures.robots import TOOL, filled_in, write_filled_in

INITIAL = [
    "joints",
    "wrist_speed_rad_per_s 0.2 and 0.35",
    "wrist_acceleration_rad_per_s2 4 and 8",
    "linear_speed_m_per_s 0.05 and 0.08",
    "linear_acceleration_m_per_s2 0.5 and 1",
    "force_n 20 and 30",
    "torque_nm 1.5 and 2.5",
]


def named_limits(path: Path) -> list[str]:
    """Return the limits that the doctor names as unchanged."""
    found = [one.found for one in check_robot_values(path) if one.state == "note"]
    return found[0].removeprefix(f"{path}: as `init` wrote them: ").split(", ") if found else []


def test_a_file_as_init_wrote_it_needs_a_workspace_and_a_tool_and_every_limit_is_named(tmp_path):
    path = tmp_path / "ur.yaml"
    shutil.copy("config/ur.yaml", path)
    found = list(check_robot_values(path))
    assert [(one.found, one.state) for one in found[:2]] == [
        (f"{path}: limits.workspace is not filled in", "trouble"),
        (f"{path}: tool (payload_kg, payload_cog_m, tcp_offset) is not filled in", "trouble"),
    ]
    assert "enter lower_m, upper_m and margin_m" in found[0].next_step
    assert named_limits(path) == INITIAL
    assert set(yaml.safe_load(path.read_text())["limits"]) == {one.partition(" ")[0] for one in INITIAL}


@pytest.mark.parametrize("absent", list(TOOL))
def test_each_value_of_the_tool_is_asked_for(absent, tmp_path):
    path = write_filled_in(tmp_path, tool={key: value for key, value in TOOL.items() if key != absent})
    assert [one.found for one in check_robot_values(path) if one.state == "trouble"] == [
        f"{path}: tool ({absent}) is not filled in"
    ]


def changed(limit: str, **parts: Any) -> dict[str, Any]:
    limits = filled_in()["limits"]
    return {**limits, limit: {**limits[limit], **parts}}


@pytest.mark.parametrize(
    ("limits", "named"),
    [
        (changed("torque_nm", inner=1.2, hard=2.0), INITIAL[:-1]),
        (changed("torque_nm", inner=1.2), [*INITIAL[:-1], "torque_nm.hard"]),
        (changed("joints", margin_rad=0.2), ["joints.lower_rad", "joints.upper_rad", *INITIAL[1:]]),
    ],
)
def test_a_limit_that_somebody_has_changed_is_not_named(limits, named, tmp_path):
    assert named_limits(write_filled_in(tmp_path, limits=limits)) == named


def test_the_example_addresses_of_init_are_named_until_each_is_ones_own(tmp_path):
    path = tmp_path / "rig.yaml"
    content = yaml.safe_load(Path("config/rig.yaml").read_text())
    content["fingertips"]["right"]["device"] = {"serial_number": "85734323"}
    path.write_text(yaml.safe_dump(content))
    write_filled_in(tmp_path)
    (finding,) = check_example_addresses(load_daemon_config(path))
    assert finding.state == "note"
    assert finding.found == (
        "as `init` wrote them: `fingertips.left.device` 12345671, `load_cell.device` 12345672, "
        "`gripper.socket` 192.168.1.10:63352, `robot` 192.168.1.10"
    )
    content["fingertips"]["left"]["device"] = {"path": "/dev/ttyACM3"}
    del content["load_cell"]
    content["gripper"]["socket"] = {"host": "10.20.3.14"}
    path.write_text(yaml.safe_dump(content))
    write_filled_in(tmp_path, host="10.20.3.14")
    assert list(check_example_addresses(load_daemon_config(path))) == []


def test_nothing_is_said_once_every_limit_is_ones_own(tmp_path):
    limits = {
        name: {
            part: 0.9 * value if isinstance(value, float) else [0.9 * x for x in value] for part, value in of.items()
        }
        for name, of in filled_in()["limits"].items()
    }
    assert list(check_robot_values(write_filled_in(tmp_path, limits=limits))) == []
