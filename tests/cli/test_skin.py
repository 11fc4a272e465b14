import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from shearloop.cli.skin import _table
from shearloop.daemon.sensing.skin_estimator import are_exchanged
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.estimation.skin.membrane import THICK_SECTION, UNSTRETCHED, Membrane
from shearloop.studies.skin.characterisation import FigureOfMerit, loop, responses


@pytest.mark.usefixtures("fonts")
def test_characterise_holds_the_models_against_the_paper_and_draws_its_figures(tmp_path, ran):
    printed = ran("skin", "characterise", "--json", "--out", tmp_path / "figures")
    rows = {row["quantity"]: row for row in json.loads(printed.out)}
    for normal_n in (0.5, 1.0, 1.5, 2.0):
        row = rows[f"sensitivity, fit through origin, Fn = {normal_n} N"]
        assert row["membrane"] == pytest.approx(float(row["paper_computed"]), rel=0.03)
        assert row["two_d"] == pytest.approx(float(row["paper_computed"]), rel=0.13)
    assert rows["slope without friction"]["membrane"] == pytest.approx(0.088, rel=0.07)
    assert rows["deadband, Fn = 1 N"]["membrane"] == pytest.approx(0.04, abs=0.003)
    upturn = rows["response at 1.6 N above the line, Fn = 1 N"]
    assert 0 < upturn["two_d"] < upturn["membrane"] < 7
    assert rows["response to 2 N of normal force alone"]["two_d"] < 1e-6

    drawn = sorted((tmp_path / "figures").iterdir())
    names = ["deadband", *(f"figure_{number}" for number in range(4, 9))]
    assert [path.name for path in drawn] == [f"{name}.{kind}" for name in names for kind in ("png", "svg")]
    assert 0 < rows["slope within the deadband, Fn = 1 N"]["two_d"] < 0.01
    assert 0 < rows["change of sensitivity over 15 K, zero from before"]["two_d"] < 2
    assert all(path.stat().st_size > 10_000 for path in drawn)
    assert printed.err.count("drawn: ") == 12

    table = _table(tuple(FigureOfMerit(**row) for row in rows.values()))
    assert len(table.splitlines()[1:]) > len(rows)
    assert max(map(len, table.splitlines())) < 130
    assert "0.0802" in table


def test_figures_that_cannot_be_written_are_a_sentence(tmp_path, mistake):
    (tmp_path / "file").write_text("in the way")
    assert "the figures cannot be written" in mistake("skin", "characterise", "--out", tmp_path / "file")


def write_table(path: Path) -> None:
    lines = ["r1_ohm,r2_ohm,shear_n,normal_n"]
    for normal_n in (0.5, 1.5):
        lines.append("25.0,25.5,0,0")
        shear_n = loop(1.1)
        for shear, response in zip(
            shear_n, responses(Membrane(THICK_SECTION), shear_n.tolist(), normal_n), strict=True
        ):
            r1, r2 = 25.0 * (1 + max(response, 0.0)), 25.5 * (1 + max(-response, 0.0))
            lines.append(f"{r1:.9f},{r2:.9f},{shear},{normal_n}")
    path.write_text("\n".join(lines) + "\n")


def test_calibrate_takes_a_table_to_a_file(tmp_path, ran, result_of):
    table, out = tmp_path / "table.csv", tmp_path / "skin.yaml"
    write_table(table)
    printed = ran("skin", "calibrate", table, "--out", out).out
    calibration = load_calibration(out)
    membrane = Membrane(THICK_SECTION)
    assert calibration.friction == pytest.approx(membrane.belt.friction, abs=0.003)
    assert calibration.slope_per_n == pytest.approx(membrane.response(membrane.step(UNSTRETCHED, 1.0, 0.0)), rel=0.03)
    assert np.isfinite(calibration.prediction_half_width_n)
    assert f"friction coefficient (fitted)        {calibration.friction:.4f}" in printed
    assert f"rows fitted                          {2 * len(loop(1.1))}" in printed
    assert "(given)" in ran("skin", "calibrate", table, "--out", out, "--friction", "0.04").out
    result = result_of("skin", "calibrate", table, "--out", out)
    assert (result["path"], result["friction"], result["friction_given"]) == (str(out), calibration.friction, False)
    assert result["rows"] == calibration.rows


def test_a_table_of_one_sign_is_said_by_calibrate_and_check(tmp_path, ran):
    table, out = tmp_path / "table.csv", tmp_path / "skin.yaml"
    write_table(table)
    header, *rows = table.read_text().splitlines()
    # Of each loading, what comes before the first negative force.
    kept, negative = [header], False
    for row in rows:
        shear_n, normal_n = map(float, row.split(",")[2:])
        negative = (negative or shear_n < -1e-9) and normal_n > 0
        kept += [] if negative else [row]
    table.write_text("\n".join([*kept, ""]))
    printed = ran("skin", "calibrate", table, "--out", out).out
    assert "The table has no negative shear forces, and the skin measures none; record both signs." in printed
    rig = tmp_path / "rig.yaml"
    instruments = "{source: {serial: {path: a}}, daq: {adc: {device: {path: b}}}, calibration: skin.yaml}"
    rig.write_text(f"skin: {instruments}\n")
    checked = ran("check", rig).out
    assert "it has no negative shear forces, and measures none" in " ".join(checked.split())
    assert "N of friction" in " ".join(checked.split())


@pytest.mark.parametrize(("ratio", "is_similar"), [(1.009, True), (1.015, False), (1.03, False)])
def test_check_names_gauges_that_are_too_similar_for_the_daemon_to_find_them_swapped(tmp_path, ran, ratio, is_similar):
    content = yaml.safe_load(Path("config/calibrations/skin_demo.yaml").read_text())
    content["rest_ohm"] = [25.0, 25.0 * ratio]
    (tmp_path / "skin.yaml").write_text(yaml.safe_dump(content))
    rig = tmp_path / "rig.yaml"
    instruments = "{source: {serial: {path: a}}, daq: {adc: {device: {path: b}}}, calibration: skin.yaml}"
    rig.write_text(f"skin: {instruments}\n")
    checked = " ".join(ran("check", rig).out.split())
    assert ("its gauges are too similar at rest to detect swapped wires" in checked) is is_similar
    assert are_exchanged((25.0, 25.0 * ratio), 25.0 * ratio, 25.0) is not is_similar


def test_a_table_that_no_curve_fits_is_refused_by_its_name(tmp_path, mistake):
    table, out = tmp_path / "table.csv", tmp_path / "skin.yaml"
    write_table(table)
    # The gauges the other way round.
    table.write_text(table.read_text().replace("r1_ohm,r2_ohm", "r2_ohm,r1_ohm"))
    said = mistake("skin", "calibrate", table, "--out", out)
    assert f"{table}: The response does not rise with the shear force" in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["none.csv"], "none.csv: the table cannot be read"),
        (["none.csv", "--friction", "2"], "--friction 2 is not a number from 0 to 1"),
    ],
)
def test_a_mistake_ends_in_one_sentence(arguments, named, tmp_path, mistake, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert named in mistake("skin", "calibrate", *arguments, "--out", "skin.yaml")
    assert not list(tmp_path.iterdir())
