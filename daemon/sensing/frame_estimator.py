"""Estimators of the daemon: opened from the configuration, and run on the boards' frames. No I/O but the files."""

import asyncio
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from weakref import WeakValueDictionary

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.bank.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.daemon.config import CombinedConfig, DaemonConfig, FingertipConfig
from shearloop.daemon.control.samples import TorqueSource
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL
from shearloop.daemon.sensing.skin_task import skin_torque_source
from shearloop.drivers.eit_kit import Frame
from shearloop.errors import UserError
from shearloop.estimation import Calibration, Estimate, EstimatorSession, TactileFrame
from shearloop.estimation.bank_match import PaperMatcher
from shearloop.estimation.defaults import MAX_GAP_S
from shearloop.estimation.estimator import PaperEstimator
from shearloop.estimation.session import REPEATED_FRAME

# Source of the estimate from several fingertips together.
COMBINED = "combined"
_MATCHERS: Mapping[str, type[PrunedMatcher | PrunedZeroLagMatcher]] = {
    "all_lags": PrunedMatcher,
    "zero_lag": PrunedZeroLagMatcher,
}
# Matchers in use have no state, so fingertips with the same bank share one.
_in_use: WeakValueDictionary[tuple[str, str], PrunedMatcher | PrunedZeroLagMatcher] = WeakValueDictionary()
# After a grip some frames are disturbed or missing.
_WARM_UP_SHARE = 2.0


class FrameEstimator:
    """Estimates from the frames of one fingertip, or of several together, in order.

    Around its `session` it adds the board's flags, and the bank match where a bank is configured.
    """

    def __init__(self, calibration: Calibration, config: FingertipConfig) -> None:
        """Begin a session; raises CalibrationError for a bank that is missing or another one."""
        bank = Bank.open(config.bank) if config.bank is not None else None
        self.calibration = calibration
        self.model = bank.model if bank is not None else ""
        self._matcher = _shared_matcher(bank, config.matching) if bank is not None else None
        # Only the paper's estimator averages; its calibration is of no side.
        self._averaged_frames = 1 if calibration.sides else config.average_frames
        matcher = None
        if not calibration.sides and self._matcher is not None:
            calibration.check_bank(bank)
            matcher = PaperMatcher(self._matcher)
        self.session = EstimatorSession(
            calibration,
            bank,
            matcher=matcher,
            period_s=config.frame_period_s,
            baseline_frames=config.baseline_frames,
            average_frames=config.average_frames,
            max_gap_s=max(MAX_GAP_S, STALE_AFTER_PERIODS * config.frame_period_s),
        )

    @property
    def table(self) -> ChannelTable:
        """The fingertip's channels."""
        return self.calibration.estimator.table

    @property
    def measures_torque(self) -> bool:
        """Whether it gives torques, and not only diameters or the bank match."""
        return self.calibration.torque is not None

    def continue_from(self, session: EstimatorSession) -> None:
        """Go on with the session of another estimator of the same configuration."""
        self.session = session

    @property
    def grids(self) -> tuple[FloatArray, FloatArray] | None:
        """The k and the sigma of the bank's cells, None without a bank."""
        return (self._matcher.k_grid, self._matcher.sigma_grid) if self._matcher is not None else None

    def torque_source(self, name: str, period_s: float) -> TorqueSource:
        """Return what the control loop knows of its torques; `period_s` is the frame period."""
        return TorqueSource(
            name=name,
            period_s=period_s,
            window_s=period_s * self._averaged_frames,
            measures_torque=self.measures_torque,
            # The first torque after a grip needs the lagged frames too.
            warm_up_s=_WARM_UP_SHARE * self.calibration.estimator.motion.n_needed * period_s,
            has_gain=self.measures_torque,
        )

    async def estimate(self, *frames: Frame) -> Estimate:
        """Return the estimate of frames of one time, one for each side.

        A search of the bank runs in a thread: it can take half a second.
        """
        channels, usable, t_ns = [], [], 0
        for frame in frames:
            if frame.repeated and frame.channels.any():
                return Estimate(valid=False, reasons=REPEATED_FRAME)
            channels.append(frame.channels)
            usable.append(~(frame.saturated | frame.dead))
            t_ns += frame.t_mid_ns
        tactile = TactileFrame(t_ns / len(frames) / 1e9, np.array(channels), np.array(usable))
        if self._matcher is None:
            return self.session.estimate(tactile)
        return await asyncio.to_thread(self._estimate_with_bank, tactile)

    def _estimate_with_bank(self, frame: TactileFrame) -> Estimate:
        estimate = self.session.estimate(frame)
        difference = self._first_difference()
        if not estimate.valid or estimate.k is not None or self._matcher is None or difference is None:
            return estimate
        match = self._matcher.match(difference)
        return replace(estimate, k=match.k, sigma=match.sigma, score=match.score, runner_up=match.runner_up)

    def heatmap(self) -> FloatArray | None:
        """Return the (K, S) scores of the first side's last difference, None without a bank or a difference."""
        difference = self._first_difference()
        return None if self._matcher is None or difference is None else self._matcher.heatmap(difference)

    def _first_difference(self) -> FloatArray | None:
        difference = self.session.difference
        return difference[0] if difference is not None and difference[0].any() else None


