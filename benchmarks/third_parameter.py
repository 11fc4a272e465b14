"""What a parameter beside k and σ buys: `python -m benchmarks.third_parameter RECORDING BANKS`.

BANKS is a folder of `shearloop bank build` over more parameters. For each of its banks: how well the recording's frames
correlate with their best cell, without lags and over all of them; and what the best bank for each frame would add.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.daemon.analysis.series import read_series
from shearloop.daemon.scene import scene_of

# All lags take a millisecond a frame and bank; more frames than this tell no more.
_MOST_FRAMES = 200


def main() -> None:
    """Match, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path, help="a recording, or a folder of slices")
    parser.add_argument("banks", type=Path, help="folder of banks over more parameters")
    parser.add_argument("--out", type=Path, help="JSON to write")
    args = parser.parse_args()
    (series, *_) = read_series(args.recording)
    frames = np.abs(scene_of(series).differences)
    frames = frames[:: 1 + len(frames) // _MOST_FRAMES]
    paths = sorted(args.banks.glob("*.bank"))
    if not paths:
        parser.error(f"{args.banks} holds no banks; make some with `shearloop bank build` and `over`")
    scores = {}
    for path in paths:
        bank = Bank.open(path)
        matchers = PrunedZeroLagMatcher.from_bank(bank), PrunedMatcher.from_bank(bank)
        scores[path.stem] = [[matcher.match(frame, runner_up=False).score for frame in frames] for matcher in matchers]
    found = np.array(list(scores.values()))
    print(f"{len(frames)} frames of {args.recording.name}: mean score of the best cell, at lag 0 and over all lags")
    for name, (zero, every) in zip(scores, found.mean(axis=2), strict=True):
        print(f"  {name:<40}{zero:.4f}  {every:.4f}")
    zero, every = found.max(axis=0).mean(axis=1)
    print(f"  {'the best bank of each frame':<40}{zero:.4f}  {every:.4f}")
    if args.out:
        args.out.write_text(json.dumps({name: np.mean(one, axis=1).tolist() for name, one in scores.items()}) + "\n")


if __name__ == "__main__":
    main()
