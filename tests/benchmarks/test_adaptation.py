"""The benchmark judges what `shearloop evaluate --leave-out twists --adapt-twists N` judges, and variants of it."""

import pytest

from benchmarks.adaptation import DRIFT, MARK, VARIANTS, Material, rows_of, shown, variants
from shearloop.estimation import fit
from shearloop.tools.figures import figures_by_load
from shearloop.tools.leave_out import Recipe, plan_left_out
from shearloop.tools.parallel import SerialExecutor
from tests.estimation.conftest import twisting


def test_each_row_is_what_the_command_prints():
    recordings, recipe = [twisting(cycles=4, tips=(1,))], Recipe("motion_regression")
    plain, larger = rows_of(Material("rig", recipe, "twists", recordings, (1.0, 1.4)), 2)
    printed = plan_left_out("twists", recipe, recordings, ["0"], adapt_twists=2).judge(SerialExecutor())
    before, after = (figures_by_load(tracks)["loaded"] for tracks in (printed.before, printed.all_tracks))
    assert shown(plain.figures["not adapted"]) == shown(before)
    assert shown(plain.figures["adapted"]) == shown(after)
    assert (plain.recording, plain.twists, plain.gain) == ("rig", 2, 1.0)
    n, errors = zip(*((one["n"], one["rmse_nm"]) for one in map(larger.figures.get, VARIANTS)), strict=True)
    assert {*n} == {before["n"]}
    assert errors[2] == pytest.approx(min(errors), rel=0.1)
    assert errors[0] == max(errors)


def test_the_variants_change_the_gain_alone():
    found = variants(fit("motion_regression", [twisting(cycles=4, tips=(1,))], "rig"))
    assert tuple(found) == VARIANTS[1:]
    gains = [one.gain_regressor().gain for one in found.values()]
    assert [(one.zero, one.drift) for one in gains] == [(0.0, gains[0].drift), (MARK, gains[0].drift), (0.0, DRIFT)]
    assert gains[1].is_of_another_tool
