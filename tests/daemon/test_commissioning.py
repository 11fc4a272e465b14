"""The cap on a robot that is not commissioned, each reason for it, and what a report raises and supplies."""

import dataclasses
import hashlib
import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import yaml

from shearloop.cli import main
from shearloop.cli.rehearsed_config import RehearsedConfig
from shearloop.daemon.commissioning_report import Line, Report, StageResult
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.experiment_files import ExperimentFiles, InvalidExperimentError
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.motion_cap import CAPPED_M_PER_S, CAPPED_NM, CAPPED_RAD_PER_S
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.report_validity import MAX_AGE_DAYS, load_report, old_stages
from shearloop.daemon.rig import make_loop
from shearloop.daemon.rig_identity import identity_of, judged_by, judged_sha256s, source_sha256
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED, Supplied, measured_widths
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import RobotLostError, WorkerPhase
from shearloop.drivers.ur.settings import read_settings
from shearloop.errors import UserError
from shearloop.tools.commission.report import earlier_report, write_report
from shearloop.tools.doctor import check_cap
from shearloop.tools.doctor.devices import check_identity
from tests.fixtures.daemons import ask, collector, robot_at, running_daemon
from tests.fixtures.robots import filled_in

NOW = datetime(2026, 11, 1, tzinfo=UTC)
VERSION, SERIAL = "5.17.3.0", "20235500001"
SUPPLIED = Supplied(
    wrist_speed_rad_per_s=0.5,
    torque_nm=0.4,
    rest_rad_per_s=0.005,
    actuation_s=0.03,
    reaction_s=0.045,
    stop_rad=0.15,
    widths=((70.0, 100.0), (102.0, 80.0), (134.0, 60.0), (166.0, 40.0), (198.0, 20.0)),
)


def write_rig(folder: Path, *, wrist: float = 0.8, **content: object) -> Path:
    robot = filled_in()
    robot["limits"]["wrist_speed_rad_per_s"] = {"inner": wrist, "hard": 1.5 * wrist}
    # So fast a wrist stands within 0.2 s where it brakes harder.
    robot["limits"]["wrist_acceleration_rad_per_s2"]["hard"] = 12.0
    robot["limits"]["linear_speed_m_per_s"] = {"inner": 0.2, "hard": 0.3}
    (folder / "ur.yaml").write_text(yaml.safe_dump(robot))
    path = folder / "rig.yaml"
    rig = {"load_cell": {"device": {"serial_number": "7583"}}, "robot": "ur.yaml"}
    path.write_text(yaml.safe_dump(rig | content))
    return path


def report_of(
    path: Path, stages: str = "01357", supplies: Supplied = NOTHING_SUPPLIED, verdict: str = "passed"
) -> Report:
    """Return a report of a rig with these stages; each supplies the same."""
    config = load_daemon_config(path)
    hashes = judged_sha256s(config)
    results = [
        StageResult(
            stage=f"{number} s",
            operator="O",
            date=NOW,
            lines=(Line(what="w", value="v", verdict=verdict),),
            supplies=supplies,
            judged_sha256s=judged_by(number, hashes),
        )
        for number in stages
    ]
    return Report(rig=identity_of(config, VERSION, SERIAL), stages=tuple(results))


def commissioned(folder: Path, report: Report, now: datetime = NOW, **content: object):
    """Return what a rig's report allows."""
    write_report(folder / "report.yaml", report)
    path = write_rig(folder, commissioned="report.yaml", **content)
    config = load_daemon_config(path)
    return commissioning_of(config, read_settings(config.robot), now)


def caps(found) -> tuple[float, float, float]:
    return found.cap.wrist_speed_rad_per_s, found.cap.linear_speed_m_per_s, found.cap.torque_nm


def test_a_robot_without_a_report_is_capped_where_its_process_and_its_script_clip(tmp_path):
    config = load_daemon_config(write_rig(tmp_path))
    found = commissioning_of(config, read_settings(config.robot), NOW)
    limits = found.settings.limits
    assert (limits.wrist_speed_rad_per_s.inner, limits.linear_speed_m_per_s.inner) == (CAPPED_RAD_PER_S, CAPPED_M_PER_S)
    assert limits.wrist_speed_rad_per_s.hard < 0.4, "a measured speed far above the cap stops the motion"
    assert make_loop(config, found.settings, {}, {}).config.wrist_speed_rad_per_s == CAPPED_RAD_PER_S
    assert "commissioned" in found.cap.why


def test_an_emulated_robot_needs_no_report(tmp_path):
    path = write_rig(tmp_path, emulated=True, load_cell={"device": {"path": "cell"}})
    config = load_daemon_config(path)
    settings = read_settings(config.robot)
    found = commissioning_of(config, settings, NOW)
    assert (found.cap, found.settings, found.sentence) == (None, settings, "")


def changed(report: Report, **rig: str | bool) -> Report:
    return report.model_copy(update={"rig": report.rig.model_copy(update=rig)})


def with_a_stage_of(report: Report, date: datetime) -> Report:
    """Return the report whose last stage alone has another date."""
    *stages, last = report.stages
    return report.model_copy(update={"stages": (*stages, last.model_copy(update={"date": date}))})


def with_a_failed_line(report: Report) -> Report:
    first, *others = report.stages
    failed = first.model_copy(update={"lines": (Line(what="w", value="v", verdict="failed"),)})
    return report.model_copy(update={"stages": (failed, *others)})


