"""A rehearsal: a configuration of real devices runs, and none of them is opened."""

import asyncio
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.cli import main
from shearloop.cli.emulate.devices import robot_make
from shearloop.cli.emulator_processes import check_emulators
from shearloop.cli.init import packaged_files
from shearloop.cli.rehearsal import rehearsal
from shearloop.daemon.commissioning_report import Line, Report, StageResult
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.rig_identity import identity_of, judged_by, judged_sha256s
from shearloop.daemon.supplied_values import Supplied
from shearloop.drivers.calibration_files import save_calibration
from shearloop.drivers.load_cell import LoadCalibration
from shearloop.drivers.ur.settings import GENERATIONS, read_settings
from shearloop.emulators.ur_arm import HOME_RAD, frame_of_pose, joints_within, tool_frames
from shearloop.errors import UserError
from shearloop.tools.commission.report import write_report
from tests.fixtures.daemons import shearloop

REAL = {
    "fingertips": {"thumb": {"device": {"serial_number": "85734323"}}, "index": {"device": {"path": "/dev/ttyACM3"}}},
    "load_cell": {"device": {"serial_number": "75834312"}},
    "robot": "ur.yaml",
    "gripper": {"model": "2F-85", "socket": {"host": "192.168.1.10"}},
    "skin": {
        "source": {"socket": {"host": "10.0.0.7", "port": 5025}},
        "daq": {"adc": {"device": {"serial_number": "0042"}}, "rate_hz": 20},
        "calibration": "skin.yaml",
        "tool_radius_mm": 20,
    },
}
SHORT = {
    "name": "short",
    "torque_source": "load_cell",
    "tool_mm": 30,
    "limits": {"torque_nm": 0.25, "angle_rad": 1.5},
    "steps": [
        {"do": "release", "timeout_s": 15},
        {"do": "tare", "timeout_s": 30},
        {"do": "grip", "width_mm": 5, "force_n": 60, "timeout_s": 15},
        {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.3, "hold_s": 0.5, "timeout_s": 30},
        {"do": "release", "timeout_s": 15},
    ],
}


@pytest.fixture
def real_rig(tmp_path, tiny_bank):
    """Write a configuration of the named devices, with changes, and return its path."""

    def write(*keys: str, **changes: Any) -> Path:
        robot = yaml.safe_load(packaged_files()[Path("ur.yaml")])
        robot["tool"] = {"payload_kg": 1.3, "tcp_offset": [0.0, 0.0, 0.15, 0.0, 0.0, 0.0]}
        robot["limits"]["wrist_speed_rad_per_s"] = {"inner": 0.5, "hard": 0.7}
        (tmp_path / "ur.yaml").write_text(yaml.safe_dump(robot))
        (tmp_path / "short.yaml").write_text(yaml.safe_dump(SHORT))
        content = {key: REAL[key] for key in keys} | changes
        for fingertip in content.get("fingertips", {}).values():
            fingertip.setdefault("bank", str(tiny_bank))
        addresses = {key: f"ipc://{tmp_path}/{key}" for key in ("publish", "commands")}
        path = tmp_path / "rig.yaml"
        path.write_text(yaml.safe_dump({**addresses, **content}, sort_keys=False))
        return path

    return write


