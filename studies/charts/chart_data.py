"""The data of charts: the user's recordings split in time, or synthetic ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import BankError
from shearloop.bank.fingertip import Fingertip
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.synthetic_frames import LARGEST_TORQUE_NM, Synthesiser, TwistProgramme
from shearloop.estimation import Calibration, FrameSeries, Physics, fit, measure_timing
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.series import SliceSeries, read_slices
from shearloop.tools.bank_config import load_fingertip
from shearloop.tools.banks import OWN_FINGERTIP, Grid, cached_bank
from shearloop.tools.frame_series import part_of, read_series

# Frames before the judged part of a stream that fill an estimator's memory.
WARM_UP_FRAMES = 15
# The default bank, as in config/banks/demo.yaml.
GRID = Grid(np.linspace(2.9, 4.1, 50), np.linspace(0.9, 2.3, 50))
MESH_SIZE_CM = 0.2
# Synthetic frames come from a finer mesh than the bank they are matched with, from cells between that bank's.
_PLAYED_GRID = Grid(np.linspace(3.07, 3.47, 5), np.linspace(1.03, 1.99, 17))
_PLAYED_MESH_SIZE_CM = 0.14
_AVERAGED_FRAMES = 9
_REST_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """The earlier frames of a recording, for the fit, and the later ones, for the judgement."""

    title: str
    past: FrameSeries
    future: FrameSeries
    whole: FrameSeries


def own_fingertip(mesh_size_cm: float) -> Fingertip:
    """Return the paper's fingertip by its dimensions, with another mesh size."""
    return load_fingertip(OWN_FINGERTIP, mesh_size_cm)


def splits(paths: Sequence[Path], share: float, scratch: Path) -> list[Split]:
    """Return each recording's earlier part, a `share` of it, and later part; synthetic recordings without paths."""
    named: list[tuple[str, FrameSeries]] = []
    for path in paths:
        read = read_slices(path) if path.is_dir() else read_series(path)
        named += [(path.name or str(path), series) for series in read]
    if not named:
        named = [("synthetic slices", synthetic_slices(scratch)), ("synthetic stream", synthetic_stream(scratch))]
    found = []
    for name, series in named:
        of_slices = isinstance(series, SliceSeries)
        # Slices of a known diameter are not of a known torque.
        if series.torque_t_s.size and not (of_slices and np.isfinite(series.diameter_mm).any()):
            kind, warm_up = ("slices", 0) if of_slices else ("stream", WARM_UP_FRAMES)
            start = max(round(share * len(series.t_s)) - warm_up, 0)
            future = series.between(start, len(series.t_s))
            found.append(Split(f"{name}, {kind}, first {share:.0%}", part_of(series, 0, share), future, series))
        elif not series.torque_t_s.size:
            print(f"{name} is left out: it holds no torques of a load cell")
    return found


def fitted(
    split: Split, names: Sequence[EstimatorName], physics: Physics, sides: tuple[str, ...] | None = None
) -> list[Calibration | SliceCalibration]:
    """Return the calibrations that the past allows, by default of all sides; print the reason for each missing one."""
    past, of = (split.past, "") if sides is None else (split.past.select_sides(sides), f", {' and '.join(sides)}")
    found: list[Calibration | SliceCalibration] = []
    for name in names:
        try:
            if isinstance(past, SliceSeries):
                found.append(fit_slices(name, [past], split.title, physics))
            else:
                timing = measure_timing([past], [split.past])
                found.append(fit(name, [past], split.title, physics, timing=timing))
        except BankError as error:
            print(f"{split.title}: {name}{of} is left out: {error}")
    return found


def sigma_of(torque_nm: FloatArray) -> FloatArray:
    """Return the σ in cm of torques in synthetic frames: it falls with rising torque, as measured."""
    return 1.9 - 0.7 * torque_nm / LARGEST_TORQUE_NM


def torque_of(sigma: float) -> float:
    """Return the torque in N·m of a σ in cm in synthetic frames."""
    return LARGEST_TORQUE_NM * (1.9 - sigma) / 0.7


def played_bank(scratch: Path, grid: Grid = _PLAYED_GRID) -> Bank:
    """Return the bank of the synthetic frames, or one of other cells."""
    return cached_bank("played", grid, own_fingertip(_PLAYED_MESH_SIZE_CM).mesh(), scratch)


class SyntheticSlices:
    """Makes differences from one idle frame; each frame is the mean of nine, like the paper's smoothed slices."""

    def __init__(self, bank: Bank) -> None:
        self._synthesiser = Synthesiser(bank)
        self._idle = self._mean_frame(3.2, 1.5, 0.0)

    def series(self, places: Sequence[tuple[float, float, float]], torque_nm: FloatArray) -> SliceSeries:
        """Return the slices of n places (k and σ in cm, grip from 0 to 1) with these torques (n,)."""
        n = len(places)
        frames = np.array([np.abs(self._mean_frame(*place) - self._idle) for place in places])
        t_s = np.arange(float(n))
        return SliceSeries(("right",), t_s, frames[:, None], t_s, torque_nm, np.full(n, np.nan))

    def _mean_frame(self, k: float, sigma: float, grip: float) -> FloatArray:
        lines = [self._synthesiser.line(k, sigma, grip) for _ in range(_AVERAGED_FRAMES)]
        return np.asarray(np.mean([PAPER_TABLE.channels_of_line(line) for line in lines], axis=0))


def synthetic_slices(scratch: Path) -> SliceSeries:
    """Return 49 differences like the paper's slices: five repeats of ten torques."""
    levels = np.tile(np.linspace(0.01, LARGEST_TORQUE_NM, 10), 5)[1:]
    torque = np.clip(levels + np.random.default_rng((0, 1)).normal(0.0, 0.003, 49), 0.0, LARGEST_TORQUE_NM)
    # In every repeat the tool sits a little elsewhere in the grip, a little more firmly.
    shift = 0.03 * (np.arange(1, 50) // 10)
    places = zip(3.2 + shift, sigma_of(torque), 1.0 + shift, strict=True)
    return SyntheticSlices(played_bank(scratch)).series(list(places), torque)


def synthetic_stream(scratch: Path) -> FrameSeries:
    """Return the frames of two fingertips, idle and then holding a tool through eight twists."""
    programme = TwistProgramme(grip_s=1.0)
    gripped_s = programme.idle_s + programme.grip_s
    end_s = gripped_s + _REST_S + programme.cycles * 2 * (programme.turn_s + programme.hold_s)
    t_s = np.arange(0.5 * FRAME_PERIOD_S, end_s, FRAME_PERIOD_S)
    # A rest after the grip, before the first twist.
    moments = [programme.at(t if t < gripped_s else max(t - _REST_S, gripped_s)) for t in t_s.tolist()]
    grips, torque = np.array(moments).T
    channels = np.empty((len(t_s), 2, PAPER_TABLE.n_channels))
    for side, k in enumerate((3.2, 3.35)):
        synthesiser = Synthesiser(played_bank(scratch), seed=100 * side)
        for i, (sigma, grip) in enumerate(zip(sigma_of(torque), grips, strict=True)):
            channels[i, side] = PAPER_TABLE.channels_of_line(synthesiser.line(k, sigma, grip))
    return FrameSeries(("right", "left"), t_s, channels, t_s, torque, np.full(len(t_s), np.nan))