@pytest.mark.parametrize(
    ("change", "now", "why"),
    [
        (lambda report: changed(report, emulated=True), NOW, "of emulated devices, and raises nothing on real ones"),
        (lambda report: changed(report, robot_serial_number="EMULATED"), NOW, "of emulated devices"),
        (lambda report: changed(report, configuration_sha256="0"), NOW, "the devices in the configuration"),
        (lambda report: changed(report, robot_settings_sha256="0"), NOW, "the robot's settings"),
        (lambda report: changed(report, script_sha256="0"), NOW, "the script for the robot"),
        (lambda report: changed(report, ur_rtde="1.0"), NOW, "the version of ur-rtde"),
        (lambda report: report.model_copy(update={"stages": ()}), NOW, "no stage"),
        (lambda report: report, NOW + timedelta(days=MAX_AGE_DAYS, hours=1), "older than"),
        (lambda report: report, NOW - timedelta(days=2), "in the future"),
        (lambda report: with_a_stage_of(report, NOW + timedelta(days=2)), NOW, "in the future"),
        (lambda report: with_a_stage_of(report, NOW - timedelta(days=MAX_AGE_DAYS + 1)), NOW, "older than"),
    ],
)
def test_a_report_that_does_not_count_raises_and_supplies_nothing(tmp_path, change, now, why):
    report = change(report_of(write_rig(tmp_path), "013457", SUPPLIED))
    found = commissioned(tmp_path, report, now)
    assert why in found.cap.why
    assert caps(found) == (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)
    assert found.supplied == NOTHING_SUPPLIED


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("torque_nm", 50.0),
        ("torque_nm", float("inf")),
        ("torque_nm", -1.0),
        ("wrist_speed_rad_per_s", -0.1),
        ("rest_rad_per_s", 0.5),
        ("rest_rad_per_s", float("nan")),
        ("actuation_s", -0.01),
        ("reaction_s", 40.0),
        ("stop_rad", float("inf")),
        ("widths", [[70.0, 1000.0], [198.0, 20.0]]),
        ("widths", [[70.0, float("nan")], [198.0, 20.0]]),
        ("torque_sources", {"right": "a hash"}),
    ],
)
def test_a_report_with_a_value_that_no_stage_measures_is_refused(tmp_path, key, value):
    path = tmp_path / "report.yaml"
    write_report(path, report_of(write_rig(tmp_path), "7", SUPPLIED))
    written = yaml.safe_load(path.read_text())
    written["stages"][0]["supplies"][key] = value
    path.write_text(yaml.safe_dump(written))
    with pytest.raises(UserError, match=key):
        load_report(path)


def test_a_value_beyond_its_range_names_the_way_to_a_report_without_it(tmp_path):
    """It invites nobody to edit a measurement."""
    path = tmp_path / "report.yaml"
    write_report(path, report_of(write_rig(tmp_path), "7", SUPPLIED))
    written = yaml.safe_load(path.read_text())
    written["stages"][0]["supplies"]["rest_rad_per_s"] = 0.08
    path.write_text(yaml.safe_dump(written))
    with pytest.raises(UserError) as refused:
        load_report(path)
    assert str(refused.value).endswith(f"This report cannot be continued: {NEW}")


def test_the_values_of_a_failed_stage_are_left_out_whatever_they_are(tmp_path, capsys):
    """An earlier version wrote the noise that failed the stage, and the range of rest ends before it."""
    write_report(tmp_path / "report.yaml", report_of(write_rig(tmp_path), "0134", SUPPLIED))
    written = yaml.safe_load((tmp_path / "report.yaml").read_text())
    failed = written["stages"][2]
    failed["lines"][0]["verdict"], failed["supplies"] = "failed", {"rest_rad_per_s": 0.08}
    (tmp_path / "report.yaml").write_text(yaml.safe_dump(written))
    report = earlier_report(tmp_path / "report.yaml")
    assert report.stage("3").supplies == NOTHING_SUPPLIED
    assert report.stage("4").supplies == SUPPLIED, "another stage keeps its values"
    assert main(["check", str(write_rig(tmp_path, commissioned="report.yaml"))]) == 0
    assert "says that w in stage 3 s failed; mend the cause, and run" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["", "tool and spring"])
def test_a_stage_without_a_number_is_refused(tmp_path, name):
    path = tmp_path / "report.yaml"
    write_report(path, report_of(write_rig(tmp_path), "7", SUPPLIED))
    written = yaml.safe_load(path.read_text())
    written["stages"][0]["stage"] = name
    path.write_text(yaml.safe_dump(written))
    with pytest.raises(UserError, match="stage"):
        load_report(path)


NEW = (
    "run `shearloop commission CONFIG --out NEW_FILE`, then write the line `commissioned: …` that it prints at its end "
    "into the configuration"
)
AGAIN = "run `shearloop commission CONFIG --out FILE"


