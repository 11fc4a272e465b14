"""What the check of a grip's strength does: every recorded grip judged by a calibration on another one.

    python -m benchmarks.grip_strength RECORDINGS --out DIR

RECORDINGS holds streams. The default estimator is fitted to each stream, and judges every other one of the same tool,
with its sides as they are and exchanged. A row is a pair with valid frames where the check is off: each fingertip's
strength that the check compares, as a ratio of the calibrated one (the median over these frames, the least and the
largest); then the fraction of valid frames, their loaded ones, and the coverage of these, without the check and with
it. Writes grip_strength.json.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.common import parser_of, table_head, table_row, write_figures
from benchmarks.estimator_accuracy import FINGERTIPS, STREAMS
from shearloop.bank.arrays import BoolArray
from shearloop.bank.errors import BankError
from shearloop.estimation import Calibration, FrameSeries, Session, fit, measure_timing
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import DEFAULT
from shearloop.estimation.load_delay import TRUSTED
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series, values_of
from shearloop.tools.frame_series import series_of
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.matlab_import import import_mat

CYLINDERS = ("10mm_1", "20mm_1", "30mm_1", "30mm_2", "40mm_1")
COLUMNS = (
    "fitted to",
    "judged on",
    "strength: median (least to largest)",
    *("valid without the check", "loaded", "coverage"),
    *("valid with it", "loaded", "coverage"),
)


class Judged(NamedTuple):
    """The valid fraction of all frames, the number of loaded ones among them, and the coverage of these."""

    valid: float
    loaded: int
    coverage: float | None


class Strength(NamedTuple):
    """The strength of one fingertip's grip over the valid frames, as a ratio of the calibrated one."""

    median: float
    least: float
    largest: float


def read_streams(recordings: Path, scratch: Path) -> dict[str, FrameSeries]:
    """Return every stream and cylinder of the paper, by its name."""
    streams = recordings / "streams"
    sources = {name: [streams / folder] for name, folder in STREAMS.items()}
    for name in CYLINDERS:
        sources[name] = [streams / "cylinders" / f"{name}_{what}.mat" for what in ("right", "truth")]
    found: dict[str, FrameSeries] = {}
    for name, paths in sources.items():
        # The name shows a cylinder's diameter.
        path = scratch / f"{name}.mcap"
        import_mat(paths, path)
        found[name] = series_of(read_recording(path))
    return found


def pairs(streams: dict[str, FrameSeries]) -> Iterator[tuple[str, str, Calibration, FrameSeries]]:
    """Yield both titles, the calibration and the judged series, for every pair of series of one tool."""
    for name, series in streams.items():
        for sides in (one for one in FINGERTIPS if set(one) <= set(series.sides)):
            chosen = [series.select_sides(sides)]
            timing = measure_timing(chosen, [series]) if len(series.sides) > 1 else TRUSTED
            try:
                calibration = fit(DEFAULT, chosen, name, timing=timing)
            except BankError:
                continue
            title = f"{name}, {' and '.join(sides)}"
            others = {
                each: other for each, other in streams.items() if each != name and other.tool_mm == series.tool_mm
            }
            for each, other in others.items():
                for shown, judged in _orders(each, other, sides):
                    yield title, shown, calibration, judged


def _orders(name: str, series: FrameSeries, sides: Sequence[str]) -> Iterator[tuple[str, FrameSeries]]:
    """Yield a stream's sides as they are, and exchanged: the fingertips changed sides between the days."""
    if set(sides) <= set(series.sides):
        yield name, series.select_sides(tuple(sides))
    if len(series.sides) > 1:
        exchanged = replace(series, channels=series.channels[:, ::-1].copy())
        yield f"{name}, exchanged", exchanged.select_sides(tuple(sides))


def without_check(calibration: Calibration) -> Calibration:
    """Return the calibration as of a file that does not hold the strength of its grips."""
    unknown = [replace(one, strength=None) for one in calibration.validators]
    return replace(calibration, validators=tuple(unknown))


def judge(track: EstimateTrack) -> Judged:
    """Return how much of a track is valid, and how often its loaded intervals hold the truth."""
    truth = track.series.torque_at_frames()
    value, low, high = values_of(track.estimates)
    valid = np.isfinite(value)
    loaded = valid & (np.abs(truth) >= LOADED_NM)
    inside = (low <= truth) & (truth <= high)
    n = int(np.count_nonzero(loaded))
    return Judged(float(valid.mean()), n, float(inside[loaded].mean()) if n else None)


def strengths(calibration: Calibration, series: FrameSeries, valid: BoolArray) -> list[Strength]:
    """Return each fingertip's strength over the `valid` frames (n,), one of them at least."""
    session = Session(calibration)
    ratios: list[list[float]] = []
    for frame, counts in zip(series.frames(), valid.tolist(), strict=True):
        session.estimate(frame)
        if counts:
            ratios.append([session.grip_strengths[side] for side in calibration.sides])
    return [Strength(*map(float, (np.median(one), min(one), max(one)))) for one in zip(*ratios, strict=True)]


def shown(strength: Strength) -> str:
    """Return a strength as text."""
    return f"{strength.median:.2f} ({strength.least:.2f} to {strength.largest:.2f})"


def main() -> None:
    """Measure, print, write."""
    parser = parser_of(__doc__)
    parser.add_argument("recordings", type=Path, help="folder with streams")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    found: list[dict[str, object]] = []
    print(table_head(*COLUMNS))
    for title, name, calibration, series in pairs(read_streams(args.recordings, args.out)):
        unchecked = estimate_series(without_check(calibration), series)
        before = judge(unchecked)
        if not before.valid:
            continue
        after = judge(estimate_series(calibration, series))
        ratios = strengths(calibration, series, np.isfinite(values_of(unchecked.estimates)[0]))
        print(table_row(title, name, ", ".join(map(shown, ratios)), *before, *after), flush=True)
        found.append(
            {
                "fitted_to": title,
                "judged_on": name,
                "strength": [one._asdict() for one in ratios],
                "without": before._asdict(),
                "with": after._asdict(),
            }
        )
    write_figures(args.out / "grip_strength.json", found)


if __name__ == "__main__":
    main()
