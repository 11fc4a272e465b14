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
    """The tasks of all configured sensors; no device is open yet."""

    fingertips: Mapping[str, FingertipTask]
    combined: CombinedFingertips | None
    skin: SkinTask | None
    load_cell: LoadCellTask | None

    def tareable(self) -> dict[str, Tareable]:
        """Return everything that has a zero, by its name."""
        named: dict[str, Tareable | None] = {
            **{name: task.pipeline for name, task in self.fingertips.items()},
            COMBINED: self.combined.pipeline if self.combined is not None else None,
            SKIN: self.skin,
            LOAD_CELL: self.load_cell,
        }
        return {name: sensor for name, sensor in named.items() if sensor is not None}

    def tasks(self) -> dict[str, Task]:
        """Return the tasks to run, by their names in `health`."""
        tasks: dict[str, Task] = dict(self.fingertips)
        if self.skin is not None:
            tasks |= {SKIN: self.skin, SKIN_CURRENT: self.skin.source}
        if self.load_cell is not None:
            tasks[LOAD_CELL] = self.load_cell
        return tasks


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
    fingertips = {}
    for name, estimator in estimators.items():
        own, slots = config.fingertips[name], estimator.table.zero_slots
        board = EitKit(link(name, own.device), slots, own.frame_period_s, inputs(name))
        always = own.heatmap == "always"
        fingertips[name] = FingertipTask(board, pipeline(name, estimator), publisher, pairs, always)
    skin = load_cell = None
    if config.skin is not None:
        sources = {name: inputs(name) for name in ReplayedSkin.sources}
        skin = SkinTask(config.skin, publisher, clock, loop, sources)
    if (cell := config.load_cell) is not None:
        calibration = load_cell_calibration(cell)
        lever = LoadCell(link(LOAD_CELL, cell.device), calibration, cell.rate_hz, inputs(LOAD_CELL))
        load_cell = LoadCellTask(lever, publisher, clock, loop, cell.rate_hz)
    return Sensors(fingertips, pairs, skin, load_cell)
