"""How long one recorded frame takes to match, hot and cold: the median, and what the slowest take.

    python -m benchmarks.match_times --bank run/paper.bank --recordings FOLDER --every 12 --out run/match_times.json

Hot: a frame is matched five times, and the least time counts. Cold: before each match others have had the caches, as in
a daemon between two frames, and of three times the middle one counts. Times are of the thread's processor; two states
are compared by runs of both that alternate.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import MATCHERS, OTHERS_BYTES
from benchmarks.same_maxima import recorded
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher

N_HOT, N_COLD = 5, 3
SHARES = (50, 90, 99, 100)


def seconds(matcher: PrunedMatcher | PrunedZeroLagMatcher, frame: NDArray[np.float64]) -> float:
    """Return what a match with runner-up takes of the processor."""
    begun = time.thread_time_ns()
    matcher.match(frame)
    return (time.thread_time_ns() - begun) / 1e9


def percentiles(times: list[float]) -> dict[str, float]:
    """Return the percentiles of SHARES, in milliseconds."""
    return {f"p{share}_ms": round(1e3 * float(np.percentile(times, share)), 4) for share in SHARES}


def main() -> None:
    """Time both kinds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--every", type=int, default=12)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    bank, others = Bank.open(args.bank), np.zeros(OTHERS_BYTES // 8)
    frames = np.vstack(list(recorded(args.recordings, 1)))[:: args.every]
    found: dict[str, Any] = {"frames": len(frames)}
    for name, kind in MATCHERS.items():
        matcher = kind.from_bank(bank)
        hot, cold = [], []
        for frame in frames:
            hot.append(min(seconds(matcher, frame) for _ in range(N_HOT)))
            middle = []
            for _ in range(N_COLD):
                others += 1.0
                middle.append(seconds(matcher, frame))
            cold.append(statistics.median(middle))
        found[name] = {"hot": percentiles(hot), "cold": percentiles(cold)}
        print(name, found[name])
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
