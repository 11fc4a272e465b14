"""How well the basis models explain measured differences, and the smallest bank that a recording asks for.

Two scores rank the models, as in figure 5 of Trehan et al. 2025. `envelope_score` is the paper's: the rank correlation
of the envelopes of a raw difference and a simulated signal, at the best circular shift. It is averaged over a few
settings of models centred on the fingertip, because it jumps between settings. `matching_scores` is the matcher's own:
the largest normalised cross-correlation at the best of many settings.

A design takes the coarsest of each choice that adds less than a third of the noise. Errors are relative L2 errors of a
difference frame, in units of the measured noise of one frame. They add as squares, so a third adds little:
√(1 + 1/9) = 1.05. Injections are judged by the standard deviation of a torque that generalised least squares reads from
the frames' change with it.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import find_peaks
from scipy.stats import rankdata

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import CalibrationError, MatchingError
from shearloop.bank.fingertip import Fingertip
from shearloop.bank.forward import BatchForwardModel, ForwardModel
from shearloop.bank.matching import ReferenceMatcher
from shearloop.bank.models import MODELS, conductivity

# The share of the noise that each choice may add.
ALLOWED = 1.0 / 3.0
CHANNEL_S = 0.6e-3
# Above 0.5 cm the electrodes determine the mesh.
MESH_SIZES_CM = (0.5, 0.4, 0.3, 0.2, 0.14, 0.1, 0.07, 0.05)
COUNTS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 100, 150)
RANKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
# Places along k and along sigma that judge a rank.
_RANKED = 17
_N_CHANNEL_COUNTS = 16
_FOLDS = 8
# Errors of linear elements are proportional to the mesh size: two fine meshes extrapolate to the limit.
_FINE_CM = (0.05, 0.035)
_N_DRIFT = 2
# Settings of the models are for this height, and scale with another one.
_PAPER_HEIGHT_CM = 3.6
# The mesh of simulated frames.
_SIMULATED_CM = 0.1
_PLACES = np.linspace(0.1, 0.9, 9)
_MIN_FRAMES = 8
# A smaller fraction of a frame is rounding: the board's converter alone makes thousands of times as much noise.
_MIN_NOISE = 1e-6


class EnvelopeSettings(NamedTuple):
    """Peaks of an envelope are `distance` channels apart or more, and a moving average over `averaged` smooths it."""

    distance: int
    averaged: int


PAPER_ENVELOPE = EnvelopeSettings(50, 5)


class Setting(NamedTuple):
    """One k and σ of a model."""

    k: float
    sigma: float


def centred_settings(model: str, centre: float) -> list[Setting]:
    """Return settings of a model that is centred on the paper's fingertip, in cm (modulated Gaussian: k in rad/cm)."""
    widths = {
        "step": [1.0],
        "linear": [2.0, 2.5, 3.0, 4.0, 6.0],
        "cut_linear": [2.0, 3.0, 4.0],
        "gaussian_derivative": [0.7, 0.8, 0.9, 1.0, 1.2, 1.5],
        "modulated_gaussian": [0.3, 0.4, 0.5],
    }[model]
    places = {"cut_linear": [1.0, 2.0, 3.0], "modulated_gaussian": [4.0, 5.0, 6.0]}.get(model, [centre])
    return [Setting(k, sigma) for k in places for sigma in widths]


