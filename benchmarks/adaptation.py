"""What twists of known torque are worth: the later twists of a grip, before and after the gain is adapted to the first.

    python -m benchmarks.adaptation RECORDINGS --out DIR

RECORDINGS holds streams. Each twist of a recording is left out in turn, after the first 1, 2 and 3, which are left out
too and adapt the gain. Factors on the torque emulate grips of other gains. The last rows are a calibration on one grip
of a 30 mm cylinder, adapted in the other one, both ways: the only grips whose gain did change. Columns: not
adapted; as `shearloop adapt` does it; as if all that twists show were followed; as if the gain drifted by a tenth
within a grip. Each cell has RMSE and score of the loaded frames, in mN·m, and their coverage. Writes adaptation.json.
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
# A spread of the torque without motion so small that it only marks another tool, whose twists are followed always.
MARK, DRIFT = 1e-9, 0.1
VARIANTS = ("not adapted", "adapted", "followed always", "as if it drifted")


class Row(NamedTuple):
    """The figures of loaded frames by variant, after so many twists of a recording with a factor on the torque."""

    recording: str
    twists: int
    gain: float
    figures: dict[str, Figures]


class Material(NamedTuple):
    """Recordings, how they are calibrated on, what is left out of them, and the factors on the torque."""

    title: str
    recipe: Recipe
    kind: Kind
    recordings: Sequence[FrameSeries]
    factors: Sequence[float] = FACTORS


def materials(streams: dict[str, FrameSeries], recording: Path) -> Iterator[Material]:
    """Yield each part of the table, from all streams and from the recording of the one with ten twists."""
    recipe, read = Recipe(DEFAULT), read_recording(recording)
    for sides in FINGERTIPS:
        chosen = [series_of(read, sides)]
        timed = replace(recipe, timing_uncertainty_s=measure_timing(chosen, [streams[STREAM]]).uncertainty_s)
        yield Material(f"{STREAM}, {' and '.join(sides)}", timed, "twists", chosen)
    for name in CYLINDERS:
        yield Material(name, recipe, "twists", [streams[name]])
    yield Material("30 mm, another grip", recipe, "grips", [streams[name] for name in GRIPS], UNCHANGED)


def variants(calibration: Calibration) -> dict[str, Calibration]:
    """Return the calibration as it is, as if its twists were followed always, and as if its gain drifted."""
    gain = calibration.gain_regressor().gain
    gains = (gain, replace(gain, zero=MARK), replace(gain, drift=DRIFT))
    return {name: _with_gain(calibration, one) for name, one in zip(VARIANTS[1:], gains, strict=True)}


def _with_gain(calibration: Calibration, gain: GainSpread) -> Calibration:
    model = calibration.outputs["torque"]
    return replace(calibration, torque=replace(model, regressor=replace(model.regressor, gain=gain)))


def judge(plan: Plan, block: Block, calibration: Calibration, factor: float) -> dict[str, EstimateTrack]:
    """Return the track of a block with a factor on the torque, by each variant."""
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
    """Yield the figures after so many twists, by factor."""
    names = [str(number) for number in range(len(material.recordings))]
    plan = plan_left_out(material.kind, material.recipe, material.recordings, names, adapt_twists=n_twists)
    fitted = [(block, fit_without(material.recipe.fit, plan.recordings, block)) for block in plan.blocks]
    for factor in material.factors:
        each = [judge(plan, block, calibration, factor) for block, calibration in fitted]
        # A frame is loaded whatever the factor on its torque.
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
