"""Later slices with something foreign mixed in: `python -m benchmarks.foreign_slices RECORDINGS`.

Calibrates on the first 40 to 90 % of the torque slices, mixes a tenth and a fifth of other frames into all that follow,
and counts what is false-valid: called valid although the torque is outside of its 95 % interval. The foreign frames:
another fingertip's (the later slices' mean at other channels), the own one's turned and mirrored, single frames of both
fingertips of the recorded twists, scaled to the slice that they are mixed into, and each recorded cylinder's mean.
Prints tables and writes the numbers as JSON; with `--before`, beside those of an earlier run.
"""

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation import EstimatorSession, FrameSeries, Name, Physics, fit
from shearloop.bank.estimation.bank_match import Registration
from shearloop.bank.estimation.grip_segmentation import gripped_part
from shearloop.daemon.analysis.charts.detectability import ORIGINS
from shearloop.daemon.analysis.charts.faults import Spoilt
from shearloop.daemon.analysis.charts.sources import bank_of, mesh_of
from shearloop.daemon.analysis.charts.stability import BROKEN_SHARE, estimates_of
from shearloop.daemon.analysis.series import read_series, series_of
from shearloop.daemon.recording.importing import import_mat
from shearloop.daemon.recording.reader import read_recording

NAMES: tuple[Name, ...] = ("fused", "bank", "regression")
SHARES = (0.1, 0.2)
GOOD = "nothing"
OTHER = "another fingertip: its mean at other channels"
TURNED = "its own, turned or mirrored"
FINGERTIPS = "fingertips of the recorded twists"
CYLINDERS = "recorded cylinders"
KINDS = (OTHER, TURNED, FINGERTIPS, CYLINDERS)
_SEEDS = (7, 8, 9)
# None of those that a calibration mixes in itself, eighths of a turn.
_TURNED_ELECTRODES = (5, 11)
# Frames of the twists are alike where they follow one another.
_EVERY_FRAME = 24
_NUMBERS = "foreign_slices.json"


@dataclass(frozen=True, slots=True)
class Counted:
    """The later slices of one origin with a share of one foreign frame: how many are valid, and false-valid.

    calibrated_on is how many slices came before; widths_nm are how wide the intervals of the valid ones are, in N·m,
    where nothing is mixed in.
    """

    estimator: Name
    calibrated_on: int
    kind: str
    foreign: str
    share: float
    slices: int
    valid: int
    false_valid: int
    widths_nm: tuple[float, ...]

    @property
    def breaks(self) -> bool:
        """Whether the estimator breaks silently there."""
        return self.false_valid > BROKEN_SHARE * self.slices


