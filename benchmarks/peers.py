"""Every peer beside shearloop's own, in one run: bank cells and matches, as ratios.

    python -m benchmarks.peers --bank run/paper.bank --mesh MESH --recordings FOLDER --out run/peers.json

Methods take turns, so that a busy moment of the machine meets all alike; a ratio is of one turn, and its median and
quartiles are over the turns. `pip install -e '.[bench]'` brings pyEIT and FAISS; without them they are left out, and
named as such. EIDORS needs MATLAB or Octave: its figure is cited.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft

from benchmarks.daemon_parts import spread
from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import MIN_SIGNAL_NORM, Bank
from shearloop.bank.eit.batch_forward import BatchForwardModel
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS, N_ELECTRODES
from shearloop.bank.eit.matching import Match, ReferenceMatcher, unit_magnitudes
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import Conductivities
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.daemon.bank_config import load_geometry
from shearloop.daemon.workers import ProcessExecutor

Run = Callable[[], object]
# Seconds per cell with warm caches, on the paper's mesh of 4882 triangles.
EIDORS_CELL_S = 0.034
MODEL = "gaussian_derivative"
N_CELLS = 128
N_FRAMES = 40
N_CHECKED = 10
# Frames of a batch: some twenty seconds at all lags, against which the start of two processes is little.
BATCH = 20_000
# Written between two frames that are to be matched cold: more than what a processor's core has of its own.
OTHERS_BYTES = 64 << 20
MATCHERS: dict[str, type[PrunedMatcher | PrunedZeroLagMatcher]] = {
    "all lags": PrunedMatcher,
    "zero lag": PrunedZeroLagMatcher,
}


def cell_methods(mesh: Mesh) -> tuple[dict[str, tuple[Run, int]], dict[str, float]]:
    """Return what solves cells, with how many each call solves, and how far the fast ones are from the direct solve."""
    random = np.random.default_rng(0)
    of = Conductivities(mesh)
    settings: list[tuple[float, float]] = []
    while len(settings) < N_CELLS:
        k, sigma = random.uniform(0.01, 4.4, 2).tolist()
        if of.of(MODEL, k, sigma).min() > 0:
            settings.append((k, sigma))
    model = BatchForwardModel(mesh)

    def fast(some: list[tuple[float, float]]) -> FloatArray:
        return model.voltages(np.array([of.of(MODEL, *each) for each in some]))

    def threaded() -> list[FloatArray]:
        with ThreadPoolExecutor(2) as pool:
            return list(pool.map(fast, [settings[i : i + 32] for i in range(0, N_CELLS, 32)]))

    one = settings[0]
    methods: dict[str, tuple[Run, int]] = {
        "direct": (lambda: model.direct.voltages(of.of(MODEL, *one)), 1),
        "fast, one thread": (lambda: fast(settings), N_CELLS),
        "fast, two threads": (threaded, N_CELLS),
    }
    pyeit = pyeit_solver(mesh)
    if pyeit is not None:
        methods["pyEIT"] = (lambda: pyeit(of.of(MODEL, *one)), 1)
    homogeneous = model.direct.homogeneous()
    found = fast(settings[:40])
    errors = []
    for voltages, each in zip(found, settings, strict=False):
        truth = model.direct.voltages(of.of(MODEL, *each))
        if (size := np.linalg.norm(truth - homogeneous)) >= MIN_SIGNAL_NORM:
            errors.append(np.linalg.norm(voltages - truth) / size)
    return methods, {"largest": float(np.max(errors)), "cells": len(errors)}


def pyeit_solver(mesh: Mesh) -> Callable[[FloatArray], object] | None:
    """Return pyEIT's forward solve of the same patterns on the same mesh, with its point electrodes."""
    try:
        from pyeit.eit.fem import EITForward
        from pyeit.eit.protocol import PyEITProtocol
        from pyeit.mesh import PyEITMesh
    except ImportError:
        return None
    nodes = np.column_stack([mesh.nodes, np.zeros(len(mesh.nodes))])
    middles = [mesh.electrode_edges[mesh.electrode_of_edge == e][0, 0] for e in range(N_ELECTRODES)]
    free = int(np.setdiff1d(np.arange(len(mesh.nodes)), mesh.electrode_edges)[0])
    body = PyEITMesh(node=nodes, element=np.asarray(mesh.triangles), el_pos=np.array(middles), ref_node=free)
    injections = CHANNELS.reshape(N_ELECTRODES, -1, 4)
    protocol = PyEITProtocol(
        injections[:, 0, [1, 0]].copy(), injections[:, :, 2:].copy(), np.ones(N_CHANNELS, dtype=bool)
    )
    solver = EITForward(body, protocol)

    def solve(conductivity: FloatArray) -> object:
        return solver.solve_eit(perm=conductivity)

    return solve