@pytest.mark.parametrize(
    ("change", "now", "cure"),
    [
        (lambda report: changed(report, emulated=True), NOW, NEW),
        (lambda report: changed(report, configuration_sha256="0"), NOW, NEW),
        (lambda report: report.model_copy(update={"stages": ()}), NOW, f"{AGAIN}`"),
        (with_a_failed_line, NOW, f"mend the cause, and {AGAIN}`"),
        (lambda report: with_a_stage_of(report, NOW - timedelta(days=181)), NOW, f"{AGAIN} --stages 7`"),
        (
            lambda report: with_a_stage_of(report, NOW + timedelta(days=2)),
            NOW,
            f"set the clock, or {AGAIN} --stages 7`",
        ),
    ],
)
def test_each_reason_against_a_report_has_the_cure_that_removes_it(tmp_path, change, now, cure):
    """Values that two stages judge have changed too, and measuring these again would not be enough."""
    report = report_of(write_rig(tmp_path), "013457", SUPPLIED)
    write_report(tmp_path / "report.yaml", change(report))
    path = write_rig(tmp_path, commissioned="report.yaml")
    if cure == NEW:
        rewrite(tmp_path / "ur.yaml", reaction_s=0.05)
    config = load_daemon_config(path)
    assert commissioning_of(config, read_settings(config.robot), now).cap.cure == cure


def test_another_controller_needs_a_new_report(tmp_path):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", SUPPLIED))
    found.on_controller(VERSION, "20235500002")
    assert found.cap.cure == NEW


def test_a_rehearsal_continues_a_report_on_the_devices_that_it_is_of(tmp_path):
    for emulated, option in ((True, " --emulate"), (False, "")):
        report = changed(report_of(write_rig(tmp_path), "013457", SUPPLIED), emulated=emulated)
        found = rehearsing(tmp_path, with_a_stage_of(report, NOW - timedelta(days=181)))
        assert found.cap.cure == f"{AGAIN}{option} --stages 7`"


def rehearsing(folder: Path, report: Report | None, **content: object):
    """Return what a report allows in a rehearsal of a rig, which has other addresses."""
    real = load_daemon_config(write_rig(folder, **content))
    if report is not None:
        write_report(folder / "report.yaml", report)
        real = load_daemon_config(write_rig(folder, commissioned="report.yaml", **content))
    played = {"load_cell": {"device": {"path": "cell"}}, "emulated": True, "commissioned": real.commissioned}
    config = RehearsedConfig(real, {**played, "robot": real.robot})
    return commissioning_of(config, read_settings(config.robot), NOW)


def test_a_rehearsal_has_the_cap_of_the_rig_that_it_plays(tmp_path):
    found = rehearsing(tmp_path, None)
    assert caps(found) == (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)
    assert found.settings.limits.wrist_speed_rad_per_s.inner == CAPPED_RAD_PER_S
    assert found.cap.cure == (
        "run `shearloop commission CONFIG --out FILE --emulate`, then rehearse with the option `--set commissioned=…` "
        "that it prints at its end"
    )


@pytest.mark.parametrize("emulated", [True, False])
def test_a_report_of_emulated_or_of_real_devices_raises_a_rehearsal(tmp_path, emulated):
    report = changed(report_of(write_rig(tmp_path), "013457", SUPPLIED), emulated=emulated)
    found = rehearsing(tmp_path, report)
    assert found.counts
    assert caps(found) == (0.5, CAPPED_M_PER_S, 0.4)
    found.on_controller("5.11.0.0", "EMULATED")
    assert found.counts, "the controller of a rehearsal is never the report's"
    assert ("of emulated devices covers no more" in found.sentence) == emulated


@pytest.mark.parametrize("rehearsed", [True, False])
@pytest.mark.parametrize("serial_number", [SERIAL, ""])
def test_an_emulated_rig_takes_no_controller_but_an_emulated_one(tmp_path, rehearsed, serial_number):
    robot_at("127.0.0.1", tmp_path)
    played = load_daemon_config(write_rig(tmp_path)).model_copy(update={"emulated": True})
    found = rehearsing(tmp_path, None) if rehearsed else commissioning_of(played, read_settings(played.robot), NOW)
    assert found.on_controller(VERSION, "EMULATED") == found.settings
    with pytest.raises(RobotLostError, match=rf"its serial number is {serial_number or 'unknown'}, not EMULATED") as no:
        found.on_controller(VERSION, serial_number)
    assert no.value.kind == "not-emulated"


def test_a_rehearsal_of_another_rig_is_not_raised(tmp_path):
    report = changed(report_of(write_rig(tmp_path), "013457", SUPPLIED), emulated=True)
    found = rehearsing(tmp_path, report, wrist=0.7)
    assert found.cap.cure.endswith(
        "--out NEW_FILE --emulate`, then rehearse with the option `--set commissioned=…` that it prints at its end"
    )
    assert "the robot's settings changed" in found.cap.why
    assert caps(found) == (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)


def test_one_failed_line_caps(tmp_path):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", SUPPLIED, "failed"))
    assert "w in stage 0 s failed" in found.cap.why
    assert caps(found) == (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)


@pytest.mark.parametrize(
    ("stages", "raised"),
    [
        ("013457", (0.5, CAPPED_M_PER_S, 0.4)),
        ("0134", (0.5, CAPPED_M_PER_S, CAPPED_NM)),
        ("034", (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)),
        ("01357", (CAPPED_RAD_PER_S, CAPPED_M_PER_S, 0.4)),
        ("0137", (CAPPED_RAD_PER_S, CAPPED_M_PER_S, CAPPED_NM)),
    ],
)
def test_a_report_raises_only_what_its_stages_cover(tmp_path, stages, raised):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), stages, SUPPLIED))
    assert caps(found) == raised
    assert found.settings.limits.wrist_speed_rad_per_s.inner == raised[0], "the settings alone would allow 0.8 rad/s"