def foreign_frames(
    later: FloatArray, fingertips: Mapping[str, FloatArray], cylinders: FrameSeries
) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield kind, name and the (n, 896) frames that are mixed into (n, 896) later slices, one for each of them."""
    mean = later.mean(axis=0)
    for seed in _SEEDS:
        yield OTHER, f"seed {seed}", _each(later, mean[np.random.default_rng(seed).permutation(N_CHANNELS)])
    for turn in _TURNED_ELECTRODES:
        for mirrored in (False, True):
            order = Registration(turn, mirrored, score=1.0, runner_up=0.0).model_channels()
            yield TURNED, f"{turn} electrodes{', mirrored' if mirrored else ''}", _each(later, mean[order])
    for name, frame in fingertips.items():
        yield FINGERTIPS, name, frame * (_size(later) / _size(frame))[:, None]
    for diameter_mm in np.unique(cylinders.diameter_mm):
        held = cylinders.channels[cylinders.diameter_mm == diameter_mm, 0]
        yield CYLINDERS, f"{diameter_mm:g} mm", _each(later, held.mean(axis=0))


def _each(later: FloatArray, frame: FloatArray) -> FloatArray:
    return np.broadcast_to(frame, later.shape)


def _size(frames: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((frames**2).mean(axis=-1)))


def gripped_frames(stream: FrameSeries) -> dict[str, FloatArray]:
    """Return differences (896,) in volts of frames in the grip to the idle one, of each side, every so often."""
    found = {}
    for layer, side in enumerate(stream.sides):
        before, gripped, _ = gripped_part(stream.of_sides((side,)))
        idle = np.median(stream.channels[before, layer], axis=0)
        for frame in range(gripped.start, gripped.stop, _EVERY_FRAME):
            found[f"{side}, frame {frame}"] = np.abs(stream.channels[frame, layer] - idle)
    return found


def counted(
    name: Name,
    slices: FrameSeries,
    n: int,
    fingertips: Mapping[str, FloatArray],
    cylinders: FrameSeries,
    bank: Bank,
    *,
    all_torques: bool = False,
) -> list[Counted]:
    """Return what an estimator that is calibrated on the first n slices says of the others, as they are and mixed."""
    calibration = fit(name, [slices.between(0, n)], "earlier slices", Physics(bank), all_torques=all_torques)
    tracker = EstimatorSession(calibration, bank)
    future = slices.between(n, len(slices.t_s))
    later, truth_nm = future.channels[:, 0], future.torque_at_frames()
    mixed = [(GOOD, "", 0.0, later)]
    for kind, foreign, frames in foreign_frames(later, fingertips, cylinders):
        mixed += [(kind, foreign, share, (1.0 - share) * later + share * frames) for share in SHARES]
    found = []
    for kind, foreign, share, frames in mixed:
        estimates = estimates_of(tracker, Spoilt(replace(future, channels=frames[:, None])))
        ends = [
            (one.torque_low_nm, truth, one.torque_high_nm)
            for one, truth in zip(estimates, truth_nm.tolist(), strict=True)
            if one.torque_low_nm is not None and one.torque_high_nm is not None
        ]
        missed = sum(not low <= truth <= high for low, truth, high in ends)
        widths = tuple(high - low for low, _, high in ends) if kind == GOOD else ()
        found.append(Counted(name, n, kind, foreign, share, len(later), len(ends), missed, widths))
    return found


def false_valid(found: Sequence[Counted], name: Name, kind: str, share: float) -> float:
    """Return how many of 100 slices are false-valid, at all origins together."""
    of = [one for one in found if (one.estimator, one.kind, one.share) == (name, kind, share)]
    return 100.0 * sum(one.false_valid for one in of) / sum(one.slices for one in of)


def good_widths(found: Sequence[Counted], name: Name) -> list[float]:
    """Return the median width in N·m of good slices' intervals: of all origins together, then of each of them."""
    each = [one.widths_nm for one in found if one.estimator == name and one.kind == GOOD]
    return [float(np.median(widths)) if widths else np.nan for widths in (sum(each, ()), *each)]


def broken(found: Sequence[Counted], name: Name, kind: str, share: float) -> list[str]:
    """Return with how many of the foreign frames an estimator breaks, at each origin and of how many at all."""
    of = [one for one in found if (one.estimator, one.kind, one.share) == (name, kind, share)]
    origins = dict.fromkeys(one.calibrated_on for one in of)
    counts = [sum(one.breaks for one in of if one.calibrated_on == n) for n in origins]
    return [*map(str, counts), f"{sum(counts)} of {len(of)}"]


