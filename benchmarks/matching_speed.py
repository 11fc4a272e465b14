"""Time per bank cell and per match against other methods, and agreement of the pruned matchers with the reference.

    python -m benchmarks.matching_speed --bank run/paper.bank --mesh MESH --recordings FOLDER --out FILE

Methods take turns, so that a busy moment of the machine affects all alike; medians and quartiles are over the turns.
`pip install -e '.[bench]'` installs pyEIT; without it its row is missing.
EIDORS needs MATLAB or Octave, so its time is cited. `--every N` also checks every N-th recorded frame against the
reference matchers, which takes a tenth of a second a frame and more.
"""

import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from timeit import timeit
from typing import Any

import numpy as np
from scipy import fft
from scipy.io import loadmat

from benchmarks.common import parser_of, write_figures
from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import MIN_SIGNAL_NORM, Bank
from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.eit.forward import BatchForwardModel
from shearloop.bank.eit.matching import Matcher, ReferenceMatcher, ZeroLagMatcher, best_match, unit_magnitudes
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import ConductivityModel
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.daemon.analysis.charts.forward_methods import EIDORS_CELL_S, MODEL, pyeit_solver
from shearloop.daemon.bank_config import load_geometry

Run = Callable[[], object]
N_CELLS = 128
N_FRAMES = 40
# Memory written before each cold match: more than the caches of one core.
CACHE_BYTES = 64 << 20
MATCHERS: dict[str, tuple[type[Matcher], type[PrunedMatcher | PrunedZeroLagMatcher]]] = {
    "all lags": (ReferenceMatcher, PrunedMatcher),
    "zero lag": (ZeroLagMatcher, PrunedZeroLagMatcher),
}


def cell_methods(mesh: Mesh) -> tuple[dict[str, tuple[Run, int]], float]:
    """Return the solvers with the number of cells of each call, and the batch's largest error against the direct solve.

    The error is relative to the difference signal.
    """
    random = np.random.default_rng(0)
    of = ConductivityModel(mesh)
    settings: list[tuple[float, float]] = []
    while len(settings) < N_CELLS:
        k, sigma = random.uniform(0.01, 4.4, 2).tolist()
        if of.conductivity(MODEL, k, sigma).min() > 0:
            settings.append((k, sigma))
    model = BatchForwardModel(mesh)

    def batch(some: list[tuple[float, float]]) -> FloatArray:
        return model.voltages(np.array([of.conductivity(MODEL, *each) for each in some]))

    def threaded() -> list[FloatArray]:
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(batch, [settings[i : i + 32] for i in range(0, N_CELLS, 32)]))

    one = settings[0]
    methods: dict[str, tuple[Run, int]] = {
        "direct": (lambda: model.direct.voltages(of.conductivity(MODEL, *one)), 1),
        "batch, one thread": (lambda: batch(settings), N_CELLS),
        "batch, two threads": (threaded, N_CELLS),
    }
    pyeit = pyeit_solver(mesh)
    if pyeit is not None:
        methods["pyEIT"] = (lambda: pyeit(of.conductivity(MODEL, *one)), 1)
    homogeneous = model.direct.homogeneous()
    largest = 0.0
    for voltages, each in zip(batch(settings[:40]), settings, strict=False):
        truth = model.direct.voltages(of.conductivity(MODEL, *each))
        if (size := np.linalg.norm(truth - homogeneous)) >= MIN_SIGNAL_NORM:
            largest = max(largest, float(np.linalg.norm(voltages - truth) / size))
    return methods, largest


def match_methods(bank: Bank, frames: FloatArray) -> dict[str, tuple[Run, int]]:
    """Return the functions that match frames, with the number of frames of each call."""
    single = unit_magnitudes(frames, PAPER_TABLE.n_channels).astype(np.float32)
    signals = np.abs(bank.signals[bank.valid]).astype(np.float32)
    signals /= np.linalg.norm(signals, axis=1, keepdims=True)
    length = fft.next_fast_len(2 * PAPER_TABLE.n_channels - 1, real=True)
    spectra = np.conj(fft.rfft(signals, length)).astype(np.complex64)
    every, zero = PrunedMatcher.from_bank(bank), PrunedZeroLagMatcher.from_bank(bank)
    n = len(frames)

    def by_fft() -> list[int]:
        return [
            int(np.argmax(fft.irfft(fft.rfft(frame, length) * spectra, length).max(axis=1))) for frame in single[:4]
        ]

    return {
        "zero lag, pruned": (lambda: [zero.match(frame) for frame in frames], n),
        "zero lag, numpy float32": (lambda: [int(np.argmax(signals @ frame)) for frame in single], n),
        "all lags, pruned": (lambda: [every.match(frame) for frame in frames], n),
        "all lags, numpy float32 FFT": (by_fft, 4),
    }


