"""Accuracy of the estimators on frames later than their fit, on another day, and on other tools.

    python -m benchmarks.estimator_accuracy RECORDINGS --bank run/demo.bank --mesh fingertip_mesh.npz --out DIR

A table, led by the loaded frames (truth of 0.005 N·m or more): every estimator fitted to the earlier part of each
of the paper's recordings and judged on the later part; the default estimator fitted to one stream and judged on the
others, of the same and of another day; and with `--rig` the default estimator on the emulated rig, calibrated on three
to seven cylinders and judged on other tools. RECORDINGS holds torque_slices, diameter_slices and streams. Writes
estimators.json.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, product
from pathlib import Path

import numpy as np

from benchmarks.common import parser_of, table_head, table_row, write_figures
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import BankError
from shearloop.bank.mesh import load_mesh
from shearloop.emulators.emulated_rig import SIDES
from shearloop.estimation import FrameSeries, Physics, fit, measure_timing
from shearloop.estimation.estimator_names import DEFAULT, EstimatorName
from shearloop.studies.emulated_calibration import calibrate, record
from shearloop.studies.slices.evaluate import estimate_slices
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.series import SliceSeries, read_slices
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series
from shearloop.tools.figures import Figures, figures_by_load, figures_of
from shearloop.tools.frame_series import part_of, series_of
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.matlab_import import import_mat

# Columns of the tables: figures of loaded frames, then two of all frames.
LOADED = {
    "loaded": "n", "RMSE, N·m": "rmse_nm", "saying 0": "baseline_zero_rmse_nm", "gain": "gain",
    "coverage": "coverage_95", "score, N·m": "winkler_nm", "valid": "valid_fraction",
}  # fmt: skip
ALL = {"all: RMSE, N·m or mm": "rmse_nm", "r": "r"}

# Three and four of five repeats; about half of the cylinders' slices; five of ten twists.
SLICE_FRACTIONS = (0.592, 0.796)
CYLINDER_FRACTION = 0.62
TWIST_FRACTION = 0.457
# Frames before the judged part that fill an estimator's memory.
_WARM_UP = 0.015
STREAMS = {
    "3 December": "2024-12-03_16-09",
    "2 December, 15:36": "20241202_153632",
    "2 December, 17:17": "20241202_171704",
}
FINGERTIPS: tuple[tuple[str, ...], ...] = (("right",), ("left",), ("right", "left"))
ESTIMATORS: tuple[EstimatorName, ...] = ("paper", "bank", "regression", DEFAULT, "reconstruction")
# The data of the fit, the estimator, and the judged estimates, or why there are none.
Judged = tuple[str, EstimatorName, EstimateTrack | str]
# Sets of cylinders to calibrate on, and the tools to judge.
CYLINDERS_MM = [tuple(np.linspace(10.0, 40.0, n).tolist()) for n in (3, 4, 5, 7)]
TOOLS_MM = (12.0, 18.0, 22.0, 28.0, 38.0)


def imported_stream(recordings: Path, name: str, scratch: Path) -> Path:
    """Import one of the paper's streams and return the recording's path."""
    path = scratch / f"{STREAMS[name]}.mcap"
    import_mat([recordings / "streams" / STREAMS[name]], path)
    return path


def splits(recordings: Path, scratch: Path) -> Iterator[tuple[str, FrameSeries, FrameSeries, list[FrameSeries]]]:
    """Yield the title, the earlier and the later part of the paper's recordings, and what shows the first one's timing.

    That is the earlier part with all sides.
    """
    (torque,) = read_slices(recordings / "torque_slices")
    for share in SLICE_FRACTIONS:
        yield f"torque slices, first {share:.0%}", part_of(torque, 0, share), part_of(torque, share, 1), []
    (cylinders,) = read_slices(recordings / "diameter_slices")
    known, unknown = part_of(cylinders, 0, CYLINDER_FRACTION), part_of(cylinders, CYLINDER_FRACTION, 1)
    yield f"cylinders, first {CYLINDER_FRACTION:.0%}", known, unknown, []
    recording = read_recording(imported_stream(recordings, "3 December", scratch))
    timed_by = [part_of(series_of(recording, None), 0, TWIST_FRACTION)]
    for sides in FINGERTIPS:
        twists = series_of(recording, sides)
        past, future = part_of(twists, 0, TWIST_FRACTION), part_of(twists, TWIST_FRACTION - _WARM_UP, 1)
        yield f"stream, {' and '.join(sides)}, first {TWIST_FRACTION:.0%}", past, future, timed_by


def later_frames(recordings: Path, scratch: Path, physics: Physics) -> Iterator[Judged]:
    """Yield the estimates of every estimator on every split, or why one cannot be fitted."""
    for (title, past, future, timed_by), name in product(splits(recordings, scratch), ESTIMATORS):
        # A heatmap over all lags takes most of a second: the paper's method is judged on slices alone.
        if name == "paper" and not isinstance(past, SliceSeries):
            continue
        try:
            yield title, name, _judge_later(name, past, future, timed_by, physics)
        except BankError as error:
            yield title, name, str(error)


def _judge_later(
    name: EstimatorName, past: FrameSeries, future: FrameSeries, timed_by: list[FrameSeries], physics: Physics
) -> EstimateTrack:
    """Return the estimates of the later part by a calibration on the earlier one; raises BankError without one."""
    if isinstance(past, SliceSeries) and isinstance(future, SliceSeries):
        return estimate_slices(fit_slices(name, [past], "earlier", physics), future, physics.bank)
    calibration = fit(name, [past], "earlier", physics, timing=measure_timing([past], timed_by))
    return estimate_series(calibration, future, physics.bank)


def other_recordings(recordings: Path, scratch: Path) -> Iterator[Judged]:
    """Yield the default estimator's estimates on each other stream, or the reason of a refused calibration.

    The fingertips changed sides between the days, so sides of another day are exchanged.
    """
    streams = {name: series_of(read_recording(imported_stream(recordings, name, scratch))) for name in STREAMS}
    for name, sides in product(streams, FINGERTIPS):
        title = f"{name}, {' and '.join(sides)}"
        try:
            chosen = [streams[name].select_sides(sides)]
            calibration = fit(DEFAULT, chosen, name, timing=measure_timing(chosen, [streams[name]]))
        except BankError as error:
            yield title, DEFAULT, str(error)
            continue
        for other in (each for each in streams if each != name):
            order = 1 if other[0] == name[0] else -1
            judge = replace(streams[other], channels=streams[other].channels[:, ::order].copy())
            yield f"{title}: {other}", DEFAULT, estimate_series(calibration, judge.select_sides(sides))


def other_tools(bank: Path, seed: int, repeats: int) -> Iterator[tuple[int, tuple[str, ...], Figures]]:
    """Yield the number of cylinders, the fingertips, and the figures on the emulated rig's other tools."""
    tools = list(record(bank, seed, TOOLS_MM))
    for number, cylinders_mm in enumerate(CYLINDERS_MM):
        seeds = [seed + 1000 * (1 + number) + 100 * i for i in range(repeats)]
        known = [list(record(bank, each, cylinders_mm)) for each in seeds]
        for sides in (tuple(SIDES), *((side,) for side in SIDES)):
            tracks = [estimate_series(calibrate(one, sides), tool) for one in known for tool in tools]
            yield len(cylinders_mm), sides, figures_of(tracks)


