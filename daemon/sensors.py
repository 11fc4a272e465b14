"""The sensors of a daemon: built from the configuration, named for tares, tasks and health."""

from collections.abc import Mapping
from dataclasses import dataclass

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, SerialDevice
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recording.recorder import Recorder
from shearloop.daemon.rig import DeviceLink, load_cell_calibration
from shearloop.daemon.sensing.estimators import COMBINED, FrameEstimator
from shearloop.daemon.sensing.fingertip_task import CombinedFingertips, FingertipPipeline, FingertipTask
from shearloop.daemon.sensing.load_cell_task import LOAD_CELL, LoadCellTask
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_SOURCE, RecordedSkin, SkinTask
from shearloop.daemon.sensing.tool_diameter import FingertipDiameters
from shearloop.daemon.supervisor import Task
from shearloop.daemon.taring import Tareable
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
            tasks |= {SKIN: self.skin, SKIN_SOURCE: self.skin.source}
        if self.load_cell is not None:
            tasks[LOAD_CELL] = self.load_cell
        return tasks


@dataclass(frozen=True, slots=True)
class SensorBuilder:
    """Builds the sensors' tasks, which publish, are recorded, and drive the control loop, where there is one."""

    config: DaemonConfig
    publisher: Publisher
    clock: Clock
    recorder: Recorder | None
    loop: ControlLoop | None

    def build(
        self,
        estimators: Mapping[str, FrameEstimator],
        combined: FrameEstimator | None,
        gripper: GripperTask | None,
        diameters: FingertipDiameters | None,
    ) -> Sensors:
        """Return all sensors; `diameters` receives the fingertips' estimates, and the gripper gives the held tool."""

        def estimates(name: str, estimator: FrameEstimator) -> FingertipPipeline:
            return FingertipPipeline(
                name,
                estimator,
                self.publisher,
                self.clock,
                loop=self.loop,
                gripper=gripper,
                diameters=diameters,
                inputs=self._inputs(name),
            )

        pairs: CombinedFingertips | None = None
        if combined is not None:
            period_s = self.config.fingertips[combined.calibration.sides[0]].frame_period_s
            pairs = CombinedFingertips(estimates(COMBINED, combined), period_s)
        fingertips = {
            name: FingertipTask(
                self._eit_kit(name, estimator),
                estimates(name, estimator),
                self.publisher,
                pairs,
                always_heatmap=self.config.fingertips[name].heatmap == "always",
            )
            for name, estimator in estimators.items()
        }
        return Sensors(fingertips, pairs, self._skin(), self._load_cell())

    def _eit_kit(self, name: str, estimator: FrameEstimator) -> EitKit:
        own, slots = self.config.fingertips[name], estimator.table.zero_slots
        return EitKit(self._link(name, own.device), slots, own.frame_period_s, self._inputs(name))

    def _load_cell(self) -> LoadCellTask | None:
        own = self.config.load_cell
        if own is None:
            return None
        link, inputs = self._link(LOAD_CELL, own.device), self._inputs(LOAD_CELL)
        board = LoadCell(link, load_cell_calibration(own), own.rate_hz, inputs)
        return LoadCellTask(board, self.publisher, self.clock, self.loop, own.rate_hz)

    def _skin(self) -> SkinTask | None:
        if self.config.skin is None:
            return None
        inputs = {name: self._inputs(name) for name in RecordedSkin.sources}
        return SkinTask(self.config.skin, self.publisher, self.clock, self.loop, inputs)

    def _link(self, name: str, device: SerialDevice) -> SerialLink:
        return SerialLink(**device.model_dump(), monitor=LinkMonitor(DeviceLink(name, self.loop)))

    def _inputs(self, source: str) -> InputRecorder | None:
        return self.recorder.input_recorder(source) if self.recorder is not None else None