def test_a_report_supplies_rest_delay_stop_margin_and_widths(tmp_path):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", SUPPLIED))
    settings = found.settings
    assert (settings.rest_rad_per_s, settings.reaction_s) == (0.005, 0.045)
    assert settings.limits.joints.margin_rad == 0.15
    config = load_daemon_config(tmp_path / "rig.yaml")
    assert make_loop(config, settings, {}, {}, found.supplied).config.actuation_s == 0.03
    widths = measured_widths(found.supplied, "2F-140")
    assert widths.width_mm(134.0) == pytest.approx(60.0, abs=0.1)
    assert measured_widths(NOTHING_SUPPLIED, "2F-140") is None


@pytest.mark.parametrize(("version", "serial"), [("5.17.4.0", SERIAL), (VERSION, "20235500002")])
def test_another_controller_is_capped_once_it_is_connected(tmp_path, version, serial):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", SUPPLIED))
    full = found.settings
    assert found.on_controller(version, serial).limits.wrist_speed_rad_per_s.inner == CAPPED_RAD_PER_S
    assert "changed since its report" in found.sentence
    assert found.on_controller(VERSION, SERIAL) == full


BEYOND = [
    ({"do": "turn_to", "angle_rad": 0.1, "speed_rad_per_s": 0.21}, "speed_rad_per_s 0.21 rad/s"),
    ({"do": "approach", "along_tool_m": 0.01, "speed_m_per_s": 0.06}, "speed_m_per_s 0.06 m/s"),
    ({"do": "twist", "angles_rad": [0.1], "limits": {"torque_nm": 0.31}}, "limits.torque_nm 0.31 N·m"),
]


@pytest.mark.parametrize(("step", "named"), BEYOND)
def test_an_experiment_that_asks_for_more_is_refused_with_its_key_and_a_cure(tmp_path, step, named, capsys):
    rig = write_rig(tmp_path)
    path = tmp_path / "one.yaml"
    content = {"name": "one", "torque_source": "load_cell", "limits": {"torque_nm": 0.4}, "steps": [step]}
    path.write_text(yaml.safe_dump(content))
    assert main(["check", str(path), "--config", str(rig)]) == 2
    printed = capsys.readouterr()
    assert named in printed.err
    assert "shearloop commission" in printed.err
    assert "REFUSED" in printed.out


def refusal_of(folder: Path, rig: Path, capsys, **limits: float) -> str:
    """Return why `check` refuses to hold 0.3 N·m with this limit."""
    steps = [{"do": "identify"}, {"do": "hold_torque", "torque_nm": 0.3, "hold_s": 1}]
    content = {"name": "one", "torque_source": "load_cell", "limits": limits, "steps": steps}
    path = folder / "one.yaml"
    path.write_text(yaml.safe_dump(content))
    main(["check", str(path), "--config", str(rig)])
    return capsys.readouterr().err


def test_the_advice_under_a_cap_does_not_lead_in_a_circle(tmp_path, capsys):
    """The limit may be 0.3 N·m, and a task has to be gentler than its limit."""
    rig = write_rig(tmp_path)
    above, at = (refusal_of(tmp_path, rig, capsys, torque_nm=limit_nm) for limit_nm in (0.4, 0.3))
    assert "write 0.3 or less, and ask for less than 0.3 N·m, because the robot is capped" in above
    assert "asks for 0.3 N·m, and its limit is 0.3 N·m; ask for less, because the robot is capped" in at
    assert "raise limits.torque_nm" not in at


CALIBRATED = {"right": {"device": {"serial_number": "1"}, "calibration": "right.cal"}}


def raised_by(folder: Path, **content: object):
    """Return the cap of a rig whose stage 7 measured the fingertip, with its present configuration."""
    path = write_rig(folder, fingertips=CALIBRATED)
    own = source_sha256(load_daemon_config(path), "right")
    report = report_of(path, "013457", SUPPLIED.model_copy(update={"torque_sources": {"right": own, "wrench": ""}}))
    write_report(folder / "report.yaml", report)
    config = load_daemon_config(
        write_rig(folder, **{"commissioned": "report.yaml", "fingertips": CALIBRATED, **content})
    )
    return commissioning_of(config, read_settings(config.robot), NOW)


def test_the_raised_torque_is_of_the_sources_that_stage_7_measured(tmp_path):
    (tmp_path / "right.cal").write_bytes(b"one")
    found = raised_by(tmp_path)
    torques = {
        name: found.cap.torque_nm_of(name) for name in ("load_cell", "right", "wrench", "skin", "left", "combined")
    }
    assert torques == {"load_cell": 0.4, "right": 0.4, "wrench": 0.4, "skin": 0.3, "left": 0.3, "combined": 0.3}
    assert "0.4 N·m (load_cell, right, wrench; any other source 0.3 N·m)" in found.sentence


def test_a_source_that_no_stage_compares_raises_nothing_whatever_the_report_says(tmp_path):
    of_nothing = SUPPLIED.model_copy(update={"torque_sources": {"skin": "", "left": "", "wrench": ""}})
    cap = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", of_nothing)).cap
    assert cap.torque_sources == ("load_cell", "wrench")


