"""A rig that is played by formulas: fingertips with a pattern of their own, a gel that creeps, a one-sided lever."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pytest

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank, BankDefinition, write_bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.estimation import Calibration, Estimate, FrameSeries, Session, TactileFrame, fit

PERIOD_S = 0.54
IDLE_S, CYCLE_S = 20.0, 30.0
CREEP_S = 4.0


@dataclass(frozen=True)
class Tip:
    """A fingertip's idle voltages, and how grip, twist and drift change them."""

    idle: FloatArray
    grip: FloatArray
    twist: FloatArray
    touch: FloatArray
    drift: FloatArray


def tip(number: int) -> Tip:
    rng = np.random.default_rng(1000 + number)
    idle = rng.uniform(0.05, 0.5, PAPER_TABLE.n_channels)
    return Tip(idle, *(idle * rng.normal(0, scale, PAPER_TABLE.n_channels) for scale in (0.06, 0.04, 0.02, 0.01)))


def twisting(
    cycles: int = 4, tips: tuple[int, ...] = (1, 2), seed: int = 0, peak_nm: float = 0.06, noise_v: float = 0.001
) -> FrameSeries:
    """Return idle, gripped and twisted `cycles` times, and idle again; torque is there for a short part of a cycle."""
    rng = np.random.default_rng(seed)
    gripped_s = cycles * CYCLE_S
    t = np.arange(0.0, 2 * IDLE_S + gripped_s, PERIOD_S)
    fine = np.arange(-PERIOD_S, t[-1] + PERIOD_S, 0.09)

    def angle(at: FloatArray) -> FloatArray:
        within = (at > IDLE_S) & (at < IDLE_S + gripped_s)
        return np.where(within, 0.5 - 0.5 * np.cos(2 * np.pi * (at - IDLE_S) / CYCLE_S), 0.0)

    cycle = np.clip((fine - IDLE_S) // CYCLE_S, 0, cycles - 1)
    torque = np.maximum(angle(fine) - 0.9, 0.0) / 0.1 * peak_nm * (1 + 0.03 * cycle)
    follows = 0.09 / CREEP_S
    gel = itertools.accumulate(angle(fine).tolist(), lambda before, now: before + follows * (now - before), initial=0.0)
    crept = np.array(list(gel)[1:])
    grip = ((t > IDLE_S) & (t < IDLE_S + gripped_s)).astype(float)
    at = {name: np.interp(t, fine, values) for name, values in (("torque", torque), ("crept", crept))}
    slow = np.cumsum(rng.normal(0, 0.02, len(t)))
    layers = []
    for number in tips:
        one = tip(number)
        clean = (
            one.idle
            + grip[:, None] * one.grip
            + at["crept"][:, None] * one.twist
            + (at["torque"] / 0.06)[:, None] * one.touch
            + slow[:, None] * one.drift * 0.1
        )
        layers.append(clean + rng.normal(0, noise_v, clean.shape))
    sides = ("right", "left")[: len(tips)]
    channels = np.stack(layers, axis=1)
    return FrameSeries(sides, t, channels, fine, torque, np.full(len(t), np.nan))


# Frames of idle, of a twist up or down, and of a rest with the tool gripped.
IDLE, TURN, REST = 20, 6, 5


def elastic(
    *grips: int,
    idle: int = IDLE,
    rest: int = REST,
    begins_gripped: bool = False,
    seed: int = 0,
    turns: Sequence[float] = (-1.0, 0.5, 1.0),
) -> FrameSeries:
    """Return grips of so many twists in turn, in both directions, with idle frames around each grip.

    The twists go through `turns`, in 0.1 N·m, again and again.

    The torque follows the twist at once, as on a rig without a lever. With `rest` 0 each twist begins as the grip
    closes, and the next one as the last ends.
    """
    angles = np.concatenate([np.linspace(0, 1, TURN), np.ones(TURN), np.linspace(1, 0, TURN), np.zeros(rest)])
    closed: list[FloatArray] = []
    for number, n_twists in enumerate(grips):
        twists = [sign * angles for sign in np.resize(turns, n_twists)]
        closed += [
            np.full(0 if begins_gripped and not number else idle, np.nan),
            np.concatenate([np.zeros(rest), *twists]),
        ]
    angle = np.concatenate([*closed, np.full(idle, np.nan)])
    random = np.random.default_rng(seed)
    grip, twist = np.isfinite(angle)[:, None], np.nan_to_num(angle)
    tips = [tip(number) for number in (1, 2)]
    clean = np.stack([one.idle + grip * one.grip + twist[:, None] * one.twist for one in tips], axis=1)
    t_s = PERIOD_S * np.arange(len(angle))
    fine_s = np.linspace(0.0, t_s[-1], 6 * len(t_s))
    torque_nm = 0.1 * np.interp(fine_s, t_s, twist)
    channels = clean + random.normal(0, 0.002, (len(angle), 2, PAPER_TABLE.n_channels))
    return FrameSeries(("right", "left"), t_s, channels, fine_s, torque_nm, np.full(len(t_s), np.nan))


def kept(whole: FrameSeries, rows: BoolArray) -> FrameSeries:
    """Return the frames of a series that are not lost."""
    return replace(whole, t_s=whole.t_s[rows], channels=whole.channels[rows], diameter_mm=whole.diameter_mm[rows])


class Judged(NamedTuple):
    """Valid torques of known truth: how many, correlation, error in N·m, share within intervals, median width."""

    n: int
    r: float
    rmse: float
    coverage: float
    width: float


def judged(estimates: list[Estimate], played: FrameSeries) -> Judged:
    """Return how estimates compare with the truth."""
    rows = [
        (one.torque_nm, one.torque_low_nm, one.torque_high_nm, truth)
        for one, truth in zip(estimates, played.torque_at_frames(), strict=True)
        if one.valid and np.isfinite(truth)
    ]
    if not rows:
        return Judged(0, np.nan, np.nan, 1.0, np.nan)
    value, low, high, truth = np.array(rows, dtype=np.float64).T
    inside = (low <= truth) & (truth <= high)
    r, rmse = np.corrcoef(value, truth)[0, 1], np.sqrt(((value - truth) ** 2).mean())
    return Judged(len(rows), r, rmse, inside.mean(), float(np.median(high - low)))


def follow(calibration: Calibration | Session, played: FrameSeries, usable: BoolArray | bool = True) -> list[Estimate]:
    """Return the estimates of a session; `usable` is of each (m, 896) frame, or of all (n, m, 896)."""
    session = calibration if isinstance(calibration, Session) else Session(calibration)
    masks = np.broadcast_to(usable, played.channels.shape)
    frames = zip(played.t_s, played.channels, masks, strict=True)
    return [session.estimate(TactileFrame.of(float(t), *each)) for t, *each in frames]


@pytest.fixture(scope="session")
def recorded() -> FrameSeries:
    """One recording that tests share."""
    return twisting()


@pytest.fixture(scope="session")
def motion_calibration(recorded) -> Calibration:
    """An estimator calibrated on the shared recording."""
    return fit("motion_regression", [recorded], "rig")


@pytest.fixture(scope="session")
def bank(tmp_path_factory) -> Bank:
    """Signals that move smoothly along the channels with k and widen with sigma."""
    k, sigma = np.linspace(1, 3, 21), np.linspace(0.5, 2, 16)
    channel = np.linspace(0, 4, 896)
    signals = np.exp(-0.5 * ((channel - k[:, None, None]) / (0.3 * sigma[None, :, None])) ** 2)
    path = tmp_path_factory.mktemp("bank") / "smooth.bank"
    shape = (21, 16)
    homogeneous = np.random.default_rng(0).normal(size=896)
    definition = BankDefinition("ab" * 32, "gaussian_derivative", k, sigma)
    write_bank(path, definition, homogeneous, np.ones(shape), np.ones(shape, bool), signals.astype(np.float32))
    return Bank.open(path)
