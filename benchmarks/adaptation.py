"""Measures the error on the later twists of a grip, before and after the first twists adapt the gain.

    python -m benchmarks.adaptation RECORDINGS --out DIR

RECORDINGS holds streams. Each twist of a recording is left out in turn. The first 1, 2 or 3 twists are left out too,
and adapt the gain. Factors on the torque emulate grips with other gains. In the last rows one grip of a 30 mm cylinder
calibrates and the other one adapts, both ways. These are the only two grips with different gains. The columns are: not
adapted; adapted as by `shearloop adapt`; always corrected by all that the twists show; corrected as if the gain drifted
by a tenth within a grip. Each cell has RMSE and score of the loaded frames, in mN·m, and their coverage. Writes
adaptation.json.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from benchmarks.common import parser_of, table_head, table_row, write_figures
from benchmarks.estimator_accuracy import FINGERTIPS
from benchmarks.grip_strength import read_streams
from shearloop.estimation import Calibration, FrameSeries, adapt, measure_timing
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import DEFAULT
from shearloop.estimation.gain import GainSpread
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series
from shearloop.tools.figures import Figures, figures_by_load
from shearloop.tools.frame_series import series_of
from shearloop.tools.leave_out import Plan, Recipe, fit_without, plan_left_out
from shearloop.tools.left_out_blocks import Block, Kind
from shearloop.tools.recordings.frames import read_recording

STREAM, CYLINDERS, GRIPS = "3 December", ("20mm_1", "30mm_1", "30mm_2", "40mm_1"), ("30mm_1", "30mm_2")
FACTORS, UNCHANGED, TWISTS = (0.7, 0.85, 1.0, 1.17, 1.4), (1.0,), (1, 2, 3)
# This spread of the torque without motion is too small to matter. It marks another tool: the gain follows its twists.
MARK, DRIFT = 1e-9, 0.1
VARIANTS = ("not adapted", "adapted", "followed always", "as if it drifted")


class Row(NamedTuple):
    """The figures of loaded frames by variant, for one recording, one number of twists and one factor on the torque."""

    recording: str
    twists: int
    gain: float
    figures: dict[str, Figures]


class Material(NamedTuple):
    """Recordings, the recipe of their calibration, the kind of block to leave out, and the factors on the torque."""

    title: str
    recipe: Recipe
    kind: Kind
    recordings: Sequence[FrameSeries]
    factors: Sequence[float] = FACTORS


def materials(streams: dict[str, FrameSeries], recording: Path) -> Iterator[Material]:
    """Yield each part of the table, from all streams and from the recording with ten twists."""
    recipe, read = Recipe(DEFAULT), read_recording(recording)
    for sides in FINGERTIPS:
        chosen = [series_of(read, sides)]
        timed = replace(recipe, timing_uncertainty_s=measure_timing(chosen, [streams[STREAM]]).uncertainty_s)
        yield Material(f"{STREAM}, {' and '.join(sides)}", timed, "twists", chosen)
    for name in CYLINDERS:
        yield Material(name, recipe, "twists", [streams[name]])
    yield Material("30 mm, another grip", recipe, "grips", [streams[name] for name in GRIPS], UNCHANGED)


def variants(calibration: Calibration) -> dict[str, Calibration]:
    """Return the calibration unchanged, one that always follows its twists, and one with a drift of the gain."""
    gain = calibration.gain_regressor().gain
    gains = (gain, replace(gain, zero=MARK), replace(gain, drift=DRIFT))
    return {name: _with_gain(calibration, one) for name, one in zip(VARIANTS[1:], gains, strict=True)}


def _with_gain(calibration: Calibration, gain: GainSpread) -> Calibration:
    model = calibration.outputs["torque"]
    return replace(calibration, torque=replace(model, regressor=replace(model.regressor, gain=gain)))


def judge(plan: Plan, block: Block, calibration: Calibration, factor: float) -> dict[str, EstimateTrack]:
    """Return the track of a block by variant, with a factor on the torque."""
    (span,), first = block.judged, block.adapted
    if first is None:
        raise ValueError("the plan does not adapt")
    recording = plan.recordings[span.recording].between(0, span.stop)
    scaled = replace(recording, torque_nm=factor * recording.torque_nm)
    twists = scaled.between(first.first, first.stop)
    found = {VARIANTS[0]: calibration}
    found |= {name: adapt(one, [twists], "first twists")[0] for name, one in variants(calibration).items()}
    return {name: estimate_series(one, scaled).between(span.first, span.stop) for name, one in found.items()}


def rows_of(material: Material, n_twists: int) -> Iterator[Row]:
    """Yield the figures after `n_twists` twists, by factor."""
    names = [str(number) for number in range(len(material.recordings))]
    plan = plan_left_out(material.kind, material.recipe, material.recordings, names, adapt_twists=n_twists)
    fitted = [(block, fit_without(material.recipe.fit, plan.recordings, block)) for block in plan.blocks]
    for factor in material.factors:
        each = [judge(plan, block, calibration, factor) for block, calibration in fitted]
        # The factor does not change which frames are loaded.
        figures = {
            name: figures_by_load([one[name] for one in each], factor * LOADED_NM)["loaded"] for name in VARIANTS
        }
        yield Row(material.title, n_twists, factor, figures)


def shown(figures: Figures) -> str:
    """Return error, score and coverage of loaded frames as text."""
    rmse_nm, score_nm, coverage = (figures[name] for name in ("rmse_nm", "winkler_nm", "coverage_95"))
    if rmse_nm is None or score_nm is None or coverage is None:
        return "–"
    return f"{1e3 * rmse_nm:.1f}; {1e3 * score_nm:.0f}; {coverage:.2f}"


def main() -> None:
    """Measure, print, write."""
    parser = parser_of(__doc__)
    parser.add_argument("recordings", type=Path, help="folder with streams")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    print(table_head("recording", "twists", "gain", *VARIANTS))
    streams = read_streams(args.recordings, args.out)
    for material in materials(streams, args.out / f"{STREAM}.mcap"):
        for n_twists in TWISTS:
            for row in rows_of(material, n_twists):
                cells = [shown(row.figures[name]) for name in VARIANTS]
                print(table_row(row.recording, row.twists, row.gain, *cells), flush=True)
                rows.append(row)
    write_figures(args.out / "adaptation.json", [row._asdict() for row in rows])


if __name__ == "__main__":
    main()