def match_methods(bank: Bank, frames: FloatArray) -> tuple[dict[str, tuple[Run, int]], int]:
    """Return what finds the best cell of every frame, and in how many frames the fast ones find the reference's."""
    units = unit_magnitudes(frames)
    single = units.astype(np.float32)
    signals = np.abs(bank.signals[bank.valid]).astype(np.float32)
    signals /= np.linalg.norm(signals, axis=1, keepdims=True)
    length = fft.next_fast_len(2 * N_CHANNELS - 1, real=True)
    spectra = np.conj(fft.rfft(signals, length)).astype(np.complex64)
    zero, every = PrunedZeroLagMatcher.from_bank(bank), PrunedMatcher.from_bank(bank)
    reference = ReferenceMatcher.from_bank(bank)
    n = len(frames)

    def by_fft() -> list[int]:
        return [
            int(np.argmax(fft.irfft(fft.rfft(frame, length) * spectra, length).max(axis=1))) for frame in single[:4]
        ]

    methods: dict[str, tuple[Run, int]] = {
        "zero lag, fast": (lambda: [zero.match(frame, runner_up=False) for frame in frames], n),
        "zero lag, fast, with runner-up": (lambda: [zero.match(frame) for frame in frames], n),
        "zero lag, numpy float32": (lambda: [int(np.argmax(signals @ frame)) for frame in single], n),
        "all lags, fast": (lambda: [every.match(frame, runner_up=False) for frame in frames], n),
        "all lags, fast, with runner-up": (lambda: [every.match(frame) for frame in frames], n),
        "all lags, numpy float32 FFT": (by_fft, 4),
    }
    try:
        import faiss
    except ImportError:
        pass
    else:
        faiss.omp_set_num_threads(1)
        index = faiss.IndexFlatIP(N_CHANNELS)
        index.add(signals)
        methods["zero lag, FAISS flat"] = (lambda: [index.search(frame[None], 1) for frame in single], n)
    same = 0
    for frame in frames[:N_CHECKED]:
        slow, quick = reference.match(frame), every.match(frame)
        same += (slow.cell, slow.runner_up_cell) == (quick.cell, quick.runner_up_cell)
    return methods, same


def frames_of(bank: Bank, recordings: Path | None) -> FloatArray:
    """Return (n, 896) differences: recorded slices where there are any, else the bank's signals with noise."""
    if recordings is not None:
        from scipy.io import loadmat

        files = sorted(recordings.glob("*_slices/*_*.mat"))
        found = np.array([loadmat(file)["data_diff"].ravel() for file in files])
        return np.asarray(found[np.linspace(0, len(found) - 1, N_FRAMES).astype(int)])
    random = np.random.default_rng(1)
    cells = bank.signals[bank.valid]
    chosen = np.array(cells[random.integers(len(cells), size=N_FRAMES)], dtype=np.float64)
    chosen /= np.linalg.norm(chosen, axis=1, keepdims=True)
    return chosen + random.normal(0, 0.3 / np.sqrt(N_CHANNELS), chosen.shape)


