"""The robot's YAML: the delivered file, and mistakes."""

from pathlib import Path

import pytest

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import InstalledTool, read_settings

DELIVERED = Path(__file__).parents[3] / "config" / "ur.yaml"
# The workspace is commented out there, with other numbers.
WORKSPACE = "  workspace:\n    lower_m: [-0.8, -0.8, 0.0]\n    upper_m: [0.8, 0.8, 0.9]\n    margin_m: 0.02\n"


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    text = "".join(line for line in DELIVERED.read_text(encoding="utf-8").splitlines(True) if "#   " not in line)
    text = text.replace("limits:\n", f"limits:\n{WORKSPACE}")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "ur.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_all_mistakes_are_reported_together(tmp_path):
    path = changed(
        tmp_path,
        ("torque_nm: {inner: 1.5, hard: 2.5}", "torque_nm: {inner: 7.0, hard: 6.0}"),
        ("margin_m: 0.02", "margin_m: 0.02\n    colour: red"),
        ("host: 192.168.1.10", "host: 192.168.1.10\nhang_timeout_s: -1\nreaction_s: 0.6"),
        ("upper_m: [0.8, 0.8, 0.9]", "upper_m: [0.8, .inf, 0.9]"),
    )
    with pytest.raises(DriverError) as caught:
        read_settings(path)
    message = str(caught.value)
    for part in (str(path), "limits.torque_nm", "inner (7) must be below hard (6)",
                 ": hang_timeout_s: -1 is too small", ": reaction_s: 0.6 is too large; allowed: from 0.002 to 0.5",
                 "limits.workspace.colour", "limits.workspace.upper_m[1]"):  # fmt: skip
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("host: 192.168.1.10", "host: 192.168.1.10\nhang_timeout_s: 0", "0 is too small; allowed: from 0.3 to 10"),
        (
            "host: 192.168.1.10",
            "host: 192.168.1.10\ncommand_timeout_s: 3",
            r"ur.yaml:\d+: command_timeout_s: 3 is too large",
        ),
        ("host: 192.168.1.10", "host: a..b", "`host` is no name or address of a computer"),
        ("host: 192.168.1.10", f"host: {'a' * 300}", "`host` is no name or address of a computer"),
        ("host: 192.168.1.10", 'host: "\\ud800"', "`host` is no name or address of a computer"),
        ("host: 192.168.1.10", "host: 192.168.1.10\ntool: {payload_kg: -1}", "tool.payload_kg: -1 is too small"),
        ("host: 192.168.1.10", "host: 192.168.1.10\ntool: {payload_kg: 1, reported: false}", "compares nothing: take"),
        ("margin_m: 0.02", "margin_m: 0.45", "no room"),
        ("{inner: 4.0, hard: 8.0}", "{inner: 4.0, hard: 50.0}", "hard: 50.0 is too large; allowed: above 0 to 40"),
        ("margin_m: 0.02", "margin_m: 0", "limits.workspace.margin_m: 0 is too small; allowed: above 0"),
        ("host: 192.168.1.10", "host: 192.168.1.10\nrate_hz: 500\ngeneration: cb3", r"ur.yaml:7: rate_hz: a CB3"),
        ("host: 192.168.1.10", "host: 192.168.1.10\ngeneration: cb3", "wrench of a CB3, ± 5 N·m"),
        ("host: 192.168.1.10\n", "", r"ur.yaml:\d+: host: is missing"),
        ("host: 192.168.1.10", "host: ' '", r"ur.yaml:6: `host` is empty; give the device's address"),
        ("host: 192.168.1.10", "host: 192.168.1.10\nhots: 1", "hots: is not a known key; did you mean host"),
        ("margin_rad: 0.1", "margin_rad: -1", "limits.joints.margin_rad: -1 is too small"),
    ],
)
def test_mistake_is_reported(tmp_path, old, new, said):
    with pytest.raises(DriverError, match=said):
        read_settings(changed(tmp_path, (old, new)))


def test_only_a_robot_on_this_computer_may_have_states_older_than_a_second(tmp_path):
    late = "state_timeout_s: 5"
    assert read_settings(changed(tmp_path, ("host: 192.168.1.10", f"host: 127.0.0.1\n{late}"))).state_timeout_s == 5
    with pytest.raises(
        DriverError, match=r"state_timeout_s: 5 s is above 1 s, and 192\.168\.1\.10 is not this computer"
    ):
        read_settings(changed(tmp_path, ("host: 192.168.1.10", f"host: 192.168.1.10\n{late}")))


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(DriverError, match="nowhere"):
        read_settings(tmp_path / "nowhere.yaml")


