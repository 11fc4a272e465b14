"""What the configured report of a rig's commissioning allows; a rig without a report loads nothing of reports."""

from datetime import UTC, datetime

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.motion_cap import Commissioning
from shearloop.daemon.torques import BOTH_DIRECTIONS, LOAD_CELL
from shearloop.drivers.ur.settings import UrSettings


def commissioning_of(config: DaemonConfig, settings: UrSettings, now: datetime | None = None) -> Commissioning:
    """Return what a rig's report allows at a time, by default now.

    A rehearsal has the cap of the rig that it plays, and a report of emulated devices raises this cap too. Raises
    UserError for a file that cannot be read or is no report, which is a mistake in the configuration.
    """
    rehearsed = config.real is not config
    if config.emulated and not rehearsed:
        return Commissioning(settings, None, emulated=True)
    if config.commissioned is None:
        return Commissioning(settings, None, rehearsed=rehearsed)
    from shearloop.daemon.report_validity import load_report, why_not
    from shearloop.daemon.rig_identity import source_sha256

    report = load_report(config.commissioned)
    reason = why_not(report, config, now or datetime.now(UTC))
    measured = {} if reason else report.supplied().torque_sources or {}
    # After another calibration, sign and scale are not known.
    same = (name for name, own in sorted(measured.items()) if source_sha256(config, name) == own)
    # Stage 7 measures what the load cell does; another `load_cell.direction` makes it old.
    cell = config.real.load_cell
    directions = BOTH_DIRECTIONS if cell is None or cell.direction is None else frozenset({cell.direction})
    return Commissioning(
        settings, report, reason, rehearsed=rehearsed, torque_sources=(LOAD_CELL, *same), torque_directions=directions
    )