def test_another_calibration_of_a_fingertip_lowers_its_torque_alone(tmp_path):
    (tmp_path / "right.cal").write_bytes(b"one")
    cap = raised_by(tmp_path, fingertips={"right": {**CALIBRATED["right"], "creep": {"share": 0.1, "time_s": 9}}}).cap
    assert (cap.torque_nm_of("load_cell"), cap.torque_nm_of("right")) == (0.4, 0.3)
    config = load_daemon_config(tmp_path / "rig.yaml")
    before = source_sha256(config, "right")
    (tmp_path / "right.cal").write_bytes(b"another")
    assert source_sha256(config, "right") != before


def test_a_report_of_before_raises_the_torque_of_the_load_cell_alone(tmp_path):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "01357", SUPPLIED))
    assert (found.cap.torque_nm_of("load_cell"), found.cap.torque_nm_of("skin")) == (0.4, 0.3)


def test_an_experiment_of_another_source_is_refused_beyond_its_cap(tmp_path, capsys):
    report = report_of(write_rig(tmp_path), "01357", SUPPLIED)
    dated = [stage.model_copy(update={"date": datetime.now(UTC)}) for stage in report.stages]
    write_report(tmp_path / "report.yaml", report.model_copy(update={"stages": tuple(dated)}))
    rig = write_rig(tmp_path, commissioned="report.yaml")
    step, limits = {"do": "twist", "angles_rad": [0.1]}, {"torque_nm": 0.35}
    path = tmp_path / "one.yaml"
    for source, status in (("load_cell", 0), ("wrench", 2)):
        path.write_text(yaml.safe_dump({"name": "one", "torque_source": source, "limits": limits, "steps": [step]}))
        assert main(["check", str(path), "--config", str(rig)]) == status, source
    assert "limits.torque_nm 0.35 N·m: write 0.3 or less" in capsys.readouterr().err


@pytest.mark.parametrize(("angle_rad", "status"), [(0.1, 0), (-0.1, 2)])
def test_an_experiment_that_twists_away_from_a_one_way_lever_is_refused(tmp_path, capsys, angle_rad, status):
    cell = {"device": {"serial_number": "7583"}, "direction": "counterclockwise"}
    rig = write_rig(tmp_path, load_cell=cell)
    steps = [{"do": "twist", "angles_rad": [angle_rad]}]
    path = tmp_path / "one.yaml"
    path.write_text(yaml.safe_dump({"name": "one", "torque_source": "load_cell", "steps": steps}))
    assert main(["check", str(path), "--config", str(rig)]) == status
    assert ("turns clockwise, and load_cell measures no torque" in capsys.readouterr().err) == (status == 2)


RELEASE, GRIP, CCW, CW = {"do": "release"}, {"do": "grip"}, "counterclockwise", "clockwise"
TIGHTEN = {"do": "tighten", "until_torque_nm": 0.32, "until_angle_rad": 0.6, "direction": CCW}
IDENTIFY = {"do": "identify", "limits": {"torque_nm": 0.3}}


def twist_to(*angles_rad: float, **keys: object) -> dict[str, object]:
    return {"do": "twist", "angles_rad": list(angles_rad), "return_to_start": False, **keys}


@pytest.mark.parametrize(
    ("steps", "refused"),
    [
        ([RELEASE, GRIP, twist_to(0.1)], ""),
        ([RELEASE, GRIP, twist_to(0.1, 0.2), twist_to(0.3)], ""),
        ([RELEASE, GRIP, IDENTIFY, {"do": "hold_torque", "torque_nm": 0.32}], ""),
        ([TIGHTEN], ""),
        ([GRIP, TIGHTEN, {"do": "hold_torque", "torque_nm": 0.0}], "hold_torque needs an identified tool"),
        # A tool may be held, and turned, before the start.
        ([twist_to(0.1)], "twist has limits.torque_nm 0.35 N·m, and may load the tool clockwise: write 0.3 or less"),
        ([GRIP, twist_to(0.1)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.1, return_to_start=True)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.1, -0.1)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.5, 0.1)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.1, 0.5, repeats=2)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.5), twist_to(0.1)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, TIGHTEN, twist_to(0.1)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, twist_to(0.1, absolute=True)], "twist has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, {"do": "identify"}], "identify has limits.torque_nm 0.35 N·m"),
        ([TIGHTEN | {"direction": CW}], "tighten has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, IDENTIFY, {"do": "hold_torque", "torque_nm": -0.1}], "hold_torque has limits.torque_nm"),
        ([RELEASE, GRIP, {"do": "turn_to", "angle_rad": 1.0}], "turn_to has limits.torque_nm 0.35 N·m"),
        ([RELEASE, GRIP, {"do": "approach", "along_tool_m": 0.01}], "approach has limits.torque_nm 0.35 N·m"),
        ([RELEASE, {"do": "turn_to", "angle_rad": 1.0}, {"do": "approach", "along_tool_m": 0.01}, GRIP, TIGHTEN], ""),
    ],
)
def test_a_one_way_lever_raises_the_torque_of_its_direction_alone(tmp_path, capsys, steps, refused):
    """The wrench measures both directions, but stage 7 compared one of them."""
    one_way = {"load_cell": {"device": {"serial_number": "7583"}, "direction": "counterclockwise"}}
    gripper = {"gripper": {"model": "2F-140", "socket": {"host": "192.168.1.10"}}}
    supplies = SUPPLIED.model_copy(update={"torque_sources": {"wrench": ""}})
    report = report_of(write_rig(tmp_path, **one_way, **gripper), "013457", supplies)
    dated = [stage.model_copy(update={"date": datetime.now(UTC)}) for stage in report.stages]
    write_report(tmp_path / "report.yaml", report.model_copy(update={"stages": tuple(dated)}))
    rig = write_rig(tmp_path, commissioned="report.yaml", **one_way, **gripper)
    path = tmp_path / "one.yaml"
    content = {"name": "one", "torque_source": "wrench", "limits": {"torque_nm": 0.35}, "steps": steps}
    path.write_text(yaml.safe_dump(content))
    assert main(["check", str(path), "--config", str(rig)]) == (2 if refused else 0)
    printed = capsys.readouterr().err
    assert refused in printed
    if "limits.torque_nm" in refused:
        assert "0.4 N·m (load_cell, wrench, counterclockwise alone; else 0.3 N·m)" in printed


