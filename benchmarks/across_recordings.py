"""A calibration of each recording, judged on every other: `python -m benchmarks.across_recordings RECORDINGS`.

Fits the default to each of the paper's streams, fingertip by fingertip and both together, judges it on every other
recording of those sides, and to the first repeats of the slices, judged on the later ones. A recording whose sides are
named the other way round is tried both ways: as named, where another fingertip has to be refused, and exchanged, where
the same fingertip is seen on another day. Prints a table and writes it as JSON.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.estimators import DEFAULT, Figures, shown
from shearloop.bank.errors import BankError
from shearloop.bank.estimation import Calibration, FrameSeries, fit
from shearloop.daemon.analysis.evaluation import follow, judge
from shearloop.daemon.analysis.series import read_series, series_of
from shearloop.daemon.recording.importing import import_mat
from shearloop.daemon.recording.reader import read_recording

BOTH_DAYS = {
    "3 December": "2024-12-03_16-09",
    "2 December": "20241202_153632",
    "2 December, late": "glitch_20241202_173837",
}
DIAMETERS_MM = (10, 20, 30, 40)
SLICES = (19, 24, 29, 34, 39, 44)
_SIDES = (("right",), ("left",), ("right", "left"))
EXCHANGED = ", exchanged"


def recordings(folder: Path, scratch: Path) -> dict[str, FrameSeries]:
    """Return every stream by name; those of two fingertips also with the sides exchanged."""
    found = {}
    streams = folder / "streams"
    for name, inside in BOTH_DAYS.items():
        found[name] = imported([streams / inside], scratch / f"{inside}.mcap")
        found[name + EXCHANGED] = replace(found[name], channels=found[name].channels[:, ::-1].copy())
    for mm in DIAMETERS_MM:
        files = sorted((streams / "cylinders").glob(f"{mm}mm_*.mat"))
        found[f"cylinder of {mm} mm"] = imported(files, scratch / f"{mm}mm.mcap")
    return found


def imported(sources: list[Path], out: Path) -> FrameSeries:
    """Return what files of the paper hold, imported as a recording."""
    import_mat(sources, out)
    return series_of(read_recording(out))


def calibrations(streams: dict[str, FrameSeries]) -> Iterator[tuple[str, tuple[str, ...], Calibration | str]]:
    """Yield a calibration of each stream and sides that it has, or why there is none."""
    for name, series in streams.items():
        if name.endswith(EXCHANGED):
            continue
        for sides in _SIDES:
            if not set(sides) <= set(series.sides):
                continue
            try:
                yield name, sides, fit(DEFAULT, [series.of_sides(sides)], name, timed_by=[series])
            except BankError as error:
                yield name, sides, str(error)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, help="folder with torque_slices, diameter_slices and streams")
    parser.add_argument("--out", type=Path, default=Path("build/across"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    found: list[dict[str, str | Figures]] = []
    print("| fitted to | judged on | sides | r | RMSE | coverage | valid | diameter's RMSE |")
    print("|---|---|---|---|---|---|---|---|")

    def tell(fitted: str, judged: str, sides: tuple[str, ...], figures: Figures) -> None:
        found.append({"fitted": fitted, "judged": judged, "sides": " and ".join(sides), "figures": figures})
        cells = [
            fitted, judged, " and ".join(sides), shown(figures["r"], 3), shown(figures["rmse_nm"], 4),
            shown(figures["coverage_95"], 2), shown(figures["valid_fraction"], 2),
            shown(figures.get("diameter_rmse_mm"), 1),
        ]  # fmt: skip
        print(f"| {' | '.join(cells)} |", flush=True)

    (torque,) = read_series(args.recordings / "torque_slices")
    for n in SLICES:
        calibration = fit(DEFAULT, [torque.between(0, n)], "slices")
        later = follow(calibration, torque.between(n, len(torque.t_s)))
        tell(f"slices 1 to {n}", f"slices from {n + 1} on", torque.sides, judge([later]))
    streams = recordings(args.recordings, args.out)
    for name, sides, calibration_or_why in calibrations(streams):
        if isinstance(calibration_or_why, str):
            print(f"| {name} | – | {' and '.join(sides)} | {calibration_or_why} | | | | |")
            continue
        for other, series in streams.items():
            if other != name and set(sides) <= set(series.sides):
                tell(name, other, sides, judge([follow(calibration_or_why, series.of_sides(sides))]))
    cylinders = [streams[f"cylinder of {mm} mm"] for mm in DIAMETERS_MM]
    calibration = fit(DEFAULT, cylinders, "all cylinders")
    tell("all cylinders", "the same", calibration.sides, judge([follow(calibration, one) for one in cylinders]))
    (slices,) = read_series(args.recordings / "diameter_slices")
    for n in (8, 9, 10):
        calibration = fit(DEFAULT, [slices.between(0, n)], "slices")
        later = follow(calibration, slices.between(n, len(slices.t_s)))
        tell(f"cylinders' slices 1 to {n}", f"from {n + 1} on", slices.sides, judge([later]))
    (args.out / "across.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
