"""The smallest bank that a recording asks for: each choice is the coarsest that adds less than a third of the noise.

Errors are relative L2 errors of a difference frame, in units of the measured noise of one frame. They add as squares,
so a third adds little: √(1 + 1/9) = 1.05. Torque is read from the frames' change with it, so channels and injections
are judged by the torque's standard deviation by generalised least squares.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS, N_ELECTRODES
from shearloop.bank.eit.fingertip import Fingertip
from shearloop.bank.eit.forward import BatchForwardModel, ForwardModel
from shearloop.bank.eit.model_scores import Setting, searched_settings
from shearloop.bank.eit.models import MODELS, conductivity
from shearloop.bank.errors import CalibrationError

# The share of the noise that each choice may add.
ALLOWED = 1.0 / 3.0
CHANNEL_S = 0.6e-3
# Above 0.5 cm the electrodes determine the mesh.
MESH_SIZES_CM = (0.5, 0.4, 0.3, 0.2, 0.14, 0.1, 0.07, 0.05)
COUNTS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 100, 150)
RANKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
CHANNEL_COUNTS = (8, 16, 32, 64, 112, 168, 224, 280, 336, 392, 448, 504, 560, 616, 672, 728, 784, 840, 896)
_WITHOUT_SIGMA = tuple(name for name, model in MODELS.items() if model.sigma_unit == "not used")
_FOLDS = 8
# Errors of linear elements are proportional to the mesh size: two fine meshes extrapolate to the limit.
_FINE_CM = (0.05, 0.035)
# Places along k and along sigma that judge a rank. Nine are too few: they underestimate the error threefold.
_RANKED = 17
_N_DRIFT = 2
_MIN_FRAMES = 8
# A smaller share of a frame is rounding: the board's converter alone makes thousands of times as much noise.
_MIN_NOISE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrames:
    """(n, 896) measured differences in volts, the noise of one frame in volts, torque (n,) or None."""

    differences: FloatArray
    noise_v: float
    torque_nm: FloatArray | None

    def __post_init__(self) -> None:
        """Refuse too few frames, and frames that no board sends."""
        if len(self.differences) < _MIN_FRAMES:
            raise CalibrationError(
                f"{len(self.differences)} gripped frames are too few to judge a model by; record {_MIN_FRAMES}"
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
        """The noise as a share of the differences, both as RMS."""
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


_ONE_SIGMA = DesignChoice("cells along sigma", "cells", (DesignStep(1, 0.0, "the model does not depend on sigma"),))


@dataclass(frozen=True, slots=True)
class ModelFit:
    """A model against the data: error of held-out channels relative to the frame, and its standard error.

    Held out are injections that k, σ and amplitude were not fitted to. `penalised` is the error with the share of pure
    noise that the model's parameters would explain; the amplitude is one of them.
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


def design_bank(measured: MeasuredFrames, fingertip: Fingertip) -> Design:
    """Return the choices for frames of this fingertip. Raises BankError for a geometry that cannot be solved on."""
    forward = BatchForwardModel(replace(fingertip, mesh_size_cm=0.2).mesh())
    signals = {name: _signals(forward, name, searched_settings(name, forward.mesh.height_cm)) for name in MODELS}
    models = tuple(_model_fit(measured, name, signals[name][1]) for name in MODELS)
    model = min(models, key=lambda one: one.penalised).model
    settings, own = signals[model]
    k_range, sigma_range = _ranges(measured, settings, own)
    # The searched settings are positive everywhere; take the nearest to the middle of the ranges.
    middle = min(settings, key=lambda one: abs(one.k - sum(k_range) / 2) + abs(one.sigma - sum(sigma_range) / 2))
    if one_sigma := model in _WITHOUT_SIGMA:
        sigma_range = (middle.sigma, middle.sigma)
    noise = measured.relative_noise
    return Design(
        noise, models, model, k_range, sigma_range,
        _mesh_choice(fingertip, model, middle, noise),
        _count_choice(forward, model, k_range, lambda k: Setting(k, middle.sigma), noise, "k"),
        _ONE_SIGMA if one_sigma else _count_choice(
            forward, model, sigma_range, lambda s: Setting(middle.k, s), noise, "sigma"
        ),
        _rank_choice(forward, model, k_range, sigma_range, noise),
        *_board_choices(measured),
    )  # fmt: skip


def _signals(forward: BatchForwardModel, model: str, settings: Sequence[Setting]) -> tuple[list[Setting], FloatArray]:
    """Return the settings with a positive conductivity, and their (m, 896) magnitudes."""
    cells = [conductivity(forward.mesh, model, *setting) for setting in settings]
    kept = [i for i, cell in enumerate(cells) if cell.min() > 0]
    voltages = forward.voltages(np.array([np.ones(len(forward.mesh.triangles)), *(cells[i] for i in kept)]))
    return [settings[i] for i in kept], np.abs(voltages[1:] - voltages[0])