@pytest.mark.parametrize(
    ("steps", "refused"),
    [
        ([GRIP, {"do": "turn_to", "angle_rad": 1.0}], "turn_to has limits.torque_nm 5 N·m: write 0.3 or less"),
        ([{"do": "turn_to", "angle_rad": 1.0}], "turn_to has limits.torque_nm 5 N·m: write 0.3 or less"),
        ([GRIP, {"do": "approach", "along_tool_m": 0.01}], "approach has limits.torque_nm 5 N·m: write 0.3 or less"),
        ([RELEASE, {"do": "turn_to", "angle_rad": 1.0}, {"do": "approach", "along_tool_m": 0.01}], ""),
        # A file with a mistake in a step is refused for it, and nothing is said of its turns.
        ([GRIP, {"do": "turn_to", "angle_rad": "far"}], "steps[1].angle_rad: 'far' is not a number"),
    ],
)
def test_each_step_that_may_turn_or_load_a_held_tool_is_capped(tmp_path, capsys, steps, refused):
    rig = write_rig(tmp_path, gripper={"model": "2F-140", "socket": {"host": "192.168.1.10"}})
    path = tmp_path / "one.yaml"
    content = {"name": "one", "torque_source": "load_cell", "limits": {"torque_nm": 5}, "steps": steps}
    path.write_text(yaml.safe_dump(content))
    assert main(["check", str(path), "--config", str(rig)]) == (2 if refused else 0)
    assert refused in capsys.readouterr().err


def test_a_default_that_is_written_out_keeps_the_report(tmp_path):
    plain = identity_of(load_daemon_config(write_rig(tmp_path)), VERSION, SERIAL)
    written = {"load_cell": {"device": {"serial_number": "7583"}, "rate_hz": 10.9}}
    path = write_rig(tmp_path, **written)
    assert identity_of(load_daemon_config(path), VERSION, SERIAL) == plain
    gripper = {"model": "Hand-E", "socket": {"host": "192.168.1.10"}}
    bare = identity_of(load_daemon_config(write_rig(tmp_path, gripper=gripper)), VERSION, SERIAL)
    gripper["socket"]["port"] = 63352
    assert identity_of(load_daemon_config(write_rig(tmp_path, gripper=gripper)), VERSION, SERIAL) == bare


def test_a_report_whose_configuration_wrote_a_default_out_still_counts(tmp_path):
    """An earlier version hashed the keys as they were written."""
    written = {"load_cell": {"device": {"serial_number": "7583"}, "rate_hz": 10.9}}
    report = report_of(write_rig(tmp_path, **written), "01357", SUPPLIED)
    as_written = hashlib.sha256(
        json.dumps({"load_cell": {"device": {"serial_number": "7583"}, "rate_hz": 10.9}}, sort_keys=True).encode()
    ).hexdigest()
    found = commissioned(tmp_path, changed(report, configuration_sha256=as_written), **written)
    assert found.counts
    assert not commissioned(tmp_path, changed(report, configuration_sha256="0"), **written).counts


@pytest.mark.parametrize(("model", "counts"), [("2F-140", True), ("Hand-E", False)])
def test_a_report_from_before_the_grippers_model_was_required_counts_for_that_model(tmp_path, model, counts):
    """Its configuration had no `model`, and meant a 2F-140."""
    socket = {"socket": {"host": "192.168.1.10"}}
    rig = {"gripper": {"model": model, **socket}}
    report = report_of(write_rig(tmp_path, **rig), "01357", SUPPLIED)
    devices = {"gripper": socket, "load_cell": {"device": {"serial_number": "7583"}}}
    before = hashlib.sha256(json.dumps(devices, sort_keys=True).encode()).hexdigest()
    assert commissioned(tmp_path, changed(report, configuration_sha256=before), **rig).counts == counts


GRIPPER = {"open_counts": 3.0, "closed_counts": 230.0, "open_mm": 140.0, "std_mm": 1.0}


def with_calibrations(folder: Path) -> dict[str, object]:
    (folder / "cell.yaml").write_text(yaml.safe_dump(CELL))
    (folder / "gripper.yaml").write_text(yaml.safe_dump(GRIPPER))
    return {
        "load_cell": {"device": {"serial_number": "7583"}, "calibration": "cell.yaml"},
        "gripper": {"model": "2F-140", "socket": {"host": "192.168.1.10"}, "calibration": "gripper.yaml"},
        "commissioned": "report.yaml",
    }


