"""What may be wrong with a frame, from a little to too much: every sweep that stability is judged by."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS, N_ELECTRODES
from shearloop.bank.estimation import FrameSeries
from shearloop.bank.estimation.bank_match import Registration
from shearloop.drivers.eit_format import ADC_STEP_V


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Frames to be spoilt: idle (m, 896) is what the untouched fingertips read, in volts; foreign as another reads."""

    series: FrameSeries
    idle: FloatArray
    noise_v: float
    foreign: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Spoilt:
    """Frames with a fault; usable (n, m, 896) is False where the board itself says so, None where it says nothing."""

    series: FrameSeries
    usable: BoolArray | None = None


@dataclass(frozen=True, slots=True)
class Fault:
    """One sweep: `apply(scene, level, rng)` spoils the frames; the first level is always no fault at all."""

    name: str
    unit: str
    levels: tuple[float, ...]
    apply: Callable[[Scene, float, np.random.Generator], Spoilt]


def _shown(scene: Scene, channels: FloatArray) -> FrameSeries:
    """Return the frames with other channels; a difference is a magnitude."""
    return replace(scene.series, channels=np.abs(channels) if scene.series.kind == "difference" else channels)


def _noise(scene: Scene, level: float, rng: np.random.Generator) -> Spoilt:
    channels = scene.series.channels
    return Spoilt(_shown(scene, channels + rng.normal(0.0, 1.0, channels.shape) * level * scene.noise_v))


def lost_channels(electrodes: IntArray) -> BoolArray:
    """Return the (896,) channels that inject or measure at one of these electrodes."""
    return np.asarray(np.isin(CHANNELS, electrodes).any(axis=1))


def _read_nothing(scene: Scene, level: float, rng: np.random.Generator) -> tuple[FrameSeries, BoolArray]:
    """Return frames whose lost electrodes read one step of the converter, and which channels those are."""
    lost = lost_channels(rng.choice(N_ELECTRODES, int(level), replace=False))
    channels = scene.series.channels.copy()
    dead = ADC_STEP_V - scene.idle[:, lost] if scene.series.kind == "difference" else ADC_STEP_V
    channels[:, :, lost] = dead
    return _shown(scene, channels), lost


def _lost_untold(scene: Scene, level: float, rng: np.random.Generator) -> Spoilt:
    return Spoilt(_read_nothing(scene, level, rng)[0])


def _lost_told(scene: Scene, level: float, rng: np.random.Generator) -> Spoilt:
    series, lost = _read_nothing(scene, level, rng)
    return Spoilt(series, np.broadcast_to(~lost, series.channels.shape))


def _saturated(scene: Scene, level: float, _: np.random.Generator) -> Spoilt:
    """Clip what the amplifier reads so that this share of the idle frame's channels is at its rail."""
    channels = scene.series.channels
    if not level:
        return Spoilt(scene.series)
    rail = np.quantile(scene.idle, 1.0 - level)
    if scene.series.kind == "raw":
        return Spoilt(_shown(scene, np.minimum(channels, rail)))
    # Of a difference the sign is not known: half of the channels rise.
    signs = np.where(np.arange(N_CHANNELS) % 2, -1.0, 1.0)
    read = np.minimum(scene.idle + signs * channels, rail)
    return Spoilt(_shown(scene, read - np.minimum(scene.idle, rail)))


def _drift(scene: Scene, level: float, rng: np.random.Generator) -> Spoilt:
    """Move the baseline by a pattern of its own, RMS `level` of the idle frame, over the recording."""
    channels = scene.series.channels
    pattern = rng.normal(0.0, 1.0, channels.shape[1:]) * scene.idle * level
    share = np.linspace(0.5, 1.0, len(channels))[:, None, None]
    if scene.series.kind == "difference":
        return Spoilt(_shown(scene, channels + pattern))
    return Spoilt(_shown(scene, channels + share * pattern))


def _gain(scene: Scene, level: float, _: np.random.Generator) -> Spoilt:
    """Let all channels read so much more, as when the gel dries or the current source drifts."""
    channels = scene.series.channels
    moved = level * scene.idle if scene.series.kind == "difference" else level * channels
    return Spoilt(_shown(scene, channels + moved))


def _turned(scene: Scene, level: float, _: np.random.Generator) -> Spoilt:
    order = Registration(int(level), reflected=False, score=1.0, runner_up=0.0).model_channels()
    return Spoilt(_shown(scene, scene.series.channels[:, :, order]))


def _swapped(scene: Scene, level: float, rng: np.random.Generator) -> Spoilt:
    """Exchange so many pairs of electrodes' wires; a channel that then does not exist keeps its own value."""
    wires = np.arange(N_ELECTRODES)
    chosen = rng.choice(N_ELECTRODES, 2 * int(level), replace=False)
    wires[chosen[::2]], wires[chosen[1::2]] = chosen[1::2], chosen[::2]
    place = {(sink, positive): i for i, (sink, _, positive, _) in enumerate(CHANNELS.tolist())}
    order = np.array(
        [place.get((wires[sink], wires[positive]), i) for i, (sink, _, positive, _) in enumerate(CHANNELS.tolist())]
    )
    return Spoilt(_shown(scene, scene.series.channels[:, :, order]))


def _foreign(scene: Scene, level: float, _: np.random.Generator) -> Spoilt:
    return Spoilt(_shown(scene, (1.0 - level) * scene.series.channels + level * scene.foreign))


FAULTS = (
    Fault("noise added", "times the measured noise", (0, 0.5, 1, 2, 4, 8, 16, 32), _noise),
    Fault("lost electrodes, told by the board", "electrodes", (0, 1, 2, 4, 6, 8, 12, 16), _lost_told),
    Fault("lost electrodes, not told", "electrodes", (0, 1, 2, 4, 6, 8, 12, 16), _lost_untold),
    Fault("saturation, not told", "share of the channels at the rail", (0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7), _saturated),
    Fault("baseline drift, a pattern", "RMS share of the idle frame", (0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1), _drift),
    Fault("baseline drift, gain", "share", (0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2), _gain),
    Fault("electrodes numbered from elsewhere", "electrodes of turn", (0, 1, 2, 4, 8, 16), _turned),
    Fault("pairs of electrodes exchanged", "pairs", (0, 1, 2, 4, 8, 16), _swapped),
    Fault("a foreign frame mixed in", "share of the foreign frame", (0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0), _foreign),
)


def scene_of(series: FrameSeries, idle: FloatArray, noise_v: float, seed: int = 7) -> Scene:
    """Return a scene; the foreign frame is another fingertip's: the same voltages, at other channels."""
    rng = np.random.default_rng(seed)
    mean = series.channels.mean(axis=0)
    foreign = np.array([layer[rng.permutation(N_CHANNELS)] for layer in mean])
    return Scene(series, idle, noise_v, foreign)
