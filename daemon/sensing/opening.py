"""From the configuration to estimators: which one a calibration is of, and the bank that it needs or is shown with."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias
from weakref import WeakValueDictionary

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.calibration import Calibration
from shearloop.bank.eit.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.bank.estimation import Calibration as FittedCalibration
from shearloop.daemon.config import CombinedConfig, FingertipConfig
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.topics import STALE_AFTER_PERIODS
from shearloop.daemon.sensing.estimator import LONGEST_GAP_NS, Estimator
from shearloop.daemon.sensing.tracking import Scoring, TrackedEstimator

AnyEstimator: TypeAlias = Estimator | TrackedEstimator
_MATCHERS: Mapping[str, type[PrunedMatcher | PrunedZeroLagMatcher]] = {
    "all_lags": PrunedMatcher,
    "zero_lag": PrunedZeroLagMatcher,
}
# Matchers in use, which keep no state between calls: fingertips of one bank share one, its memory and its start.
_in_use: WeakValueDictionary[tuple[str, str], PrunedMatcher | PrunedZeroLagMatcher] = WeakValueDictionary()


def open_estimator(config: FingertipConfig, name: str) -> AnyEstimator:
    """Return the estimator of one fingertip.

    Raises BankError when a file is missing, damaged or does not fit, UserError for an estimator that the calibration
    is not of.
    """
    if config.calibration is not None and _is_fitted(config.calibration):
        fitted = _fitted(config.calibration, config.estimator)
        if fitted.sides != (name,):
            raise UserError(
                f"{config.calibration} is of the {' and '.join(fitted.sides)} fingertip, and not of {name}; "
                f"calibrate with `--sides {name}`, or name a calibration of both under `both`"
            )
        return _tracked(fitted, config)
    if config.estimator not in (None, "paper"):
        if config.calibration is None:
            there = "none is configured"
        else:
            there = f"{config.calibration} {'is another kind' if config.calibration.exists() else 'does not exist'}"
        raise UserError(
            f"the estimator {config.estimator} of {name} needs a calibration that was fitted to recordings, and "
            f"{there}; make one with `shearloop calibrate REC… --estimator "
            f"{config.estimator} --out CAL`"
        )
    if config.bank is None:
        raise UserError(f"the paper's estimator of {name} needs its bank; add `bank:` to the fingertip")
    bank = Bank.open(config.bank)
    calibration = None
    if config.calibration is not None:
        calibration = Calibration.load(config.calibration, bank_identity=bank.identity)
    return Estimator(
        _matcher(bank, config.matching),
        calibration,
        baseline_frames=config.baseline_frames,
        average_frames=config.average_frames,
        longest_gap_ns=max(LONGEST_GAP_NS, round(STALE_AFTER_PERIODS * config.frame_period_s * 1e9)),
        model=bank.model,
    )


def open_both(config: CombinedConfig, fingertips: dict[str, FingertipConfig]) -> TrackedEstimator:
    """Return the estimator of several fingertips together; raises as `open_estimator` does."""
    fitted = _fitted(config.calibration, config.estimator)
    missing = [side for side in fitted.sides if side not in fingertips]
    if missing or len(fitted.sides) < 2:
        raise UserError(
            f"{config.calibration} is of {' and '.join(fitted.sides)}, and the fingertips are "
            f"{', '.join(fingertips)}; calibrate on a recording of both, and name the fingertips as its sides"
        )
    return _tracked(fitted, fingertips[fitted.sides[0]])


def on_word(estimator: AnyEstimator) -> str:
    """Return what is added where a calibration is shown that somebody vouched for; empty for others."""
    word = estimator.word if isinstance(estimator, TrackedEstimator) else ""
    return f", on somebody's word {word}" if word else ""


def _tracked(fitted: FittedCalibration, config: FingertipConfig) -> TrackedEstimator:
    bank = Bank.open(config.bank) if config.bank is not None else None
    scoring = Scoring(_matcher(bank, config.matching), bank.model) if bank is not None else None
    return TrackedEstimator(
        fitted, bank, scoring, baseline_frames=config.baseline_frames, period_s=config.frame_period_s
    )


def _matcher(bank: Bank, matching: str) -> PrunedMatcher | PrunedZeroLagMatcher:
    key = (f"{bank.identity} {bank.signals_sha256}", matching)
    shared = _in_use.get(key)
    if shared is not None:
        return shared
    matcher = _MATCHERS[matching].from_bank(bank)
    _in_use[key] = matcher
    return matcher


def _fitted(path: Path, wanted: str | None) -> FittedCalibration:
    fitted = FittedCalibration.load(path)
    if fitted.kind != "raw":
        raise UserError(f"{path} was made from slices; the daemon has raw frames, calibrate on a recording of them")
    if wanted not in (None, fitted.estimator):
        raise UserError(
            f"{path} is a calibration of the estimator {fitted.estimator}, and {wanted} is configured; "
            f"name the other, or calibrate with `--estimator {wanted}`"
        )
    return fitted


def _is_fitted(path: Path) -> bool:
    return path.exists() and zipfile.is_zipfile(path)