def batches_a_minute(bank: Path, frames: FloatArray, turns: int) -> dict[str, Any]:
    """Return how many frames a minute are matched in batches, in one process, and in two with the start of those."""
    many = np.tile(frames, (-(-BATCH // len(frames)), 1))[:BATCH]
    found: dict[str, Any] = {}
    for name, kind in MATCHERS.items():
        matcher = kind.from_bank(Bank.open(bank))
        seconds = take_turns(
            {
                f"{name}, one process": (lambda: [matcher.match(one, runner_up=False) for one in many], BATCH),  # noqa: B023 - runs in its turn
                f"{name}, two processes": (
                    lambda: list(ProcessExecutor(2).map(matched, (name, bank), np.array_split(many, 2))),  # noqa: B023
                    BATCH,
                ),
            },
            turns,
        )
        found |= {each: spread([60 / one for one in taken]) for each, taken in seconds.items()}
    return found


def matched(shared: tuple[str, Path], frames: FloatArray) -> list[Match]:
    """Return the matches of (n, 896) differences, wherever this runs."""
    name, bank = shared
    matcher = MATCHERS[name].from_bank(Bank.open(bank))
    return [matcher.match(frame, runner_up=False) for frame in frames]


def take_turns(methods: Mapping[str, tuple[Run, int]], turns: int) -> dict[str, list[float]]:
    """Return the seconds per cell or frame of every method in every turn."""
    for run, _ in methods.values():
        run()
    found: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(turns):
        for name, (run, n) in methods.items():
            begun = time.perf_counter()
            run()
            found[name].append((time.perf_counter() - begun) / n)
    return found


def cold_seconds(bank: Bank, frames: FloatArray, turns: int) -> dict[str, list[float]]:
    """Return the median seconds of a match with runner-up in every turn, each after others have had the caches.

    So frames come in a daemon, half a second apart.
    """
    matchers = {name: kind.from_bank(bank) for name, kind in MATCHERS.items()}
    others = np.zeros(OTHERS_BYTES // 8)
    found: dict[str, list[float]] = {name: [] for name in matchers}
    for _ in range(turns):
        for name, matcher in matchers.items():
            taken = []
            for frame in frames:
                others += 1.0
                begun = time.perf_counter()
                matcher.match(frame)
                taken.append(time.perf_counter() - begun)
            found[name].append(statistics.median(taken))
    return found


def ratios(seconds: Mapping[str, list[float]], own: str, peers: Iterable[str]) -> dict[str, Any]:
    """Return how many times as long each peer takes as our own method, turn by turn."""
    return {
        f"{peer} / {own}": spread([slow / fast for slow, fast in zip(seconds[peer], seconds[own], strict=True)])
        for peer in peers
        if peer in seconds
    }


def main() -> None:
    """Run all and write the ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path, required=True, help="a bank of 100 × 100 cells")
    parser.add_argument("--mesh", type=Path, default=Path("config/fingertips/paper.yaml"))
    parser.add_argument("--recordings", type=Path, help="a folder with torque_slices and diameter_slices")
    parser.add_argument("--turns", type=int, default=7, help="at least five")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.turns < 5:
        parser.error("--turns must be 5 or more")
    mesh, bank = load_geometry(args.mesh), Bank.open(args.bank)
    cells, error = cell_methods(mesh)
    frames = frames_of(bank, args.recordings)
    matches, same = match_methods(bank, frames)
    seconds = take_turns({**cells, **matches}, args.turns)
    own, exact, quick = "fast, two threads", "all lags, fast", "zero lag, fast"
    found: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "load_average": os.getloadavg()[0]},
        "triangles": len(mesh.triangles),
        "cells": int(bank.valid.sum()),
        "seconds": {name: spread(each) for name, each in seconds.items()},
        "ratios": {
            **ratios(seconds, own, ("pyEIT", "direct", "fast, one thread")),
            **ratios(seconds, exact, ("all lags, numpy float32 FFT", "all lags, fast, with runner-up")),
            **ratios(
                seconds,
                quick,
                ("zero lag, numpy float32", "zero lag, FAISS flat", "zero lag, fast, with runner-up"),
            ),
        },
        "cited": {
            "EIDORS, seconds per cell": EIDORS_CELL_S,
            f"EIDORS / {own}": EIDORS_CELL_S / statistics.median(seconds[own]),
        },
        "seconds_of_a_cold_match": {
            name: spread(each) for name, each in cold_seconds(bank, frames, args.turns).items()
        },
        "batches_a_minute": batches_a_minute(args.bank, frames, args.turns),
        "error_against_direct": error,
        f"matches_like_the_reference_of_{N_CHECKED}": same,
        "left_out": [
            name for name, there in (("pyEIT", "pyEIT"), ("FAISS", "zero lag, FAISS flat")) if there not in seconds
        ],
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