def test_a_wrist_without_decisions_stands_within_0_2_s() -> None:
    settings = read_settings(Path("config/demo_ur.yaml"))
    limits = settings.limits
    braking_s = limits.wrist_speed_rad_per_s.inner / limits.wrist_acceleration_rad_per_s2.hard
    assert settings.command_timeout_s + 2 / settings.rate_hz + braking_s == settings.standstill_s <= 0.2
    assert settings.why_too_slow == ""


@pytest.mark.parametrize("command_timeout_s", [0.02, 0.1, 1.0])
def test_watchdog_is_slower_than_any_stop(tmp_path, command_timeout_s) -> None:
    """A program that ends while the arm moves may end in a protective stop."""
    added = f"host: 127.0.0.1\ncommand_timeout_s: {command_timeout_s}"
    settings = read_settings(changed(tmp_path, ("host: 192.168.1.10", added)))
    assert 1 / settings.watchdog_hz == pytest.approx(1.5 * settings.standstill_s)


@pytest.mark.parametrize(
    "change",
    [
        ("host: 192.168.1.10", "host: 192.168.1.10\ncommand_timeout_s: 1"),
        ("host: 192.168.1.10", "host: 192.168.1.10\nsilence_timeout_s: 1"),
        ("wrist_speed_rad_per_s: {inner: 0.2, hard: 0.35}", "wrist_speed_rad_per_s: {inner: 1.0, hard: 1.2}"),
        ("{inner: 4.0, hard: 8.0}", "{inner: 0.0001, hard: 0.0002}"),
    ],
)
def test_a_robot_that_would_take_longer_to_stand_than_promised_is_refused(tmp_path, change) -> None:
    with pytest.raises(DriverError, match=r"ur\.yaml: the wrist may turn for .* s after .*, longer than 0\.2 s: lower"):
        read_settings(changed(tmp_path, change))
    on_this_computer = (change[0].replace("192.168.1.10", "127.0.0.1"), change[1].replace("192.168.1.10", "127.0.0.1"))
    emulated = read_settings(changed(tmp_path, ("host: 192.168.1.10", "host: 127.0.0.1"), on_this_computer))
    assert emulated.standstill_s > 0.2


@pytest.mark.parametrize(
    "key",
    [
        *("rate_hz", "command_timeout_s", "silence_timeout_s", "state_timeout_s", "connect_timeout_s"),
        *("hang_timeout_s", "recover_timeout_s", "reaction_s", "rest_rad_per_s"),
    ],
)
def test_every_number_beside_the_limits_has_a_lower_end(tmp_path, key) -> None:
    with pytest.raises(DriverError, match=f"{key}: 0.0001 is too small"):
        read_settings(changed(tmp_path, ("host: 192.168.1.10", f"host: 192.168.1.10\n{key}: 0.0001")))


def test_a_cb3_is_not_asked_for_more_states_than_it_sends(tmp_path) -> None:
    wrench = ("torque_nm: {inner: 1.5, hard: 2.5}", "torque_nm: {inner: 6.0, hard: 8.0}")
    asked = "host: 192.168.1.10\ngeneration: cb3\nrate_hz: "
    assert read_settings(changed(tmp_path, wrench, ("host: 192.168.1.10", f"{asked}125"))).rate_hz == 125
    with pytest.raises(DriverError, match="rate_hz: a CB3 sends 125 states a second at most, not 500"):
        read_settings(changed(tmp_path, wrench, ("host: 192.168.1.10", f"{asked}500")))


def test_a_controller_that_reports_no_payload_needs_no_tool(tmp_path) -> None:
    added = "host: 192.168.1.10\ntool: {reported: false}"
    assert read_settings(changed(tmp_path, ("host: 192.168.1.10", added))).left_open() == {}
    assert "tool" in next(iter(read_settings(changed(tmp_path)).left_open()))


@pytest.mark.parametrize(
    ("tcp_offset", "said"),
    [
        ([0.0, 0.0, 0.15, 0.0, 0.0, 1.5], None),
        ([0.003, -0.004, 0.2, 0.01, 0.0, 0.0], None),
        ([0.05, 0.0, 0.15, 0.0, 0.0, 0.0], "lies 50 mm beside the axis of wrist 3"),
        ([0.0, 0.0, 0.15, 0.0, 0.785, 0.0], "is tilted by 0.79 rad against the axis of wrist 3"),
        ([0.0, 0.0, 0.15, 3.14159, 0.0, 0.0], "is tilted by 3.14 rad"),
    ],
)
def test_a_tool_beside_the_axis_of_wrist_3_is_refused(tcp_offset, said):
    """The torque about wrist 3 is then not the one on the tool, and differs from CB3 to e-Series."""
    if said is None:
        assert tuple(InstalledTool(payload_kg=1.0, tcp_offset=tcp_offset).tcp_offset) == tuple(tcp_offset)
        return
    with pytest.raises((ValueError, DriverError), match=said):
        InstalledTool(payload_kg=1.0, tcp_offset=tcp_offset)
