"""Every way from a frame to a torque, with the same head behind each, fitted to the past and judged on the future."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import Float32Array, FloatArray, IntArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.matching import Matcher, ReferenceMatcher, ZeroLagMatcher
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.bank.errors import BankError
from shearloop.bank.estimation import Calibration, FrameSeries, Name, Physics, fit
from shearloop.bank.estimation.bank_match import NOT_TURNED, NearestCell
from shearloop.bank.estimation.fitting_regressor import fit_reader
from shearloop.bank.estimation.interval_regressor import IntervalRegressor
from shearloop.bank.estimation.regressors import Ridge, ranked_channels
from shearloop.daemon.analysis.charts.sources import Split
from shearloop.daemon.analysis.evaluation import follow

RANKS = (4, 8, 16, 32, 64, 128)
CHANNEL_COUNTS = (8, 16, 32, 64, 128, 272, 512)
# The paper's polynomial needs no holding back.
_POLYNOMIAL = (1e-9,)
_CHUNK = 512
# Cells whose signals give the directions of a bank of low rank.
_ENOUGH_CELLS = 2000


@dataclass(frozen=True, slots=True)
class Method:
    """One way: `run()` returns torques (n,) in N·m of the future's frames, NaN where not valid, and ms for each."""

    name: str
    family: str
    run: Callable[[], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True)
class Measured:
    """A method's time and error: the median of the rounds' medians, and the fastest and slowest round."""

    name: str
    family: str
    latency_ms: float
    latency_low_ms: float
    latency_high_ms: float
    rmse_nm: float
    r: float | None
    valid_fraction: float


def measure(methods: list[Method], truth_nm: FloatArray, rounds: int) -> list[Measured]:
    """Run all methods in turn, `rounds` times, so that a busy moment of the machine meets all of them alike."""
    times: dict[str, list[float]] = {method.name: [] for method in methods}
    torques: dict[str, FloatArray] = {}
    for _ in range(rounds):
        for method in methods:
            torques[method.name], latency_ms = method.run()
            times[method.name].append(float(np.median(latency_ms)))
    found = []
    for method in methods:
        valid = np.isfinite(torques[method.name])
        judged = valid & np.isfinite(truth_nm)
        if judged.sum() < 2:
            continue
        value, truth = torques[method.name][judged], truth_nm[judged]
        varies = value.std() > 0 and truth.std() > 0
        own = times[method.name]
        found.append(
            Measured(
                method.name, method.family, float(np.median(own)), min(own), max(own),
                float(np.sqrt(((value - truth) ** 2).mean())),
                float(np.corrcoef(value, truth)[0, 1]) if varies else None, float(valid.mean()),
            )
        )  # fmt: skip
    return found


def estimators(split: Split, physics: Physics, names: tuple[Name, ...], sides: tuple[str, ...]) -> Iterator[Method]:
    """Yield the package's estimators on these sides, as they run live; those that the past does not determine not."""
    past, future = split.past.of_sides(sides), split.future.of_sides(sides)
    count = f", {sides[0] if len(sides) == 1 else 'both'}" if past.kind == "raw" else ""
    for name in names:
        try:
            calibration = fit(name, [past], split.title, physics, timed_by=[split.past])
        except BankError as error:
            print(f"{split.title}: {name}{count} is left out: {error}")
            continue

        family = "estimator, two fingertips" if len(sides) > 1 else "estimator"
        yield Method(f"{name}{count}", family, partial(_followed, calibration, future, physics.bank))


def _followed(calibration: Calibration, future: FrameSeries, bank: Bank | None) -> tuple[FloatArray, FloatArray]:
    track = follow(calibration, future, bank)
    torque = [np.nan if one.torque_nm is None else one.torque_nm for one in track.estimates]
    return np.array(torque), track.latency_ms