def addresses(config: DaemonConfig) -> set[str]:
    """Return every serial number, device path and host of a configuration and of its robot's settings."""
    found = {str(value) for key, value in config.walk() if key.rpartition(".")[2] in ("serial_number", "path", "host")}
    return found | ({read_settings(config.robot).host} if config.robot is not None else set())


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(
    ("keys", "devices"),
    [
        (("load_cell",), ["hx711"]),
        (("fingertips",), ["eit-kit", "eit-kit"]),
        (("skin",), ["skin"]),
        (("robot", "skin"), ["skin"]),
        (("robot", "load_cell"), ["rig"]),
        (("robot", "gripper", "fingertips"), ["rig"]),
        (("robot", "gripper", "skin"), ["rig"]),
        (tuple(REAL), ["rig"]),
    ],
)
def test_every_device_of_the_configuration_is_played_and_no_real_address_is_left(real_rig, keys, devices):
    path = real_rig(*keys)
    config = load_daemon_config(path)
    with rehearsal(config, path) as rehearsed:
        left = (addresses(config) & addresses(rehearsed.config)) - {"None"}
        assert not left, "an address of the real rig is still in the configuration"
        assert rehearsed.config.emulated
        options = check_emulators(rehearsed.config.emulators, path)
        assert [each.device for each in rehearsed.config.emulators] == devices
        played = dict(zip(devices, options, strict=True))
        text = " ".join(rehearsed.sentences)
        assert ("the robot at 192.168.1.10 is played at 127.0.0." in text) == ("robot" in keys)
    if "rig" in played:
        rig = played["rig"]
        assert [name for name, _ in rig.fingertip] == (["thumb", "index"] if "fingertips" in keys else [])
        assert (rig.gripper, rig.model) == (("socket", "2F-85") if "gripper" in keys else ("none", "2F-140"))
        assert rig.no_load_cell == ("load_cell" not in keys)
        assert rig.payload_kg == 1.3
    if "skin" in keys:
        # The robot's tool is pressed and turned on the skin, whichever emulator plays the robot.
        skin = played[devices[-1]]
        assert (skin.radius_mm, skin.daq_rate_hz) == (20, 20)
        assert skin.source_port is not None
    if "skin" in played:
        assert (played["skin"].robot is not None) == (keys == ("robot", "skin"))


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(("changes", "tool_mm"), [({}, 20), ({"experiment": "short.yaml"}, 30)])
def test_the_first_lines_say_how_large_the_tool_of_every_experiment_is(real_rig, changes, tool_mm):
    path = real_rig("robot", "load_cell", "gripper", **changes)
    with rehearsal(load_daemon_config(path), path) as rehearsed:
        (rig,) = check_emulators(rehearsed.config.emulators, path)
        (sentence,) = (said for said in rehearsed.sentences if "emulated tool" in said)
    assert rig.diameter_mm == tool_mm
    assert f"a diameter of {tool_mm} mm, " in sentence
    assert "every experiment that you start grips this tool" in sentence


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("name", ["rig.yaml", "ur.yaml"])
def test_a_rehearsal_notices_a_change_of_the_persons_own_files(real_rig, name):
    path = real_rig("robot", "load_cell", "gripper")
    with rehearsal(load_daemon_config(path), path) as rehearsed:
        loaded = LoadedFiles.of(rehearsed.config)
        assert loaded.why_outdated() == ""
        changed = path.with_name(name)
        changed.write_text(changed.read_text() + "# tighter\n")
        assert loaded.why_outdated().startswith(f"{changed} has changed since the daemon began")


def test_a_calibrated_load_cell_gets_the_counts_of_its_own_calibration(real_rig, tmp_path):
    from shearloop.cli.emulate.devices import load_cell_sketch

    calibration = LoadCalibration(tare_counts=-4.2e5, scale_n_per_count=-2e-6, lever_arm_m=0.05)
    save_calibration(tmp_path / "load.yaml", calibration)
    path = real_rig(load_cell={"device": {"serial_number": "75834312"}, "calibration": "load.yaml"})
    with rehearsal(load_daemon_config(path), path) as rehearsed:
        (options,) = check_emulators(rehearsed.config.emulators, path)
    line = next(load_cell_sketch(options.load_calibration, 0.0).lines([0.25]))
    assert calibration.torque_nm(float(line)) == pytest.approx(0.25)


@pytest.mark.real_time
async def test_a_load_cell_alone_shows_its_readings_in_a_file(real_rig, tmp_path):
    """A file's buffer holds what is not flushed until the program ends."""
    path = real_rig("load_cell")
    with (tmp_path / "shown.txt").open("w") as file:
        async with shearloop("run", str(path), "--emulate", "--show", stdout=file.fileno()):
            while not readings(tmp_path / "shown.txt"):  # noqa: ASYNC110 - a file has no event
                await asyncio.sleep(0.05)


def readings(path: Path) -> list[str]:
    """Return the load cell's torques among the whole lines of a file; the first reading can be none."""
    lines = path.read_text().splitlines(keepends=True)
    return [line for line in lines if re.search(r"load\.torque +load_cell +torque [-+].* N·m .*\n", line)]


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("generation", ["cb3", "e-series"])
def test_the_emulated_controller_is_of_the_generation_of_the_robots_settings(real_rig, generation):
    path = real_rig("robot", "load_cell")
    robot = path.with_name("ur.yaml")
    content = yaml.safe_load(robot.read_text())
    content["limits"] |= {"force_n": {"inner": 40.0, "hard": 60.0}, "torque_nm": {"inner": 6.0, "hard": 8.0}}
    robot.write_text(yaml.safe_dump({**content, "generation": generation}))
    with rehearsal(load_daemon_config(path), path) as rehearsed:
        (options,) = check_emulators(rehearsed.config.emulators, path)
    assert GENERATIONS[generation].major == robot_make(options).version[0]