def recorded_slices(folder: Path) -> FloatArray:
    """Return the differences (n, 896) of all recorded slices."""
    return np.array([loadmat(path)["data_diff"].ravel() for path in sorted(folder.glob("*_slices/*_*.mat"))])


def recorded_frames(folder: Path, every: int) -> Iterator[FloatArray]:
    """Yield (n, 896) differences of all slices, and of every n-th stream frame to the mean of its first ten."""
    streams = [
        PAPER_TABLE.channels_of_line(values[:, 1:])
        for path in sorted(folder.glob("streams/*/*.mat"))
        for values in loadmat(path).values()
        if getattr(values, "shape", (0, 0))[-1] == PAPER_TABLE.n_line_values + 1
    ]
    for frames in (recorded_slices(folder), *(each[10::every] - each[:10].mean(axis=0) for each in streams)):
        for start in range(0, len(frames), 32):
            part = frames[start : start + 32]
            yield part[part.any(axis=1)]


def compare_with_reference(bank: Bank, parts: list[FloatArray]) -> dict[str, dict[str, float]]:
    """Return by matcher how many frames have the reference's cell and runner-up, and the largest score difference."""
    found = {}
    for name, (slow_kind, fast_kind) in MATCHERS.items():
        reference, fast = slow_kind.from_bank(bank), fast_kind.from_bank(bank)
        frames = same = 0
        furthest = 0.0
        for part in parts:
            for frame, heatmap in zip(part, reference.heatmaps(part), strict=True):
                slow, quick = best_match(heatmap, bank.k_grid, bank.sigma_grid), fast.match(frame)
                frames += 1
                same += (slow.cell, slow.runner_up_cell) == (quick.cell, quick.runner_up_cell)
                furthest = max(furthest, abs(slow.score - quick.score))
        found[name] = {"frames": frames, "same": same, "largest_score_difference": furthest}
    return found


def take_turns(methods: Mapping[str, tuple[Run, int]], turns: int) -> dict[str, list[float]]:
    """Return the seconds per cell or frame of every method in every turn."""
    for run, _ in methods.values():
        run()
    found: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(turns):
        for name, (run, n) in methods.items():
            found[name].append(timeit(run, number=1) / n)
    return found


def cold_seconds(bank: Bank, frames: FloatArray, turns: int) -> dict[str, list[float]]:
    """Return the median seconds of a match in every turn, with cold caches as in a daemon."""
    matchers = {name: fast.from_bank(bank) for name, (_, fast) in MATCHERS.items()}
    memory = np.zeros(CACHE_BYTES // 8)
    found: dict[str, list[float]] = {f"{name}, cold": [] for name in matchers}
    for _ in range(turns):
        for name, matcher in matchers.items():
            taken = []
            for frame in frames:
                memory += 1.0
                taken.append(timeit(partial(matcher.match, frame), number=1))
            found[f"{name}, cold"].append(statistics.median(taken))
    return found


def spread(values: list[float]) -> dict[str, float]:
    """Return the median and quartiles of some values."""
    low, middle, high = statistics.quantiles(values, n=4)
    return {"median": middle, "low": low, "high": high}


def main() -> None:
    """Measure all and write the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--bank", type=Path, required=True, help="a bank of 100 × 100 cells")
    parser.add_argument("--mesh", type=Path, default=Path("config/fingertips/paper.yaml"))
    parser.add_argument("--recordings", type=Path, required=True, help="folder with slices and streams")
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--every", type=int, default=0, metavar="N", help="check every N-th frame (default: none)")
    args = parser.parse_args()
    bank, slices = Bank.open(args.bank), recorded_slices(args.recordings)
    frames = slices[np.linspace(0, len(slices) - 1, N_FRAMES).astype(int)]
    cells, error = cell_methods(load_geometry(args.mesh).mesh)
    seconds = take_turns({**cells, **match_methods(bank, frames)}, args.turns)
    seconds |= cold_seconds(bank, frames, args.turns)
    found: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "load_average": os.getloadavg()[0]},
        "cells": int(bank.valid.sum()),
        "seconds": {name: spread(each) for name, each in seconds.items()},
        "eidors_cited_s": EIDORS_CELL_S,
        "batch_error_against_direct": error,
    }
    if args.every:
        found["like_the_reference"] = compare_with_reference(bank, list(recorded_frames(args.recordings, args.every)))
    print(write_figures(args.out, found))


if __name__ == "__main__":
    main()