def test_a_comment_or_a_default_that_a_calibration_writes_out_keeps_the_report(tmp_path):
    path = write_rig(tmp_path, **with_calibrations(tmp_path))
    report = report_of(path, "01234567", SUPPLIED)
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump({"model": "2F-140", **GRIPPER}))
    (tmp_path / "cell.yaml").write_text("# weighed by Ann\n" + yaml.safe_dump({**CELL, "sign": 1}))
    assert old_stages(report, load_daemon_config(path)) == []
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump({**GRIPPER, "std_mm": 2.0}))
    ((stage, keys),) = old_stages(report, load_daemon_config(path))
    assert (stage.stage, keys) == ("2 s", ["`gripper.calibration`"])


def test_a_report_with_the_hash_of_a_calibrations_text_counts_while_the_text_is_the_same(tmp_path):
    path = write_rig(tmp_path, **with_calibrations(tmp_path))
    report = report_of(path, "2", SUPPLIED)
    text = {"gripper.calibration": hashlib.sha256((tmp_path / "gripper.yaml").read_bytes()).hexdigest()}
    (stage,) = report.stages
    report = report.model_copy(update={"stages": (stage.model_copy(update={"judged_sha256s": text}),)})
    assert old_stages(report, load_daemon_config(path)) == []
    rewrite(tmp_path / "gripper.yaml", std_mm=2.0)
    assert len(old_stages(report, load_daemon_config(path))) == 1


def test_a_report_that_was_edited_to_a_faster_wrist_is_refused(tmp_path):
    path = write_rig(tmp_path, commissioned="report.yaml")
    content = report_of(path, "0134", SUPPLIED).model_dump(mode="json", exclude_none=True)
    content["stages"][0]["supplies"]["wrist_speed_rad_per_s"] = 3.0
    (tmp_path / "report.yaml").write_text(yaml.safe_dump(content))
    config = load_daemon_config(path)
    with pytest.raises(UserError, match=r"wrist_speed_rad_per_s"):
        commissioning_of(config, read_settings(config.robot), NOW)


async def test_a_running_daemon_refuses_an_experiment_beyond_the_cap(tmp_path):
    path = tmp_path / "one.yaml"
    content = {"name": "one", "limits": {"torque_nm": 0.3}, "steps": [BEYOND[0][0]]}
    path.write_text(yaml.safe_dump(content))
    config = load_daemon_config(write_rig(tmp_path))
    robot = commissioning_of(config, read_settings(config.robot), NOW)
    files = ExperimentFiles((tmp_path,), config, {}, robot, LoadedFiles(()))
    with pytest.raises(InvalidExperimentError):
        await files.read(path)


def test_check_and_doctor_say_that_the_cap_holds(tmp_path, capsys):
    path = write_rig(tmp_path)
    assert main(["check", str(path)]) == 0
    assert "capped at 0.2 rad/s, 0.05 m/s and 0.3 N·m" in capsys.readouterr().out
    (finding,) = check_cap(load_daemon_config(path))
    assert (finding.state, "capped" in finding.found, "commission" in finding.next_step) == ("note", True, True)


def test_doctor_compares_the_controller_with_settings_and_report(tmp_path):
    report = report_of(write_rig(tmp_path), "013457", SUPPLIED)
    dated = [stage.model_copy(update={"date": datetime.now(UTC)}) for stage in report.stages]
    write_report(tmp_path / "report.yaml", report.model_copy(update={"stages": tuple(dated)}))
    config = load_daemon_config(write_rig(tmp_path, commissioned="report.yaml"))
    settings = read_settings(config.robot)
    assert list(check_identity(config, settings, VERSION, SERIAL)) == []
    (other,) = check_identity(config, settings, VERSION, "20235500002")
    assert (other.subject, other.state) == ("commissioned robot", "note")
    assert "the robot's serial number changed since its report" in other.found
    (generation, _) = check_identity(config, settings, "3.15.8.0", SERIAL)
    assert (generation.subject, generation.state) == ("robot's generation", "trouble")
    assert "write `generation: cb3` into them" in generation.found


def test_a_missing_report_is_a_mistake_of_the_configuration(tmp_path):
    config = load_daemon_config(write_rig(tmp_path, commissioned="absent.yaml"))
    with pytest.raises(UserError, match=r"absent\.yaml.*shearloop commission"):
        commissioning_of(config, read_settings(config.robot), NOW)


def test_a_report_that_is_named_from_the_shells_folder_is_found_beside_the_configuration(tmp_path):
    report = report_of(write_rig(tmp_path), "0")
    write_report(tmp_path / "report.yaml", report)
    config = load_daemon_config(write_rig(tmp_path, commissioned="my-rig/report.yaml"))
    with pytest.raises(UserError, match=f"did you mean {tmp_path / 'report.yaml'}[?]"):
        commissioning_of(config, read_settings(config.robot), NOW)


def test_the_report_key_and_the_experiment_do_not_change_the_rigs_identity(tmp_path):
    plain = identity_of(load_daemon_config(write_rig(tmp_path)), VERSION, SERIAL)
    path = write_rig(tmp_path, commissioned="report.yaml", experiment="other.yaml", name="other")
    assert identity_of(load_daemon_config(path), VERSION, SERIAL) == plain
    path = write_rig(tmp_path, load_cell={"device": {"serial_number": "7584"}})
    assert identity_of(load_daemon_config(path), VERSION, SERIAL) != plain


