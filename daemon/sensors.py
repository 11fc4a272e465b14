"""The sensors of a daemon: built from the configuration, named for tares, tasks and health."""

from collections.abc import Mapping
from dataclasses import dataclass

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, SerialDevice
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.logs import LinkReporter
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recording.recorder import Recorder
from shearloop.daemon.rig import load_cell_calibration
from shearloop.daemon.sensing.fingertip_task import CombinedFingertips, FingertipPipeline, FingertipTask
from shearloop.daemon.sensing.frame_estimator import COMBINED, FrameEstimator
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL, LoadCellTask
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_CURRENT, ReplayedSkin, SkinTask
from shearloop.daemon.sensor_protocols import Tareable
from shearloop.daemon.supervisor import Task
from shearloop.drivers.connection import LinkMonitor, SerialLink
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.serial_sensor import InputRecorder


@dataclass(frozen=True, slots=True)
class Sensors:
    """All configured sensors; no device is open yet.

    `tasks` are by their names in `health`; `tareable` is everything that has a zero.
    """

    tasks: Mapping[str, Task]
    tareable: Mapping[str, Tareable]
    combined: CombinedFingertips | None


def build_sensors(
    config: DaemonConfig,
    publisher: Publisher,
    clock: Clock,
    recorder: Recorder | None,
    loop: ControlLoop | None,
    estimators: Mapping[str, FrameEstimator],
    combined: FrameEstimator | None,
    gripper: GripperTask | None,
) -> Sensors:
    """Return all sensors, which publish, are recorded, and drive the control loop, where there is one.

    The gripper gives the held tool, and receives the fingertips' diameters.
    """

    def inputs(source: str) -> InputRecorder | None:
        return recorder.input_recorder(source) if recorder is not None else None

    def link(name: str, device: SerialDevice) -> SerialLink:
        return SerialLink(**device.model_dump(), monitor=LinkMonitor(LinkReporter(name, loop)))

    def pipeline(name: str, estimator: FrameEstimator) -> FingertipPipeline:
        return FingertipPipeline(name, estimator, publisher, clock, loop, gripper, inputs(name))

    pairs: CombinedFingertips | None = None
    if combined is not None:
        period_s = config.fingertips[combined.calibration.sides[0]].frame_period_s
        pairs = CombinedFingertips(pipeline(COMBINED, combined), period_s)
    tasks: dict[str, Task] = {}
    tareable: dict[str, Tareable] = {}
    for name, estimator in estimators.items():
        own, tareable[name] = config.fingertips[name], (estimates := pipeline(name, estimator))
        board = EitKit(link(name, own.device), estimator.table.zero_slots, own.frame_period_s, inputs(name))
        tasks[name] = FingertipTask(board, estimates, publisher, pairs, own.heatmap == "always")
    if pairs is not None:
        tareable[COMBINED] = pairs.pipeline
    if config.skin is not None:
        sources = {name: inputs(name) for name in ReplayedSkin.sources}
        tareable[SKIN] = tasks[SKIN] = skin = SkinTask(config.skin, publisher, clock, loop, sources)
        tasks[SKIN_CURRENT] = skin.source
    if (cell := config.load_cell) is not None:
        calibration = load_cell_calibration(cell)
        lever = LoadCell(link(LOAD_CELL, cell.device), calibration, cell.rate_hz, inputs(LOAD_CELL))
        tareable[LOAD_CELL] = tasks[LOAD_CELL] = LoadCellTask(lever, publisher, clock, loop, cell.rate_hz)
    return Sensors(tasks, tareable, pairs)
