"""Whether the fast matchers find what the reference finds, on every recorded frame.

    python -m benchmarks.same_maxima --bank run/paper.bank --recordings FOLDER --every 1 --out run/same_maxima.json

A slice is a difference already; of a stream, every frame's difference to the mean of its first ten. The reference at
all lags takes a tenth of a second a frame and more: `--every N` gives it every N-th frame of the streams.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_LINE_VALUES, channels_of_line
from shearloop.bank.eit.matching import Matcher, ReferenceMatcher, ZeroLagMatcher, best_match
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher

AT_ONCE = 32
KINDS: dict[str, tuple[type[Matcher], type[PrunedMatcher | PrunedZeroLagMatcher]]] = {
    "all lags": (ReferenceMatcher, PrunedMatcher),
    "zero lag": (ZeroLagMatcher, PrunedZeroLagMatcher),
}


def recorded(folder: Path, every: int) -> Iterator[NDArray[np.float64]]:
    """Yield (n, 896) differences, those that are zero everywhere left out."""
    slices = [loadmat(path)["data_diff"].ravel() for path in sorted(folder.glob("*_slices/*_*.mat"))]
    streams = [
        channels_of_line(values[:, 1:])
        for path in sorted(folder.glob("streams/*/*.mat"))
        for values in loadmat(path).values()
        if getattr(values, "shape", (0, 0))[-1] == N_LINE_VALUES + 1
    ]
    for frames in (np.array(slices), *(each[10::every] - each[:10].mean(axis=0) for each in streams)):
        for start in range(0, len(frames), AT_ONCE):
            part = frames[start : start + AT_ONCE]
            yield part[part.any(axis=1)]


def main() -> None:
    """Compare, and write how many frames were alike."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    bank = Bank.open(args.bank)
    found = {}
    for kind in args.kinds:
        slow_kind, fast_kind = KINDS[kind]
        reference, fast = slow_kind.from_bank(bank), fast_kind.from_bank(bank)
        frames = same = 0
        furthest = 0.0
        for part in recorded(args.recordings, args.every):
            for frame, heatmap in zip(part, reference.heatmaps(part), strict=True):
                slow, quick = best_match(heatmap, bank.k_grid, bank.sigma_grid), fast.match(frame)
                frames += 1
                same += (slow.cell, slow.runner_up_cell) == (quick.cell, quick.runner_up_cell)
                furthest = max(furthest, abs(slow.score - quick.score))
        found[kind] = {"frames": frames, "same": same, "largest_difference_of_scores": furthest}
        print(kind, found[kind])
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"every": args.every, **found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