def judged(track: EstimateTrack) -> dict[str, Figures]:
    """Return the figures of all frames and of loaded ones."""
    figures = figures_of([track])
    if (diameter := figures.get("diameter_rmse_mm")) is not None:
        figures["rmse_nm"] = diameter
    return {"all": figures, **figures_by_load([track])}


def row_of(figures: dict[str, Figures]) -> list[float | None]:
    """Return the columns of a table's row."""
    return [figures["loaded"][key] for key in LOADED.values()] + [figures["all"][key] for key in ALL.values()]


def main() -> None:
    """Measure, print, write, draw."""
    parser = parser_of(__doc__)
    parser.add_argument("recordings", type=Path, help="folder with torque_slices, diameter_slices and streams")
    parser.add_argument("--bank", type=Path, required=True, help="bank for the estimators paper and bank")
    parser.add_argument("--mesh", type=Path, required=True, help="mesh for the estimator reconstruction")
    parser.add_argument("--rig", action="store_true", help="judge tools on the emulated rig too; --bank is the rig's")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    physics = Physics(Bank.open(args.bank), load_mesh(args.mesh))
    found: dict[str, dict[str, dict[str, Figures]]] = {}
    columns = [*LOADED, *ALL]
    print(table_head("fitted to", "estimator", *columns))
    tracks = chain(later_frames(args.recordings, args.out, physics), other_recordings(args.recordings, args.out))
    for title, name, track in tracks:
        if isinstance(track, str):
            print(table_row(title, name, track, *[None] * (len(columns) - 1)))
            continue
        result = found.setdefault(title, {})[name] = judged(track)
        print(table_row(title, name, *row_of(result)), flush=True)
    if args.rig:
        print(table_head("cylinders", "fingertips", "diameter RMSE, mm", "coverage"))
        for count, sides, figures in other_tools(args.bank, 5000, 4):
            found.setdefault(f"{count} cylinders", {})[" and ".join(sides)] = {"all": figures}
            rmse_mm, coverage = figures["diameter_rmse_mm"], figures["diameter_coverage_95"]
            print(table_row(count, " and ".join(sides), rmse_mm, coverage), flush=True)
    write_figures(args.out / "estimators.json", found)


if __name__ == "__main__":
    main()