def channel_table(config: DaemonConfig) -> ChannelTable:
    """Return the channels of the fingertips, by their banks and calibrations.

    Raises UserError where these differ, and BankError as `open_estimator` does.
    """
    tables = {name: fingertip_table(fingertip) for name, fingertip in config.fingertips.items()}
    if len({*tables.values()}) > 1:
        kinds = ", ".join(f"{name} has {each.n_channels} channels" for name, each in tables.items())
        raise UserError(f"the fingertips are of different kinds ({kinds}); run a daemon for each kind")
    return next(iter(tables.values()), PAPER_TABLE)


def fingertip_table(config: FingertipConfig) -> ChannelTable:
    """Return a fingertip's channels, by its bank or its calibration, else the paper's."""
    if config.bank is not None:
        return Bank.open(config.bank).table
    if config.calibration is not None and os.path.exists(config.calibration):
        return Calibration.load(config.calibration).estimator.table
    return PAPER_TABLE


def open_estimator(config: FingertipConfig, name: str) -> FrameEstimator:
    """Return the estimator of one fingertip.

    Raises BankError for a file that is missing, damaged or does not fit, and UserError for a calibration of another
    estimator or side.
    """
    if config.calibration is not None and os.path.exists(config.calibration):
        calibration = _load(config.calibration, config.estimator)
        if calibration.sides and calibration.sides != (name,):
            raise UserError(
                f"{config.calibration} is of the {' and '.join(calibration.sides)} fingertip, not of {name}; "
                f"calibrate with `--sides {name}`, or name a calibration of both under `combined`"
            )
        if calibration.estimator.needs == "bank" and config.bank is None:
            raise _without_bank(calibration.estimator.name, name)
        return _live(config.calibration, calibration, config)
    if config.estimator not in (None, PaperEstimator.name):
        found = "none is configured" if config.calibration is None else f"{config.calibration} does not exist"
        options = f"--sides {name} --estimator {config.estimator} --out {config.calibration or 'CAL'}"
        raise UserError(
            f"the estimator {config.estimator} of {name} needs a calibration on recordings, and {found}; make one with "
            f"`shearloop calibrate REC… {options}`"
        )
    if config.bank is None:
        raise _without_bank(PaperEstimator.name, name)
    if config.calibration is not None:
        return FrameEstimator(Calibration.load(config.calibration), config)
    bank = Bank.open(config.bank)
    return FrameEstimator(Calibration.uncalibrated(bank.identity, bank.table), config)


def _without_bank(estimator: str, name: str) -> UserError:
    return UserError(f"the estimator `{estimator}` needs a bank; add `bank:` to the fingertip {name}")


def open_combined(config: CombinedConfig, fingertips: Mapping[str, FingertipConfig]) -> FrameEstimator:
    """Return the estimator of several fingertips together; raises as `open_estimator` does."""
    calibration = _load(config.calibration, config.estimator)
    missing = [side for side in calibration.sides if side not in fingertips]
    if missing or len(calibration.sides) < 2:
        raise UserError(
            f"{config.calibration} is of {' and '.join(calibration.sides)}, and the fingertips are "
            f"{', '.join(fingertips)}; calibrate on a recording of both, and name the fingertips as its sides"
        )
    return _live(config.calibration, calibration, fingertips[calibration.sides[0]])


def torque_sources(
    config: DaemonConfig, estimators: Mapping[str, FrameEstimator], combined: FrameEstimator | None
) -> dict[str, TorqueSource]:
    """Return the period of each sensor's torque, and the time that it averages over."""
    periods_s = {name: own.frame_period_s for name, own in config.fingertips.items()}
    sources = {name: estimator.torque_source(name, periods_s[name]) for name, estimator in estimators.items()}
    if combined is not None:
        sources[COMBINED] = combined.torque_source(COMBINED, max(periods_s.values()))
    if config.skin is not None and (skin := skin_torque_source(config.skin)) is not None:
        sources[skin.name] = skin
    if config.load_cell is not None:
        sources[LOAD_CELL] = TorqueSource(name=LOAD_CELL, period_s=1.0 / config.load_cell.rate_hz)
    return sources


def _shared_matcher(bank: Bank, matching: str) -> PrunedMatcher | PrunedZeroLagMatcher:
    key = (f"{bank.identity} {bank.signals_sha256}", matching)
    shared = _in_use.get(key)
    if shared is None:
        shared = _in_use[key] = _MATCHERS[matching].from_bank(bank)
    return shared


def _live(path: Path, calibration: Calibration, config: FingertipConfig) -> FrameEstimator:
    try:
        return FrameEstimator(calibration, config)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _load(path: Path, wanted: str | None) -> Calibration:
    calibration = Calibration.load(path)
    if calibration.kind != "raw":
        raise UserError(f"{path} was made from slices; the daemon has raw frames: calibrate on a recording of them")
    if wanted not in (None, calibration.estimator.name):
        raise UserError(
            f"{path} is a calibration of the estimator {calibration.estimator.name}, and {wanted} is configured; "
            f"name the other, or calibrate with `--estimator {wanted}`"
        )
    return calibration
