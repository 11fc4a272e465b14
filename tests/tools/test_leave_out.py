"""A recipe is judged by blocks that its fit has not seen."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from shearloop.errors import UserError
from shearloop.estimation.grips import find_grips
from shearloop.estimation.series import FrameSeries
from shearloop.estimation.values import Estimate
from shearloop.studies.slices.evaluate import no_better_than_place
from shearloop.studies.slices.leave_out import SliceRecipe, find_levels, plan_levels
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series
from shearloop.tools.figures import figures_by_load, figures_of, no_better_than_clock
from shearloop.tools.leave_out import LeftOut, Recipe, advice_on, fit_without, plan_left_out, sentences_of
from shearloop.tools.left_out_blocks import KINDS, Span, after_twists, find_blocks, usual_kind
from shearloop.tools.parallel import SerialExecutor
from tests.estimation.conftest import elastic, twisting
from tests.studies.slices.conftest import sliced

RECIPE = Recipe("motion_regression")
NESTED = replace(RECIPE, nested=True)
OF_SLICES = SliceRecipe("motion_regression")


def of_tool(diameter_mm: float, seed: int) -> FrameSeries:
    played = twisting(cycles=3, seed=seed, tips=(1,), peak_nm=0.002 * diameter_mm)
    return replace(played, diameter_mm=np.full(len(played.t_s), diameter_mm))


MATERIAL = {
    "twists": lambda: [twisting(cycles=4, tips=(1,))],
    "grips": lambda: [twisting(cycles=3, seed=seed, tips=(1,)) for seed in (1, 2)],
    "tools": lambda: [of_tool(10.0, 1), of_tool(12.0, 2)],
}


def corrupted(recordings, block):
    """Return the recordings with other frames and torques where the block is judged."""
    found = list(recordings)
    for span in block.judged:
        one = found[span.recording]
        channels, torque_nm = one.channels.copy(), one.torque_nm.copy()
        channels[span.first : span.stop] *= 1.7
        begin, end = one.t_s[span.first], one.t_s[span.stop - 1]
        torque_nm[(one.torque_t_s >= begin) & (one.torque_t_s <= end)] *= -3.0
        found[span.recording] = replace(one, channels=channels, torque_nm=torque_nm)
    return found


@pytest.mark.parametrize(
    ("kind", "recipe"), [*((kind, RECIPE) for kind in KINDS), ("twists", NESTED), ("levels", OF_SLICES)]
)
def test_a_block_is_not_in_its_own_fit(kind, recipe, tmp_path):
    recordings = MATERIAL[kind]() if kind in MATERIAL else [sliced()]
    names = [f"{number}.mcap" for number in range(len(recordings))]
    blocks = find_blocks(kind, recordings, names) if kind in MATERIAL else find_levels(recordings)
    for number, block in enumerate(blocks[:2]):
        own, other = tmp_path / f"{number}.cal", tmp_path / f"{number}_other.cal"
        fit_without(recipe.fit, recordings, block).save(own)
        fit_without(recipe.fit, corrupted(recordings, block), block).save(other)
        assert own.read_bytes() == other.read_bytes(), block.name


def test_every_loaded_frame_is_judged_once_by_twists():
    recordings = MATERIAL["twists"]()
    blocks = find_blocks("twists", recordings, ["a.mcap"])
    assert [one.name for one in blocks] == [f"twist {number} of a.mcap" for number in (1, 2, 3, 4)]
    judged = np.concatenate([np.arange(one.judged[0].first, one.judged[0].stop) for one in blocks])
    assert len(np.unique(judged)) == len(judged)
    assert {*np.flatnonzero(np.abs(recordings[0].torque_at_frames()) > 0.005)} <= {*judged.tolist()}


def test_figures_are_those_of_a_slow_loop():
    recordings = MATERIAL["grips"]()
    result = plan_left_out("grips", RECIPE, recordings, ["a", "b"]).judge(SerialExecutor())
    errors = []
    for number, one in enumerate(recordings):
        calibration = RECIPE.fit([recordings[1 - number]])
        track = estimate_series(calibration, one)
        for truth, estimate in zip(one.torque_at_frames(), track.estimates, strict=True):
            if estimate.torque_nm is not None and abs(truth) >= 0.005:
                errors.append(estimate.torque_nm - truth)
    figures = result.figures()
    assert figures["loaded"]["rmse_nm"] == pytest.approx(np.sqrt(np.mean(np.square(errors))))
    assert [one["name"] for one in figures["blocks"]] == ["a", "b"]
    evaluated = {*figures_of(result.all_tracks), *figures_by_load(result.all_tracks)}
    assert {*figures} == evaluated | {"left_out", "blocks", "not_judged", "advice"}
    assert result.advice == "Two grips only: record three, because the gain changes from grip to grip."
    assert result.advice == sentences_of(result)[-1]


def test_the_stopwatch_knows_the_level_that_the_fit_does_not():
    recordings = [sliced()]
    blocks = find_levels(recordings)
    for block in (blocks[0], blocks[len(blocks) // 2]):
        tracks = OF_SLICES.judge(recordings, block).tracks
        truth = np.concatenate([one.series.torque_at_frames() for one in tracks])
        assert np.concatenate([one.profile_nm for one in tracks]) == pytest.approx(truth, abs=0.01)
        fitted = recordings[0].torque_at_frames()[block.fitted[0]]
        assert np.abs(fitted - truth[0]).min() > 0.005


@pytest.mark.parametrize(
    ("sides", "kind", "said"),
    [
        (1, "raw", r"This fingertip \(right\) alone does not .*record and use both, grip harder"),
        (2, "raw", "grip harder"),
        (1, "slices", "random order"),
    ],
)
def test_what_no_sensor_is_needed_for_is_said(sides, kind, said):
    played = twisting(cycles=2, tips=(1, 2)[:sides]) if kind == "raw" else sliced(2)
    track = off_by(played, 0.02)
    judge = no_better_than_clock if kind == "raw" else no_better_than_place
    assert re.search(said, judge([track]))
    assert judge([off_by(played, 0.002)]) == ""


@pytest.mark.parametrize(("kind", "n_blocks"), [("twists", 3), ("grips", 2)])
def test_the_first_twist_adapts_and_is_neither_fitted_nor_judged(kind, n_blocks):
    recordings = MATERIAL[kind]()
    # The judged recording's grip has another gain than the fit expects, further off than first twists are by chance.
    if kind == "grips":
        recordings[0] = replace(recordings[0], torque_nm=1.4 * recordings[0].torque_nm)
    names = ["a", "b"][: len(recordings)]
    blocks, not_judged = after_twists(find_blocks(kind, recordings, names), recordings, 1)
    assert not_judged == []
    assert len(blocks) == n_blocks
    for block in blocks:
        adapted = block.adapted
        torque_nm = recordings[adapted.recording].torque_at_frames()
        assert torque_nm[: adapted.stop].max() > 0.04
        fitted = block.fitted[adapted.recording][: adapted.stop]
        assert not fitted[torque_nm[: adapted.stop] > 0.0].any()
        assert all(span.first >= adapted.stop for span in block.judged)
    result = plan_left_out(kind, RECIPE, recordings, names, adapt_twists=1).judge(SerialExecutor())
    figures = result.figures()
    assert figures["before_adapting"]["n"] == figures["loaded"]["n"] > 0
    assert "Before adapting" in sentences_of(result)[-2]
    if kind == "grips":
        assert figures["loaded"]["rmse_nm"] < 0.8 * figures["before_adapting"]["rmse_nm"]


@pytest.mark.parametrize("kind", ["twists", "tools"])
def test_a_load_cell_that_reads_negative_is_judged_alike(kind):
    recordings = [of_tool(size_mm, 1) for size_mm in (10.0, 20.0, 40.0)] if kind == "tools" else MATERIAL[kind]()
    mirrored = [replace(one, torque_nm=-one.torque_nm) for one in recordings]
    names = [f"{number}.mcap" for number in range(len(recordings))]
    found, of_mirrored = (
        plan_left_out(kind, RECIPE, one, names).judge(SerialExecutor()).figures() for one in (recordings, mirrored)
    )
    for same in ("n", "rmse_nm", "coverage_95", "interval_nm", "gain", "baseline_ratio"):
        assert of_mirrored["loaded"][same] == found["loaded"][same], same
    assert found["loaded"]["n"] > 0
    assert of_mirrored["loaded"]["bias_nm"] == pytest.approx(-found["loaded"]["bias_nm"])


def off_by(played, error_nm: float) -> EstimateTrack:
    """Return estimates of a series that are off, where a stopwatch is off by 10 mN·m."""
    truth = played.torque_at_frames()
    estimates = tuple(Estimate(True, (), value, value - 0.1, value + 0.1) for value in (truth + error_nm).tolist())
    return EstimateTrack(played, estimates, np.zeros(len(truth)), truth + 0.01)


def test_tools_are_advised_to_adapt_and_counted_by_the_recordings():
    recordings = [of_tool(size_mm, 1) for size_mm in (10.0, 14.0, 20.0, 28.0)]
    tracks = [[off_by(one, 0.02)] for one in recordings]
    assert "shearloop adapt" in advice_on("tools", recordings, tracks, adapted=False)
    assert "does not beat the stopwatch" in advice_on("tools", recordings, tracks, adapted=True)
    # A tool with nothing left to judge was recorded all the same.
    assert "record four" not in advice_on("tools", recordings, tracks[1:], adapted=True)
    assert "3 tools only: record four" in advice_on("tools", recordings[1:], tracks[1:], adapted=True)


def test_too_few_grips_are_named_before_how_to_grip():
    one, another, third = (twisting(seed=seed) for seed in (1, 2, 3))
    for recordings, said in (
        ([one], "One grip only: record three"),
        ([one, another], "Two grips only: record three"),
        ([one, another, third], "The sensor does not beat the stopwatch: grip harder"),
    ):
        tracks = [[off_by(each, 0.02)] for each in recordings]
        assert said in advice_on("twists", recordings, tracks, adapted=False)


def test_a_tool_without_a_torque_is_named():
    """The figures are of the others, though the frames are valid for their diameter."""
    judged, refused = off_by(of_tool(20.0, 1), 0.02), off_by(of_tool(10.0, 2), 0.0)
    diameters = tuple(Estimate(True, (), None, None, None, 12.0, 10.0, 14.0) for _ in refused.estimates)
    without = replace(refused, estimates=diameters, why_no_torque="the tool has 10 mm")
    result = LeftOut("tools", ("the tool of 20 mm", "the tool of 10 mm"), ((judged,), (without,)), "advice", "a clock")
    assert sentences_of(result)[-2] == "Not judged: the tool of 10 mm, because no torque was estimated on it."
    assert result.figures()["not_judged"] == ["the tool of 10 mm, because no torque was estimated on it"]
    assert without.between(3, 10).without_torque == 7
    assert judged.without_torque == 0


def test_each_grip_of_a_recording_is_left_out_in_turn():
    series = elastic(6, 4)
    grips = find_grips(series)
    assert usual_kind([series]) == "grips"
    blocks = find_blocks("grips", [series], ["a"])
    assert [one.name for one in blocks] == ["grip 1 of a", "grip 2 of a"]
    for block, own, other in zip(blocks, grips, grips[::-1], strict=True):
        rows = block.fitted[0]
        assert not rows[own.idle.start : own.released.stop].any()
        assert rows[other.idle.start : other.released.stop].all()
    result = plan_left_out("grips", RECIPE, [series], ["a"]).judge(SerialExecutor())
    assert result.figures()["loaded"]["valid_fraction"] > 0.5
    assert "Two grips only: record three" in sentences_of(result)[-1]


def test_no_twist_reaches_from_one_grip_into_the_next():
    series = elastic(6, 4)
    grips = find_grips(series)
    spans = [block.judged[0] for block in find_blocks("twists", [series], ["a"])]
    assert len(spans) == 10
    assert (spans[0].first, spans[5].stop) == (grips[0].gripped.start, grips[0].gripped.stop)
    assert (spans[6].first, spans[9].stop) == (grips[1].gripped.start, grips[1].gripped.stop)
    # The gain is adapted to the twists of the grip that is judged.
    adapted = after_twists(find_blocks("grips", [series], ["a"]), [series], 2)
    assert [one.adapted for one in adapted.blocks] == [
        Span(0, 0, spans[1].stop),
        Span(0, grips[1].idle.start, spans[7].stop),
    ]


def test_a_block_without_a_later_twist_is_named():
    recordings = [of_tool(10.0, 1), of_tool(12.0, 2), of_tool(14.0, 3)]
    # The load between the twists stays, so that they count as one.
    held = recordings[0]
    gripped = np.abs(held.torque_nm) > 0.1 * np.abs(held.torque_nm).max()
    between = slice(*np.flatnonzero(gripped)[[0, -1]])
    torque_nm = held.torque_nm.copy()
    torque_nm[between] = np.maximum(torque_nm[between], 0.3 * torque_nm.max())
    recordings[0] = replace(held, torque_nm=torque_nm)
    names = ["a", "b", "c"]
    why = "because its grip has 1 twist (one ends where the load falls below a tenth), and the gain is adapted to"
    of_twists = after_twists(find_blocks("twists", recordings, names), recordings, 2)
    assert of_twists.not_judged == [f"twist 1 of a, {why} 2 twists"]
    result = plan_left_out("tools", RECIPE, recordings, names, adapt_twists=2).judge(SerialExecutor())
    assert result.figures()["not_judged"] == [f"the tool of 10 mm, {why} 2 twists"]
    assert f"Not judged: the tool of 10 mm, {why} 2 twists." in sentences_of(result)


def test_nothing_remains_after_as_many_twists_as_there_are():
    recordings = MATERIAL["grips"]()
    with pytest.raises(UserError, match="no grip has more than 3 twists"):
        after_twists(find_blocks("grips", recordings, ["a", "b"]), recordings, 3)


@pytest.mark.parametrize(
    ("kind", "recordings", "said"),
    [
        ("twists", lambda: [twisting(cycles=1, tips=(1,))], "there is one twist, which leaves nothing to fit"),
        ("tools", lambda: [of_tool(10.0, 1)], "there is one tool, of 10 mm"),
        ("tools", lambda: [twisting(cycles=3, tips=(1,))], "name it with --tool-mm"),
        ("grips", lambda: [twisting(cycles=3, tips=(1,))], "there is one grip, which leaves nothing to fit"),
        ("twists", lambda: [sliced()], "use --leave-out levels"),
        ("levels", lambda: [sliced().between(0, 12)], "record 20 or more"),
    ],
)
def test_what_cannot_be_left_out_is_refused_in_one_sentence(kind, recordings, said):
    chosen = recordings()
    names = ["a.mcap"] * len(chosen)
    of_slices = isinstance(chosen[0], SliceSeries)
    refuse = partial(plan_levels, kind, OF_SLICES, chosen) if of_slices else partial(find_blocks, kind, chosen, names)
    with pytest.raises(UserError, match=said) as refused:
        refuse()
    assert "\n" not in str(refused.value)


def test_calibrate_chooses_the_widest_kind():
    for kind in KINDS:
        assert usual_kind(MATERIAL[kind]()) == kind
