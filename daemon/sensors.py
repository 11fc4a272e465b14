"""The sensors of a configuration, connected to publisher, recorder and control loop; no device is open yet."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import structlog

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, FingertipConfig, LoadCellConfig, SerialDevice
from shearloop.daemon.logs import LinkReporter
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.patience import patience_of
from shearloop.daemon.sensing.fingertip_boards import BoardTask, CombinedTask
from shearloop.daemon.sensing.fingertip_task import SessionRecorder, ToolHolder
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.daemon.sensing.load_cell_task import LoadCellTask
from shearloop.daemon.sensing.sessions import COMBINED, open_combined, open_session, refuse_emulated_calibrations
from shearloop.daemon.supervisor import Task
from shearloop.daemon.torques import LOAD_CELL, LONGEST_TARE_S, SensorListener, Tareable
from shearloop.drivers.calibration_files import load_device_calibration
from shearloop.drivers.connection import LinkMonitor, SerialLink
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.estimation import Session

if TYPE_CHECKING:
    # Only a rig that records loads it.
    from shearloop.daemon.recorder.recorder import Recorder


def load_cell_calibration(config: LoadCellConfig) -> LoadCalibration:
    """Return the load cell's calibration; raises DriverError if it cannot be used."""
    if config.calibration is None:
        return LoadCalibration.of_torque_lines()
    return load_device_calibration(config.calibration, LoadCalibration)


@dataclass(frozen=True, slots=True)
class Sessions:
    """The session of each fingertip by its name, and of all together, if that is configured."""

    fingertips: Mapping[str, Session]
    combined: Session | None


def open_sessions(config: DaemonConfig) -> Sessions:
    """Return the sessions of the configured fingertips; raises UserError for files that cannot be used."""
    refuse_emulated_calibrations(config)
    fingertips = {name: open_session(fingertip, name) for name, fingertip in config.fingertips.items()}
    combined = open_combined(config.combined, config.fingertips) if config.combined is not None else None
    log_banks(config, fingertips)
    log_assumptions(fingertips if combined is None else {**fingertips, COMBINED: combined})
    return Sessions(fingertips, combined)


def log_banks(config: DaemonConfig, fingertips: Mapping[str, Session]) -> None:
    """Log the geometry of each fingertip's bank: no frame shows whether it is the fingertip's own."""
    for name, session in fingertips.items():
        if session.search is not None:
            found = {"geometry": session.search.geometry_hash[:12], "channels": session.calibration.table.description}
            structlog.get_logger().info(f"the bank of {name}", file=str(config.fingertips[name].bank), **found)


def log_assumptions(sessions: Mapping[str, Session]) -> None:
    """Log what the estimates of each session rest on that nothing checks."""
    for name, session in sessions.items():
        if assumed := session.calibration.assumption_text:
            structlog.get_logger().warning(f"the calibration of {name} assumes that {assumed}")


@dataclass(frozen=True, slots=True)
class Sensors:
    """All configured sensors; no device is open yet.

    `tasks` are by their names in `health`; `tareable` is everything that has a zero.
    """

    tasks: Mapping[str, Task]
    tareable: Mapping[str, Tareable]
    combined: CombinedTask | None
    load_cell: LoadCell | None


def build_sensors(
    config: DaemonConfig,
    publisher: Publisher,
    clock: Clock,
    recorder: "Recorder | None",
    sessions: Sessions,
    loop: SensorListener | None = None,
    gripper: ToolHolder | None = None,
) -> Sensors:
    """Return all sensors, which publish, are recorded, and are passed on to the `loop`.

    The gripper gives the held tool, and receives the fingertips' diameters.
    """

    def inputs(source: str) -> SessionRecorder | None:
        return recorder.input_recorder(source) if recorder is not None else None

    def link(name: str, device: SerialDevice) -> SerialLink:
        return SerialLink(**device.model_dump(), monitor=LinkMonitor(LinkReporter(name, loop)))

    patience = patience_of(config)
    boards: dict[str, EitKit] = {}
    for name, session in sessions.fingertips.items():
        own, zero_slots = config.fingertips[name], session.calibration.table.zero_slots
        boards[name] = EitKit(link(name, own.device), zero_slots, own.frame_period_s, inputs(name), patience)
    pairs: CombinedTask | None = None
    if (combined := sessions.combined) is not None:
        sides = combined.calibration.sides
        period_s = config.fingertips[sides[0]].frame_period_s
        pairs = CombinedTask(
            COMBINED, combined, publisher, clock, loop, gripper, inputs(COMBINED),
            longest_tare_s=_longest_tare_s(config.fingertips[sides[0]]),
            period_s=period_s, pairing=FramePairing(sides, period_s), boards={side: boards[side] for side in sides},
        )  # fmt: skip
    tasks: dict[str, Task] = {}
    tareable: dict[str, Tareable] = {}
    for name, session in sessions.fingertips.items():
        own = config.fingertips[name]
        task = BoardTask(
            name, session, publisher, clock, loop, gripper, inputs(name), longest_tare_s=_longest_tare_s(own),
            board=boards[name], combined=pairs, always_heatmap=own.heatmap == "always",
        )  # fmt: skip
        tasks[name] = tareable[name] = task
    if pairs is not None:
        tareable[COMBINED] = pairs
    if config.skin is not None:
        # Only a rig with a skin loads its modules.
        from shearloop.daemon.sensing.skin_task import SKIN, SKIN_CURRENT, SKIN_SOURCES, SkinTask

        sources = {name: inputs(name) for name in SKIN_SOURCES}
        tareable[SKIN] = tasks[SKIN] = skin = SkinTask(config.skin, publisher, clock, loop, sources)
        tasks[SKIN_CURRENT] = skin.source
    load_cell: LoadCell | None = None
    if (own_cell := config.load_cell) is not None:
        calibration, rate_hz = load_cell_calibration(own_cell), own_cell.rate_hz
        load_cell = LoadCell(link(LOAD_CELL, own_cell.device), calibration, rate_hz, inputs(LOAD_CELL), patience)
        tareable[LOAD_CELL] = tasks[LOAD_CELL] = LoadCellTask(load_cell, publisher, clock, loop, rate_hz)
    return Sensors(tasks, tareable, pairs, load_cell)


def _longest_tare_s(fingertip: FingertipConfig) -> float:
    """Return the time within which a fingertip's tare must be complete: three times the time of its frames."""
    return max(LONGEST_TARE_S, 3.0 * fingertip.baseline_frames * fingertip.frame_period_s)