def searched_settings(model: str, height: float, places: FloatArray = _PLACES) -> list[Setting]:
    """Return settings at places, fractions of the height in cm, all over a fingertip, to search for the best one."""
    up, size = (_PAPER_HEIGHT_CM * places).tolist(), height / _PAPER_HEIGHT_CM
    places, widths = {
        "step": (up, [1.0]),
        "linear": (up, [2.5, 4.0, 6.0, 10.0]),
        "cut_linear": ([0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.4], [2.0, 3.0, 4.0]),
        "gaussian_derivative": (up, [0.65, 0.8, 1.0, 1.2, 1.5, 1.9, 2.5]),
        "modulated_gaussian": ([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [0.3, 0.4, 0.6, 0.9, 1.2]),
    }[model]
    k_unit = 1 / size if model == "modulated_gaussian" else size
    return [Setting(k * k_unit, sigma * size) for k in places for sigma in widths]


def simulated_signals(forward: BatchForwardModel, model: str, settings: Sequence[Setting]) -> FloatArray:
    """Return the (m, n) difference signals of the settings with a positive conductivity everywhere."""
    cells = [cell for cell in (conductivity(forward.mesh, model, *setting) for setting in settings) if cell.min() > 0]
    voltages = forward.voltages(np.array([np.ones(len(forward.mesh.triangles)), *cells]))
    signals: FloatArray = voltages[1:] - voltages[0]
    return signals


def envelope(magnitudes: FloatArray, settings: EnvelopeSettings = PAPER_ENVELOPE) -> FloatArray:
    """Return the (n,) smoothed curve over the peaks of (n,) magnitudes, the last channel followed by the first.

    Raises MatchingError where there are no two peaks to carry it.
    """
    thrice = np.tile(magnitudes, 3)
    peaks, _ = find_peaks(thrice, distance=settings.distance)
    if len(peaks) < 2:
        raise MatchingError("a signal without peaks has no envelope")
    curve = CubicSpline(peaks, thrice[peaks])(np.arange(len(magnitudes), 2 * len(magnitudes)))
    return _moving_average(curve, settings.averaged)


def envelope_score(difference: FloatArray, signals: FloatArray, settings: EnvelopeSettings = PAPER_ENVELOPE) -> float:
    """Return Spearman's correlation of the envelopes of a (n,) difference and a signal, the mean over (m, n) signals.

    Each is the largest over all circular shifts. The difference is smoothed beforehand. Raises MatchingError as
    `envelope` does.
    """
    smooth = _moving_average(np.abs(difference), settings.averaged)
    measured = np.fft.rfft(_ranks(envelope(smooth, settings)))
    simulated = np.fft.rfft([_ranks(envelope(signal, settings)) for signal in np.abs(signals)])
    return float(np.fft.irfft(measured * np.conj(simulated), len(difference)).max(axis=1).mean())


def matching_scores(differences: FloatArray, signals: FloatArray) -> FloatArray:
    """Return the (f,) best scores, over (m, n) signals and all lags, of (f, n) differences."""
    m = len(signals)
    matcher = ReferenceMatcher(
        signals[:, None].astype(np.float32), np.ones((m, 1), dtype=np.bool_), np.arange(float(m)), np.zeros(1)
    )
    best: FloatArray = matcher.heatmaps(differences).max(axis=(1, 2))
    return best


def _moving_average(values: FloatArray, averaged: int) -> FloatArray:
    return np.asarray(np.mean([np.roll(values, shift) for shift in range(averaged)], axis=0))


def _ranks(values: FloatArray) -> FloatArray:
    """Return ranks of mean 0 and norm 1, so that their correlation is a sum of products."""
    ranks = rankdata(values) - (len(values) + 1) / 2
    return np.asarray(ranks / np.linalg.norm(ranks))


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrames:
    """(f, n) measured differences in volts, the noise of one frame in volts, torque (f,) or None."""

    differences: FloatArray
    noise_v: float
    torque_nm: FloatArray | None

    def __post_init__(self) -> None:
        """Refuse too few frames, and frames that no board sends."""
        if len(self.differences) < _MIN_FRAMES:
            raise CalibrationError(
                f"too few gripped frames to judge a model by: {len(self.differences)}; record {_MIN_FRAMES}"
            )
        # Sizes that overflow as a square, or vanish, give no number.
        with np.errstate(all="ignore"):
            usable = _MIN_NOISE <= self.relative_noise < np.inf
        if not usable:
            raise CalibrationError(
                "the gripped frames have no noise to design for: they are all alike, multiples of a few, or not from a "
                "board; record frames as they come"
            )

    @property
    def relative_noise(self) -> float:
        """The noise as a fraction of the differences, both as RMS."""
        return float(self.noise_v / np.sqrt((self.differences**2).mean()))


@dataclass(frozen=True, slots=True)
class DesignStep:
    """One setting: the error it adds in units of the noise, and its cost in words."""

    setting: float
    added: float
    cost: str


@dataclass(frozen=True, slots=True)
class DesignChoice:
    """Settings from coarse to fine."""

    name: str
    unit: str
    steps: tuple[DesignStep, ...]

    @property
    def chosen(self) -> DesignStep:
        """The coarsest step that, like all finer ones, adds at most a third of the noise; else the finest."""
        good = itertools.takewhile(lambda step: step.added <= ALLOWED, reversed(self.steps))
        return min(good, key=self.steps.index, default=self.steps[-1])

    @property
    def next_step(self) -> DesignStep | None:
        """The step after the chosen one, None where that is the finest."""
        after = self.steps.index(self.chosen) + 1
        return self.steps[after] if after < len(self.steps) else None

    @property
    def enough(self) -> bool:
        """Whether the chosen step is good enough."""
        return self.chosen.added <= ALLOWED


@dataclass(frozen=True, slots=True)
class ModelFit:
    """A model against the data: error of held-out channels relative to the frame, and its standard error.

    Held out are injections that k, σ and amplitude were not fitted to. `penalised` is the error with the fraction of
    pure noise that the model's parameters would explain; the amplitude is one of them.
    """

    model: str
    parameters: int
    error: float
    standard_error: float
    penalised: float


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """The choices for a recording; k and sigma (low, high), in the model's units, contain the frames with a margin.

    A model that does not depend on sigma has a range of one value, and one cell along it.
    """

    relative_noise: float
    # Of all frames, or None where it is not known.
    largest_torque_nm: float | None
    models: tuple[ModelFit, ...]
    model: str
    k_range: tuple[float, float]
    sigma_range: tuple[float, float]
    mesh: DesignChoice
    k_count: DesignChoice
    sigma_count: DesignChoice
    rank: DesignChoice
    channels: DesignChoice
    injections: DesignChoice

    @property
    def choices(self) -> tuple[DesignChoice, ...]:
        """All choices."""
        return self.mesh, self.k_count, self.sigma_count, self.rank, self.channels, self.injections


def design_bank(fingertip: Fingertip, measured: MeasuredFrames) -> Design:
    """Return the choices for frames of this fingertip. Raises BankError for a geometry that cannot be solved on."""
    table = fingertip.table
    forward = BatchForwardModel(replace(fingertip, mesh_size_cm=0.2).mesh(), table)
    searched = {name: _positive(forward, name, searched_settings(name, forward.mesh.height_cm)) for name in MODELS}
    signals = {name: np.abs(simulated_signals(forward, name, settings)) for name, settings in searched.items()}
    models = tuple(_model_fit(measured, name, signals[name], table) for name in MODELS)
    model = min(models, key=lambda one: one.penalised).model
    k_range, sigma_range = _ranges(measured, searched[model], signals[model])
    # Not every conductivity is positive in the middle of the ranges: take the nearest that is.
    middle = min(searched[model], key=lambda one: abs(one.k - sum(k_range) / 2) + abs(one.sigma - sum(sigma_range) / 2))
    noise = measured.relative_noise
    if uses_sigma := MODELS[model].uses_sigma:
        sigma_count = _count_choice(forward, model, middle, "sigma", sigma_range, noise)
    else:
        alike = DesignStep(1, 0.0, "the model does not depend on sigma")
        sigma_count = DesignChoice("cells along sigma", "cells", (alike,))
    channels, injections = _board_choices(measured, table)
    return Design(
        relative_noise=noise,
        largest_torque_nm=None if measured.torque_nm is None else float(np.abs(measured.torque_nm).max()),
        models=models,
        model=model,
        k_range=k_range,
        sigma_range=sigma_range if uses_sigma else (middle.sigma, middle.sigma),
        mesh=_mesh_choice(fingertip, model, middle, noise),
        k_count=_count_choice(forward, model, middle, "k", k_range, noise),
        sigma_count=sigma_count,
        rank=_rank_choice(forward, model, k_range, sigma_range, noise),
        channels=channels,
        injections=injections,
    )


def simulated_frames(design: Design, fingertip: Fingertip, n: int = 49, seed: int = 0) -> MeasuredFrames:
    """Return n frames that a designed-for grip gives on another fingertip, with the same fraction of noise.

    Torque and σ change along the design's range, in the proportions of the paper's fingertip. Amplitudes are the
    model's voltages and torques have no unit: a design depends on neither.
    """
    forward = BatchForwardModel(replace(fingertip, mesh_size_cm=_SIMULATED_CM).mesh(), fingertip.table)
    size = forward.mesh.height_cm / _PAPER_HEIGHT_CM
    sigmas = np.linspace(*design.sigma_range, n)
    k = sum(design.k_range) / 2
    k_unit = 1 / size if MODELS[design.model].k_unit == "rad/cm" else size
    settings = _positive(forward, design.model, [Setting(k * k_unit, sigma * size) for sigma in sigmas.tolist()])
    frames = np.abs(simulated_signals(forward, design.model, settings))
    noise_v = design.relative_noise * float(np.sqrt((frames**2).mean()))
    noisy = frames + np.random.default_rng(seed).normal(0.0, noise_v, frames.shape)
    return MeasuredFrames(noisy, noise_v, np.array([-setting.sigma for setting in settings]))


def _positive(forward: BatchForwardModel, model: str, settings: Sequence[Setting]) -> list[Setting]:
    """Return the settings with a positive conductivity."""
    return [setting for setting in settings if conductivity(forward.mesh, model, *setting).min() > 0]


def _fit(frames: FloatArray, signals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (n, m) amplitudes of the best multiples of (m, d) signals for (n, d) frames, and the squared residuals."""
    energy = (signals**2).sum(axis=1)
    amplitude = frames @ signals.T / energy
    return amplitude, (frames**2).sum(axis=1)[:, None] - amplitude**2 * energy


def _model_fit(measured: MeasuredFrames, model: str, signals: FloatArray, table: ChannelTable) -> ModelFit:
    frames, injection = np.abs(measured.differences), table.electrodes[:, 0]
    left = np.zeros(len(frames))
    for fold in range(_FOLDS):
        out = injection % _FOLDS == fold
        amplitude, squares = _fit(frames[:, ~out], signals[:, ~out])
        best = squares.argmin(axis=1)
        predicted = amplitude[np.arange(len(frames)), best][:, None] * signals[best][:, out]
        left += ((frames[:, out] - predicted) ** 2).sum(axis=1)
    share = left / (frames**2).sum(axis=1)
    p = 3 if MODELS[model].uses_sigma else 2
    error = float(np.sqrt(share.mean()))
    penalised = float(np.sqrt(share.mean() * (1 + p * np.log(table.n_channels) / table.n_channels)))
    return ModelFit(model, p, error, float(share.std() / np.sqrt(len(share)) / (2 * error)), penalised)


def _ranges(
    measured: MeasuredFrames, settings: Sequence[Setting], signals: FloatArray
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of the frames' k and σ, with the distance to the next searched setting as margin."""
    best = _fit(np.abs(measured.differences), signals)[1].argmin(axis=1)
    found = []
    for axis in (0, 1):
        every = np.unique([setting[axis] for setting in settings])
        low, high = np.quantile([settings[i][axis] for i in best], [0.02, 0.98])
        below, above = every[every < low], every[every > high]
        found.append((float(below[-1] if len(below) else 0.8 * low), float(above[0] if len(above) else 1.2 * high)))
    return found[0], found[1]


def _shape_error(one: FloatArray, other: FloatArray) -> float:
    """Return the relative L2 distance of two magnitudes in shape: the amplitude is free."""
    amplitude = float(one @ other / (other @ other))
    return float(np.linalg.norm(one - amplitude * other) / np.linalg.norm(one))


def _mesh_choice(fingertip: Fingertip, model: str, place: Setting, noise: float) -> DesignChoice:
    def solved(size: float) -> tuple[FloatArray, int]:
        forward = ForwardModel(replace(fingertip, mesh_size_cm=size).mesh(), fingertip.table)
        voltages = forward.voltages(conductivity(forward.mesh, model, *place))
        return np.abs(voltages - forward.homogeneous()), len(forward.mesh.triangles)

    found = {size: solved(size) for size in sorted({*MESH_SIZES_CM, *_FINE_CM}, reverse=True)}
    coarse, fine = (found[size][0] for size in _FINE_CM)
    truth = fine + (fine - coarse) / (_FINE_CM[0] / _FINE_CM[1] - 1.0)
    steps = [
        DesignStep(size, _shape_error(truth, found[size][0]) / noise, f"{found[size][1]} triangles")
        for size in MESH_SIZES_CM
    ]
    return DesignChoice("mesh size", "cm", tuple(steps))


def _count_choice(
    forward: BatchForwardModel, model: str, middle: Setting, name: str, ends: tuple[float, float], noise: float
) -> DesignChoice:
    """Choose the number of cells along `name` (k or sigma), by the error of a frame half-way between two cells."""
    steps, unit = [], getattr(MODELS[model], f"{name}_unit")
    for count in COUNTS:
        spacing = (ends[1] - ends[0]) / (count - 1)
        # Half a cell away from places all over the range; the worst counts.
        places = np.linspace(ends[0] + spacing, ends[1] - spacing, 4).tolist()
        pairs = (
            np.abs(simulated_signals(forward, model, [middle._replace(**{name: at}) for at in (v, v + spacing / 2)]))
            for v in places
        )
        # A bank has no cells where the conductivity is not positive.
        found = [_shape_error(*pair) for pair in pairs if len(pair) == 2]
        if not found:
            raise CalibrationError(
                f"the {model} model is positive nowhere along {name} from {ends[0]:.3g} to {ends[1]:.3g}: these frames "
                "lie at the rim of what it can describe; record a grip that is less strong"
            )
        steps.append(DesignStep(count, max(found) / noise, f"{spacing:.3g} {unit} apart"))
    return DesignChoice(f"cells along {name}", "cells", tuple(steps))


def _rank_choice(
    forward: BatchForwardModel, model: str, k: tuple[float, float], sigma: tuple[float, float], noise: float
) -> DesignChoice:
    """Choose how many directions of all signals' shapes a bank needs."""
    ks, sigmas = (np.unique(np.linspace(*ends, _RANKED)).tolist() for ends in (k, sigma))
    signals = np.abs(simulated_signals(forward, model, [Setting(a, b) for a in ks for b in sigmas]))
    squares = np.linalg.svd(signals / np.linalg.norm(signals, axis=1, keepdims=True), compute_uv=False) ** 2
    n = signals.shape[1]
    steps = [
        DesignStep(rank, float(np.sqrt(squares[rank:].sum() / squares.sum())) / noise, f"{rank} numbers a cell, of {n}")
        for rank in RANKS
    ]
    return DesignChoice("rank of the bank", "directions", tuple(steps))


def _board_choices(measured: MeasuredFrames, table: ChannelTable) -> tuple[DesignChoice, DesignChoice]:
    """Choose channels and injections by the torque's standard deviation.

    Channels come in the order of their weight in a torque that is read without the drift; each injection is the best
    to add to those before. The recording gives the frames' slope over torque, their drift about it and their noise.
    Without a known torque the main direction of the frames' variation replaces the slope.
    """
    frames = np.abs(measured.differences)
    centred = frames - frames.mean(axis=0)
    if measured.torque_nm is not None and np.ptp(measured.torque_nm) > 0:
        torque = measured.torque_nm - measured.torque_nm.mean()
        slope = centred.T @ torque / float(torque @ torque)
        residual = centred - np.outer(torque, slope)
    else:
        u, s, vt = np.linalg.svd(centred, full_matrices=False)
        slope, residual = s[0] * vt[0], centred - np.outer(u[:, 0] * s[0], vt[0])
    _, s, vt = np.linalg.svd(residual, full_matrices=False)
    drift = vt[:_N_DRIFT].T * (s[:_N_DRIFT] / np.sqrt(max(len(frames) - 2, 1)))

    def variance(channels: IntArray) -> float:
        """Return the variance of a torque read from these channels."""
        b, v = slope[channels] / measured.noise_v, drift[channels] / measured.noise_v
        inner = np.linalg.inv(np.eye(_N_DRIFT) + v.T @ v)
        return 1.0 / max(float(b @ b - (b @ v) @ inner @ (v.T @ b)), 1e-300)

    def channels_of(injections: Sequence[int]) -> IntArray:
        return np.flatnonzero(np.isin(table.electrodes[:, 0], injections))

    least = variance(np.arange(table.n_channels))

    def step(setting: int, channels: IntArray, more: str = "") -> DesignStep:
        rate = f"{1.0 / (len(channels) * CHANNEL_S):.2f} frames/s at {1e3 * CHANNEL_S:g} ms a channel"
        return DesignStep(setting, float(np.sqrt(max(variance(channels) / least - 1.0, 0.0))), rate + more)

    inner = np.linalg.inv(np.eye(_N_DRIFT) * measured.noise_v**2 + drift.T @ drift)
    order = np.argsort(-np.abs(slope - drift @ (inner @ (drift.T @ slope))), kind="stable")
    counts = np.rint(table.n_channels * np.arange(1, _N_CHANNEL_COUNTS + 1) / _N_CHANNEL_COUNTS).astype(int).tolist()
    of_channels = tuple(step(count, order[:count]) for count in counts)
    taken: list[int] = []
    of_injections = []
    while rest := [injection for injection in range(table.n_electrodes) if injection not in taken]:
        taken.append(min(rest, key=lambda injection: variance(channels_of([*taken, injection]))))
        numbers = ", ".join(map(str, sorted(taken)))
        of_injections.append(step(len(taken), channels_of(taken), f"; injections {numbers}"))
    return (
        DesignChoice("channels", f"of {table.n_channels}", of_channels),
        DesignChoice("injections", f"of {table.n_electrodes}", tuple(of_injections)),
    )