def matchers(split: Split, bank: Bank) -> Iterator[Method]:
    """Yield every way to find σ in the bank, all with the paper's parabola from σ to torque behind."""
    sigma = bank.sigma_grid
    for name, family, kind in (
        ("paper: all lags, reference", "all lags", ReferenceMatcher),
        ("all lags, fast and exact", "all lags", PrunedMatcher),
        ("zero lag, reference", "zero lag", ZeroLagMatcher),
        ("zero lag, fast and exact", "zero lag", PrunedZeroLagMatcher),
    ):
        yield _read_by(split, name, family, _sigma_by(kind.from_bank(bank)))
    nearest = NearestCell(bank, NOT_TURNED)
    yield _read_by(split, "zero lag, smoothed, sub-grid", "zero lag", lambda x: nearest.locate(x).sigma)
    cells = np.flatnonzero(bank.valid)
    shapes = np.abs(bank.signals.reshape(-1, bank.signals.shape[-1])[cells])
    shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)

    def best_of(scores: Callable[[Float32Array], Float32Array]) -> Callable[[FloatArray], float]:
        column = sigma[cells % len(sigma)]
        return lambda x: float(column[np.argmax(scores((x / np.linalg.norm(x)).astype(np.float32)))])

    yield _read_by(split, "zero lag, float32", "precision", best_of(partial(np.matmul, shapes)))
    yield _read_by(split, "zero lag, float16", "precision", best_of(partial(_half_scores, shapes.astype(np.float16))))
    basis = np.linalg.svd(shapes[:: max(1, len(shapes) // _ENOUGH_CELLS)], full_matrices=False)[2]
    for rank in RANKS:
        directions = np.ascontiguousarray(basis[:rank])
        scores = partial(_compressed_scores, directions, np.ascontiguousarray(shapes @ directions.T))
        yield _read_by(split, f"rank {rank}", "zero lag, bank of rank r", best_of(scores))


def _sigma_by(matcher: Matcher) -> Callable[[FloatArray], float]:
    if isinstance(matcher, PrunedMatcher | PrunedZeroLagMatcher):
        return lambda x: matcher.match(x, runner_up=False).sigma
    return lambda x: matcher.match(x).sigma


def _compressed_scores(directions: Float32Array, numbers: Float32Array, frame: Float32Array) -> Float32Array:
    return numbers @ (directions @ frame)


def _half_scores(shapes: NDArray[np.float16], frame: Float32Array) -> Float32Array:
    """Return the scores of signals kept in half the memory; products are in float32, which BLAS knows."""
    parts = [shapes[i : i + _CHUNK].astype(np.float32) @ frame for i in range(0, len(shapes), _CHUNK)]
    return np.concatenate(parts)


def fewer_channels(split: Split) -> Iterator[Method]:
    """Yield regressions on the channels that go best with the torque in the past."""
    differences, torque = np.abs(split.past.channels[:, 0]), split.past.torque_at_frames()
    order = ranked_channels(differences, torque)
    for count in CHANNEL_COUNTS:
        best = order[:count]
        reader = fit_reader(differences[:, best], torque, Ridge.fit)
        yield Method(
            f"{count} channels",
            "regression on the best n channels",
            _timed(split, partial(_read_some, reader, best)),
        )


def _read_some(reader: IntervalRegressor, channels: IntArray, difference: FloatArray) -> float:
    return reader.read(difference[channels])[0]


def _read_by(split: Split, name: str, family: str, locate: Callable[[FloatArray], float]) -> Method:
    def features(difference: FloatArray) -> FloatArray:
        sigma = float(locate(difference))
        return np.array([sigma, sigma**2])

    past = np.array([features(frame) for frame in np.abs(split.past.channels[:, 0])])
    reader = fit_reader(past, split.past.torque_at_frames(), Ridge.fit_scaled, strengths=_POLYNOMIAL)
    return Method(name, family, _timed(split, lambda x: reader.read(features(x))[0]))


def _timed(split: Split, read: Callable[[FloatArray], float]) -> Callable[[], tuple[FloatArray, FloatArray]]:
    frames = np.abs(split.future.channels[:, 0])

    def run() -> tuple[FloatArray, FloatArray]:
        values, times = [], []
        for frame in frames:
            begun = time.perf_counter()
            values.append(read(frame))
            times.append(1e3 * (time.perf_counter() - begun))
        return np.array(values), np.array(times)

    return run
