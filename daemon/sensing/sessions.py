"""Sessions of the configured fingertips: files are opened, and what the control loop knows of their torques."""

import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.daemon.config import CombinedConfig, DaemonConfig, FingertipConfig
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS
from shearloop.daemon.torques import LOAD_CELL, TorqueSource
from shearloop.errors import UserError
from shearloop.estimation import Calibration, Session
from shearloop.estimation.calibration import check_bank_table
from shearloop.estimation.defaults import MAX_GAP_S

if TYPE_CHECKING:
    # Only a fingertip with a bank loads them.
    from shearloop.bank.bank_file import Bank
    from shearloop.estimation.bank_match import BankSearch

# Source of the estimate from several fingertips together.
COMBINED = "combined"
# The only estimator that needs no calibration.
_PAPER = "paper"
# A search has no state, so fingertips with the same bank share one.
_in_use: "WeakValueDictionary[tuple[str, str], BankSearch]" = WeakValueDictionary()
# After a grip some frames are disturbed or missing.
_WARM_UP_FACTOR = 2.0


def channel_table(fingertips: Mapping[str, Session]) -> ChannelTable:
    """Return the channels of the fingertips with these sessions; raises UserError where they differ."""
    tables = {name: session.calibration.table for name, session in fingertips.items()}
    if len({*tables.values()}) > 1:
        kinds = ", ".join(f"{name} has {each.n_channels} channels" for name, each in tables.items())
        raise UserError(f"the fingertips are of different kinds ({kinds}); run a daemon for each kind")
    return next(iter(tables.values()), PAPER_TABLE)


def open_session(config: FingertipConfig, name: str) -> Session:
    """Return the session of one fingertip.

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
        return _open(config.calibration, calibration, config)
    if config.estimator not in (None, _PAPER):
        found = "none is configured" if config.calibration is None else f"{config.calibration} does not exist"
        options = f"--sides {name} --estimator {config.estimator} --out {shlex.quote(str(config.calibration or 'CAL'))}"
        raise UserError(
            f"the estimator {config.estimator} of {name} needs a calibration on recordings, and {found}; make one with "
            f"`shearloop calibrate REC… {options}`"
        )
    if config.bank is None and config.estimator is None and config.calibration is None:
        raise UserError(
            f"the fingertip {name} has no calibration and no bank: add `calibration:` for its torque, or `bank:` for k "
            "and sigma"
        )
    if config.bank is None:
        raise _without_bank(_PAPER, name)
    if config.calibration is not None:
        # The file is missing, and the error says how to make it.
        return _open(config.calibration, Calibration.load(config.calibration), config)
    return _session(None, config)


def refuse_emulated_calibrations(config: DaemonConfig) -> None:
    """Raise UserError for a calibration on emulated devices in a configuration of real ones."""
    if config.emulated:
        return
    named = [one.calibration for one in (*config.fingertips.values(), config.combined) if one is not None]
    for path in dict.fromkeys(path for path in named if path is not None and os.path.exists(path)):
        if Calibration.load(path).emulated:
            raise UserError(
                f"{path} was made from recordings of emulated devices, and says nothing about your fingertips: "
                "calibrate on recordings of this rig"
            )


def _without_bank(estimator: str, name: str) -> UserError:
    return UserError(f"the estimator `{estimator}` needs a bank; add `bank:` to the fingertip {name}")


def open_combined(config: CombinedConfig, fingertips: Mapping[str, FingertipConfig]) -> Session:
    """Return the session of several fingertips together; raises as `open_session` does."""
    calibration = _load(config.calibration, config.estimator)
    missing = [side for side in calibration.sides if side not in fingertips]
    if missing or len(calibration.sides) < 2:
        raise UserError(
            f"{config.calibration} is of {' and '.join(calibration.sides)}, and the fingertips are "
            f"{', '.join(fingertips)}; calibrate on a recording of both, and name the fingertips as its sides"
        )
    return _open(config.calibration, calibration, fingertips[calibration.sides[0]])


def torque_sources(
    config: DaemonConfig, sessions: Mapping[str, Session], combined: Session | None
) -> dict[str, TorqueSource]:
    """Return what the control loop knows of each sensor's torque."""
    periods_s = {name: own.frame_period_s for name, own in config.fingertips.items()}
    sources = {name: _torque_source(session, name, periods_s[name]) for name, session in sessions.items()}
    if combined is not None:
        sources[COMBINED] = _torque_source(combined, COMBINED, max(periods_s.values()))
    if config.skin is not None:
        # Only a rig with a skin loads its modules.
        from shearloop.daemon.sensing.skin_task import skin_torque_source

        if (skin := skin_torque_source(config.skin)) is not None:
            sources[skin.name] = skin
    if config.load_cell is not None:
        from shearloop.daemon.reach import Reach
        from shearloop.drivers.load_cell import CAPACITY_NM

        cell, reach = config.load_cell, Reach(-CAPACITY_NM, CAPACITY_NM, "this is its capacity; ask for less")
        sources[LOAD_CELL] = TorqueSource(
            name=LOAD_CELL, period_s=1.0 / cell.rate_hz, needs_zero=True, only_sign=cell.only_sign, reach=reach
        )
    return sources