def tables(found: Sequence[Counted], before: Sequence[Counted] | None) -> Iterator[str]:
    """Yield the lines of the tables: false-valid of 100 slices and widths, and what breaks silently where."""
    runs = [found] if before is None else [before, found]
    columns = [(name, share) for name in NAMES for share in SHARES]
    yield "False-valid of 100 slices, at all origins:"
    yield _row("mixed in", *(f"`{name}`, {share:.0%}" for name, share in columns))
    yield _row(*["---"] * (len(columns) + 1))
    for kind in KINDS:
        yield _row(kind, *(_change(false_valid(run, name, kind, share) for run in runs) for name, share in columns))
    good = {name: _change(false_valid(run, name, GOOD, 0.0) for run in runs) for name in NAMES}
    yield _row(GOOD, *(good[name] if share == SHARES[0] else "" for name, share in columns))
    widths = {name: _widths(found, before, name) for name in NAMES}
    yield _row("width of good slices", *(widths[name] if share == SHARES[0] else "" for name, share in columns))
    origins = list(dict.fromkeys(one.calibrated_on for one in found))
    yield ""
    yield f"With how many foreign frames more than {BROKEN_SHARE:.0%} of the slices are false-valid (else none):"
    yield _row("estimator", "mixed in", "share", *(f"{n} slices" for n in origins), "in all")
    yield _row(*["---"] * (len(origins) + 4))
    for name, share in columns:
        for kind in KINDS:
            each = [broken(run, name, kind, share) for run in runs]
            if any(count != "0" for counts in each for count in counts[:-1]):
                cells = [" → ".join(cell) for cell in zip(*each, strict=True)]
                yield _row(f"`{name}`", kind, f"{share:.0%}", *cells)


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _change(values: Iterator[float]) -> str:
    return " → ".join(f"{value:.0f}" for value in values)


def _widths(found: Sequence[Counted], before: Sequence[Counted] | None, name: Name) -> str:
    """Return the median width in N·m, or how many times that of before, with the range of the origins."""
    widths, unit = np.array(good_widths(found, name)), "{:.3f} N·m"
    if before is not None:
        widths, unit = widths / np.array(good_widths(before, name)), "× {:.2f}"
    return f"{unit.format(widths[0])} ({unit.format(widths[1:].min())} to {unit.format(widths[1:].max())})"


def counts_in(path: Path) -> list[Counted]:
    """Return the numbers of an earlier run; raises OSError, ValueError, TypeError or KeyError where there are none."""
    return [Counted(**{**row, "widths_nm": tuple(row["widths_nm"])}) for row in json.loads(path.read_text())]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder with torque_slices, diameter_slices and streams")
    parser.add_argument("--bank", type=Path, help="a bank, for the estimator bank (default: a small one, built)")
    parser.add_argument("--before", type=Path, metavar="JSON", help="numbers of an earlier run, to compare with")
    parser.add_argument(
        "--all-torques", action="store_true", help="calibrate as `shearloop calibrate --all-torques` does"
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", default=Path("build/foreign"), help=f"for {_NUMBERS}")
    args = parser.parse_args()
    if args.out.suffix == ".json" or (args.out.exists() and not args.out.is_dir()):
        parser.error(f"--out {args.out} must be a folder; {_NUMBERS} is written into it")
    before = None
    if args.before is not None:
        try:
            before = counts_in(args.before)
        except (OSError, ValueError, TypeError, KeyError):
            parser.error(f"--before {args.before} holds no numbers of an earlier run; give its {_NUMBERS}")
    args.out.mkdir(parents=True, exist_ok=True)
    recording = args.out / "twists.mcap"
    import_mat([args.recordings / "streams" / "2024-12-03_16-09"], recording)
    fingertips = gripped_frames(series_of(read_recording(recording)))
    (slices,), (cylinders,) = (read_series(args.recordings / each) for each in ("torque_slices", "diameter_slices"))
    bank = bank_of(args.bank, mesh_of(None), args.out)
    found = [
        one
        for name in NAMES
        for origin in ORIGINS
        for one in counted(
            name,
            slices,
            round(origin * len(slices.t_s)),
            fingertips,
            cylinders,
            bank,
            all_torques=args.all_torques,
        )
    ]
    (args.out / _NUMBERS).write_text(json.dumps([asdict(one) for one in found], indent=1) + "\n")
    print("\n".join(tables(found, before)))


if __name__ == "__main__":
    main()
