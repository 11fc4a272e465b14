"""Estimators on recordings that come later than what they were fitted to: `python -m benchmarks.estimators RECORDINGS`.

Fits each estimator to the first part of the torque slices, of the cylinders and of the recorded twists, judges it on
the rest, prints the table, and writes the numbers as JSON and the default's truth against estimate as figures.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.mesh import load_mesh
from shearloop.bank.errors import BankError
from shearloop.bank.estimation import FrameSeries, Name, Physics, fit
from shearloop.bank.estimation.ranking import accuracy_over_channels
from shearloop.daemon.analysis.evaluation import EstimateTrack, follow, judge
from shearloop.daemon.analysis.figure import draw
from shearloop.daemon.analysis.series import part_of, read_series, series_of
from shearloop.daemon.recording.importing import import_mat
from shearloop.daemon.recording.reader import read_recording

Figures = dict[str, float | int | None]

# Three of five repeats, and four; about half of the cylinders' slices; five of ten twists.
SLICE_SHARES = (0.592, 0.796)
CYLINDER_SHARE = 0.62
TWIST_SHARE = 0.457
# Frames before the judged part that fill the memory of an estimator that has one.
_WARM_UP = 0.015
CHANNEL_COUNTS = (8, 16, 32, 64, 128, 272, 512, 896)
DEFAULT: Name = "fused"
# A heatmap over all lags takes most of a second: the paper's method is judged on slices alone.
_SLOW: tuple[Name, ...] = ("paper",)


@dataclass(frozen=True, slots=True)
class Split:
    """What is fitted and what is judged; timed_by is the past with all of its sides, where it has others."""

    title: str
    past: FrameSeries
    future: FrameSeries
    timed_by: tuple[FrameSeries, ...] = ()


def splits(recordings: Path, scratch: Path) -> Iterator[Split]:
    """Yield the time-ordered splits of the paper's recordings."""
    (torque,) = read_series(recordings / "torque_slices")
    for share in SLICE_SHARES:
        yield Split(f"torque slices, first {share:.0%}", part_of(torque, 0, share), part_of(torque, share, 1))
    (cylinders,) = read_series(recordings / "diameter_slices")
    yield Split(
        f"cylinders, first {CYLINDER_SHARE:.0%}",
        part_of(cylinders, 0, CYLINDER_SHARE),
        part_of(cylinders, CYLINDER_SHARE, 1),
    )
    recording = scratch / "twists.mcap"
    import_mat([recordings / "streams" / "2024-12-03_16-09"], recording)
    for sides in (("right",), ("left",), ("right", "left")):
        whole, twists = (series_of(read_recording(recording), each) for each in (None, sides))
        yield Split(
            f"stream, {' and '.join(sides)}, first {TWIST_SHARE:.0%}",
            part_of(twists, 0, TWIST_SHARE),
            part_of(twists, TWIST_SHARE - _WARM_UP, 1),
            (part_of(whole, 0, TWIST_SHARE),),
        )


def measured(split: Split, name: Name, physics: Physics) -> tuple[Figures, EstimateTrack] | None:
    """Return the figures of one estimator on one split, None where it cannot be fitted."""
    if name in _SLOW and split.past.kind == "raw":
        return None
    try:
        calibration = fit(name, [split.past], split.title, physics, timed_by=split.timed_by)
    except BankError as error:
        print(f"{split.title}, {name}: {error}")
        return None
    track = follow(calibration, split.future, physics.bank)
    return judge([track]), track


def main() -> None:
    """Measure, print, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", type=Path, help="folder with torque_slices, diameter_slices and streams")
    parser.add_argument("--bank", type=Path, help="a bank, for the estimators paper and bank")
    parser.add_argument("--mesh", type=Path, help="a mesh, for the estimator reconstruction")
    parser.add_argument("--out", type=Path, default=Path("build/estimators"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    physics = Physics(
        Bank.open(args.bank) if args.bank else None,
        load_mesh(args.mesh) if args.mesh else None,
    )
    names: list[Name] = ["regression", DEFAULT]
    if args.bank:
        names = ["paper", "bank", *names]
    if args.mesh:
        names.append("reconstruction")
    found: dict[str, dict[str, Figures]] = {}
    tracks: dict[str, EstimateTrack] = {}
    print("| later than | estimator | r | RMSE | bias | coverage | valid | frames |")
    print("|---|---|---|---|---|---|---|---|")
    for split in splits(args.recordings, args.out):
        for name in names:
            result = measured(split, name, physics)
            if result is None:
                continue
            figures, track = result
            found.setdefault(split.title, {})[name] = figures
            print(row(split.title, name, figures), flush=True)
            if name == DEFAULT:
                tracks[split.title] = track
    (torque,) = read_series(args.recordings / "torque_slices")
    ranking = over_channels(torque)
    print("\n| best channels | r on later slices |\n|---|---|")
    for count, r in ranking.items():
        print(f"| {count} | {r:.3f} |")
    (args.out / "channels.json").write_text(json.dumps(ranking, indent=1) + "\n")
    (args.out / "estimators.json").write_text(json.dumps(found, indent=1) + "\n")
    title = f"{DEFAULT}, on what came later than its fit"
    draw(list(tracks.values()), [f"fitted to {name}" for name in tracks], title, args.out / "estimators.png")


def over_channels(torque: FrameSeries) -> dict[int, float]:
    """Return r on the later slices over the number of channels, ranked on the earlier ones (the paper's figure 3b)."""
    past, future = part_of(torque, 0, SLICE_SHARES[0]), part_of(torque, SLICE_SHARES[0], 1)
    pair = [(one.channels[:, 0], one.torque_at_frames()) for one in (past, future)]
    return accuracy_over_channels(pair[0], pair[1], CHANNEL_COUNTS)


def row(title: str, name: str, figures: Figures) -> str:
    """Return one row of the table."""
    if "diameter_rmse_mm" in figures:
        size = f"{shown(figures['diameter_rmse_mm'], 1)} mm"
    else:
        size = f"{shown(figures['rmse_nm'], 4)} N·m"
    cells = [
        title,
        name,
        shown(figures["r"], 3),
        size,
        shown(figures["bias_nm"], 4),
        shown(figures["coverage_95"], 2),
        shown(figures["valid_fraction"], 2),
        str(figures["frames"]),
    ]
    return f"| {' | '.join(cells)} |"


def shown(value: float | None, digits: int) -> str:
    """Return a figure with so many decimals."""
    return "–" if value is None else f"{value:.{digits}f}"


if __name__ == "__main__":
    main()