def rewrite(path: Path, **keys: object) -> None:
    """Change keys of a YAML file, and write it without its comments."""
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | keys))


def limits_of(path: Path, **keys: object) -> dict[str, object]:
    return {"limits": yaml.safe_load(path.read_text())["limits"] | keys}


CELL = {"tare_counts": 0.0, "scale_n_per_count": 0.001}


@pytest.mark.parametrize(
    ("change", "stages", "key"),
    [
        (lambda at: rewrite(at / "ur.yaml", reaction_s=0.05), "3", "reaction_s"),
        (lambda at: rewrite(at / "ur.yaml", rest_rad_per_s=0.02), "34", "rest_rad_per_s"),
        (
            lambda at: rewrite(at / "ur.yaml", **limits_of(at / "ur.yaml", torque_nm={"inner": 20.0, "hard": 25.0})),
            "5",
            "limits.torque_nm",
        ),
        (lambda at: rewrite(at / "cell.yaml", scale_n_per_count=0.002), "67", "load_cell.calibration"),
        (lambda at: rewrite(at / "cell.yaml", tare_counts=5.0, scale_n_per_count=0.002), "67", "load_cell.calibration"),
    ],
)
def test_what_some_stages_judged_makes_them_old_and_no_other(tmp_path, change, stages, key):
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(CELL))
    cell = {"device": {"serial_number": "7583"}, "calibration": "cell.yaml"}
    path = write_rig(tmp_path, load_cell=cell, commissioned="report.yaml")
    write_report(tmp_path / "report.yaml", report_of(path, "0134567", SUPPLIED))
    config = load_daemon_config(path)
    assert commissioning_of(config, read_settings(config.robot), NOW).counts
    before = identity_of(config, VERSION, SERIAL)
    change(tmp_path)
    config = load_daemon_config(path)
    cap = commissioning_of(config, read_settings(config.robot), NOW).cap
    assert f"`{key}` changed since stage {' and '.join(f'{stage} s' for stage in stages)} of" in cap.why
    cure = f"run `shearloop commission CONFIG --out FILE --stages {stages}`"
    assert cap.cure == cure, "one cure, which names every stage"
    assert identity_of(config, VERSION, SERIAL) == before, "the other stages count"


def test_a_rig_that_was_moved_to_another_folder_is_the_same(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    for folder in (one, other):
        folder.mkdir()
        (folder / "cell.yaml").write_text(yaml.safe_dump(CELL))
    cell = {"device": {"serial_number": "7583"}, "calibration": "cell.yaml"}
    here, there = (load_daemon_config(write_rig(folder, load_cell=cell)) for folder in (one, other))
    assert identity_of(here, VERSION, SERIAL) == identity_of(there, VERSION, SERIAL)
    assert judged_sha256s(here) == judged_sha256s(there)


def test_a_short_delay_that_was_measured_does_not_shorten_the_way_to_brake(tmp_path):
    path = write_rig(tmp_path)
    rewrite(tmp_path / "ur.yaml", reaction_s=0.05)
    config = load_daemon_config(path)
    assert SUPPLIED.reaction_s < 0.05
    report = report_of(path, "01357", SUPPLIED)
    write_report(tmp_path / "report.yaml", report)
    found = commissioning_of(
        config.model_copy(update={"commissioned": tmp_path / "report.yaml"}), read_settings(config.robot), NOW
    )
    assert found.counts
    assert found.settings.reaction_s == 0.05


def test_the_robots_process_starts_again_with_the_limits_for_its_controller(tmp_path):
    found = commissioned(tmp_path, report_of(write_rig(tmp_path), "013457", SUPPLIED))
    robot = UrRobot(found.settings, settings_for=found.on_controller)
    same, other = (WorkerPhase("connecting", "", (VERSION, serial)) for serial in (SERIAL, "2"))
    robot.handle_message(0, same)
    with pytest.raises(RobotLostError, match="starts again with the limits"):
        robot.handle_message(0, other)
    assert robot.settings.limits.wrist_speed_rad_per_s.inner == CAPPED_RAD_PER_S
    # The new process meets the same controller.
    robot.handle_message(0, other)
    with pytest.raises(RobotLostError):
        robot.handle_message(0, same)
    assert robot.settings.limits.wrist_speed_rad_per_s.inner == 0.5


@pytest.mark.long
@pytest.mark.usefixtures("ur_rtde")
async def test_status_and_health_say_that_the_cap_holds(config, tmp_path):
    robot_at("127.0.0.9", tmp_path)
    async with running_daemon(config(robot="ur.yaml")) as daemon:
        health = collector(daemon, "health")
        assert "capped at 0.2 rad/s" in (await ask(daemon, "status"))["cap"]
        assert "`commissioned` is not in the configuration" in (await health.get())["cap"]


def test_settings_are_compared_without_their_cap(tmp_path):
    """A cap lowers nothing that is lower already."""
    config = load_daemon_config(write_rig(tmp_path, wrist=0.1))
    settings = read_settings(config.robot)
    limits = commissioning_of(config, settings, NOW).settings.limits
    assert dataclasses.replace(limits, linear_speed_m_per_s=settings.limits.linear_speed_m_per_s) == settings.limits