def _fit(frames: FloatArray, signals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (n, m) amplitudes of the best multiples of (m, d) signals for (n, d) frames, and the squared residuals."""
    energy = (signals**2).sum(axis=1)
    amplitude = frames @ signals.T / energy
    return amplitude, (frames**2).sum(axis=1)[:, None] - amplitude**2 * energy


def _model_fit(measured: MeasuredFrames, model: str, signals: FloatArray) -> ModelFit:
    frames, injection = np.abs(measured.differences), CHANNELS[:, 0]
    left = np.zeros(len(frames))
    for fold in range(_FOLDS):
        out = injection % _FOLDS == fold
        amplitude, squares = _fit(frames[:, ~out], signals[:, ~out])
        best = squares.argmin(axis=1)
        predicted = amplitude[np.arange(len(frames)), best][:, None] * signals[best][:, out]
        left += ((frames[:, out] - predicted) ** 2).sum(axis=1)
    share = left / (frames**2).sum(axis=1)
    p = 2 if model in _WITHOUT_SIGMA else 3
    error = float(np.sqrt(share.mean()))
    penalised = float(np.sqrt(share.mean() * (1 + p * np.log(N_CHANNELS) / N_CHANNELS)))
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
        forward = ForwardModel(mesh := replace(fingertip, mesh_size_cm=size).mesh())
        signal = forward.voltages(conductivity(mesh, model, *place)) - forward.homogeneous()
        return np.abs(signal), len(mesh.triangles)

    coarse, fine = (solved(size)[0] for size in _FINE_CM)
    truth = fine + (fine - coarse) / (_FINE_CM[0] / _FINE_CM[1] - 1.0)
    steps = []
    for size in MESH_SIZES_CM:
        signal, triangles = solved(size)
        steps.append(DesignStep(size, _shape_error(truth, signal) / noise, f"{triangles} triangles"))
    return DesignChoice("mesh size", "cm", tuple(steps))


def _count_choice(
    forward: BatchForwardModel,
    model: str,
    ends: tuple[float, float],
    at: Callable[[float], Setting],
    noise: float,
    name: str,
) -> DesignChoice:
    """Choose the number of cells between the ends: the error is that of a frame half-way between two cells."""
    steps, unit = [], MODELS[model].k_unit if name == "k" else MODELS[model].sigma_unit
    for count in COUNTS:
        spacing = (ends[1] - ends[0]) / (count - 1)
        # Half a cell away from places all over the range; the worst counts.
        places = np.linspace(ends[0] + spacing, ends[1] - spacing, 4)
        pairs = (_signals(forward, model, [at(v), at(v + spacing / 2)])[1] for v in places.tolist())
        # A cell whose conductivity would not be positive does not exist.
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
    ks, sigmas = (np.unique(np.linspace(*ends, _RANKED)).tolist() for ends in (k, sigma))
    signals = _signals(forward, model, [Setting(a, b) for a in ks for b in sigmas])[1]
    signals /= np.linalg.norm(signals, axis=1, keepdims=True)
    squares = np.linalg.svd(signals, compute_uv=False) ** 2
    steps = [
        DesignStep(
            rank, float(np.sqrt(squares[rank:].sum() / squares.sum())) / noise, f"{4 * rank} bytes a cell, of 3584"
        )
        for rank in RANKS
    ]
    return DesignChoice("rank of the bank", "numbers a cell", tuple(steps))


def _board_choices(measured: MeasuredFrames) -> tuple[DesignChoice, DesignChoice]:
    """Choose channels and injections by the torque's standard deviation.

    The recording gives the frames' slope over torque, their drift about it and their noise. Without a known torque the
    main direction of the frames' variation replaces the slope.
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

    def spread(channels: IntArray) -> float:
        """Return the standard deviation of a torque read from these channels."""
        b, v = slope[channels] / measured.noise_v, drift[channels] / measured.noise_v
        inner = np.linalg.inv(np.eye(_N_DRIFT) + v.T @ v)
        information = float(b @ b - (b @ v) @ inner @ (v.T @ b))
        return float(1.0 / np.sqrt(max(information, 1e-300)))

    least = spread(np.arange(N_CHANNELS))

    def added(channels: IntArray) -> float:
        return float(np.sqrt(max((spread(channels) / least) ** 2 - 1.0, 0.0)))

    # Channels are ordered by their weight in that reading, which takes the drift out.
    inner = np.linalg.inv(np.eye(_N_DRIFT) * measured.noise_v**2 + drift.T @ drift)
    order = np.argsort(-np.abs(slope - drift @ (inner @ (drift.T @ slope))), kind="stable")
    channels = [DesignStep(n, added(order[:n]), _rate(n)) for n in CHANNEL_COUNTS]
    injection = CHANNELS[:, 0]
    taken: list[int] = []
    steps = []
    while len(taken) < N_ELECTRODES:
        rest = [one for one in range(N_ELECTRODES) if one not in taken]
        taken.append(min(rest, key=lambda one: spread(np.flatnonzero(np.isin(injection, [*taken, one])))))
        chosen = np.flatnonzero(np.isin(injection, taken))
        cost = f"{_rate(len(chosen))}; injections {', '.join(map(str, sorted(taken)))}"
        steps.append(DesignStep(len(taken), added(chosen), cost))
    return DesignChoice("channels", "of 896", tuple(channels)), DesignChoice("injections", "of 32", tuple(steps))


def _rate(channels: int) -> str:
    return f"{1.0 / (channels * CHANNEL_S):.2f} frames/s at {1e3 * CHANNEL_S:g} ms a channel"