def test_the_arm_stands_inside_the_workspace_and_the_joint_ranges():
    wide = [-6.2] * 6, [6.2] * 6
    offset = [0.0, 0.05, 0.15, 0.0, 0.0, 0.0]
    lower_m, upper_m = [0.2, 0.1, 0.1], [0.5, 0.4, 0.3]
    joints = joints_within(*wide, lower_m, upper_m, offset)
    tip = tool_frames(joints, frame_of_pose(offset))[-1]
    assert (tip[:3, 3] > lower_m).all()
    assert (tip[:3, 3] < upper_m).all()
    assert tip[2, 2] == pytest.approx(-1.0, abs=1e-3), "the tool points down"
    assert joints_within(*wide, [3.0, 3.0, 3.0], [4.0, 4.0, 4.0], offset) is None
    assert joints_within(*wide, [-1.5, -1.5, 0.0], [1.5, 1.5, 0.9], [0.0] * 6) == pytest.approx(HOME_RAD, abs=1e-3)


def test_what_cannot_be_rehearsed_is_refused(real_rig):
    path = real_rig(load_cell={"device": {"path": "x"}}, emulated=True)
    with pytest.raises(UserError, match="emulated already"), rehearsal(load_daemon_config(path), path):
        pass
    path = real_rig(fingertips={"thumb": {"device": {"serial_number": "1"}, "bank": None}})
    with (
        pytest.raises(UserError, match=r"`fingertips\.thumb` has no `bank`"),
        rehearsal(load_daemon_config(path), path),
    ):
        pass


@pytest.mark.long
async def test_a_sensor_alone_is_rehearsed_and_every_line_says_so(real_rig):
    async with shearloop(
        "run", str(real_rig("skin", "load_cell", skin=skin_of_the_demo())), "--emulate", "--show"
    ) as daemon:
        # The first readings come before the current source answers.
        while " N" not in (line := (await daemon.stdout.readline()).decode()):
            assert line.startswith("EMULATED"), line
        assert line.startswith("EMULATED"), line


def skin_of_the_demo() -> dict[str, Any]:
    calibration = Path(__file__).parents[2] / "config" / "calibrations" / "skin_demo.yaml"
    return {**REAL["skin"], "calibration": str(calibration)}


@pytest.mark.usefixtures("ur_rtde")
def test_an_experiment_beyond_the_cap_is_refused_as_on_the_real_rig(real_rig, capsys):
    path = real_rig("robot", "gripper", "load_cell", experiment="short.yaml")
    assert main(["run", str(path), "--emulate"]) == 2
    printed = capsys.readouterr()
    assert "EMULATED: the robot is capped at 0.2 rad/s" in printed.out
    assert "has speed_rad_per_s 0.3 rad/s: write 0.2 or less" in printed.err


def report_of_emulated(path: Path) -> Report:
    """Return what `commission --emulate` measures of a rig: the stages that raise the wrist's speed."""
    config = load_daemon_config(path)
    rig = identity_of(config, "5.17.3.0", "EMULATED").model_copy(update={"emulated": True})
    line = Line(what="w", value="v", verdict="passed")
    stages = [
        StageResult(
            stage=f"{number} s",
            operator="Ada",
            date=datetime.now(UTC),
            lines=(line,),
            supplies=Supplied(wrist_speed_rad_per_s=0.5),
            judged_sha256s=judged_by(number, judged_sha256s(config)),
        )
        for number in "0134"
    ]
    return Report(rig=rig, stages=tuple(stages))


@pytest.mark.real_time
@pytest.mark.usefixtures("ur_rtde")
async def test_the_experiment_of_a_real_configuration_runs_to_its_end_with_the_limits_that_a_report_raises(real_rig):
    path = real_rig("robot", "gripper", "load_cell", experiment="short.yaml", commissioned="emulated.yaml")
    write_report(path.with_name("emulated.yaml"), report_of_emulated(path))
    async with shearloop("run", str(path), "--emulate") as daemon:
        out, log = await asyncio.wait_for(daemon.communicate(), 90)
    assert daemon.returncode == 0, log.decode()
    assert "EMULATED: every device was emulated on this computer." in out.decode()
    assert "capped at 0.5 rad/s, 0.05 m/s and 0.3 N·m: its report of emulated devices covers no more" in out.decode()
    assert "'short' was done" in out.decode()
    assert all("EMULATED" in line for line in log.decode().splitlines())