def _torque_source(session: Session, name: str, period_s: float) -> TorqueSource:
    calibration = session.calibration
    return TorqueSource(
        name=name,
        period_s=period_s,
        window_s=period_s * session.averaged_frames,
        measures_torque=calibration.measures_torque,
        # The first torque after a grip needs the lagged frames too, and none is of a frame that saw the fingers move.
        warm_up_s=_WARM_UP_FACTOR * max(calibration.estimator.motion.n_needed, 2) * period_s,
        has_gain=calibration.measures_torque,
        only_sign=calibration.only_sign,
        calibration=calibration,
    )


def _open(path: Path, calibration: Calibration, config: FingertipConfig) -> Session:
    try:
        return _session(calibration, config)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def _session(calibration: Calibration | None, config: FingertipConfig) -> Session:
    """Return a session; without a calibration it has no torque, and needs a bank.

    Raises CalibrationError for a bank that is missing or another one.
    """
    bank = _open_bank(config.bank) if config.bank is not None else None
    if calibration is None:
        if bank is None:
            raise ValueError("a session without a calibration needs a bank")
        calibration = Calibration.uncalibrated(bank.identity, bank.table)
    if bank is not None and calibration.sides:
        check_bank_table(bank, calibration.table, "the calibration has")
    search = _shared_search(bank, config.matching) if bank is not None else None
    period_s, baseline_frames = config.frame_period_s, config.baseline_frames
    if calibration.sides:
        return Session(calibration, bank, search=search, period_s=period_s, baseline_frames=baseline_frames)
    # Only the paper's estimator is of no side.
    calibration.check_bank(bank)
    if search is None:
        raise ValueError("the paper's estimator needs a bank")
    from shearloop.estimation.bank_match import PaperMatcher
    from shearloop.estimation.paper_session import PaperSession

    return PaperSession(
        calibration,
        PaperMatcher(search),
        search=search,
        baseline_frames=baseline_frames,
        average_frames=config.average_frames,
        max_gap_s=max(MAX_GAP_S, STALE_AFTER_PERIODS * period_s),
    )


def _open_bank(path: Path) -> "Bank":
    from shearloop.bank.bank_file import Bank

    return Bank.open(path)


def _shared_search(bank: "Bank", matching: str) -> "BankSearch":
    """Return the search of a bank, the one that another fingertip uses already where there is one."""
    # Only a rig with a bank loads what searches it.
    from shearloop.bank.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher

    searches: Mapping[str, type[BankSearch]] = {"all_lags": PrunedMatcher, "zero_lag": PrunedZeroLagMatcher}
    key = (f"{bank.identity} {bank.signals_sha256}", matching)
    shared = _in_use.get(key)
    if shared is None:
        shared = _in_use[key] = searches[matching].from_bank(bank)
    return shared


def _load(path: Path, wanted: str | None) -> Calibration:
    calibration = Calibration.load(path)
    if wanted not in (None, calibration.estimator.name):
        raise UserError(
            f"{path} is a calibration of the estimator {calibration.estimator.name}, and {wanted} is configured; "
            f"name the other, or calibrate with `--estimator {wanted}`"
        )
    return calibration
