"""What the sensors can measure of the torques that an experiment asks for, and what the driving torque rests on."""

from collections.abc import Iterator, Mapping

from shearloop.bank.errors import CalibrationError
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.experiment_schema import ExperimentFile, HoldTorqueStep, Step, TightenStep
from shearloop.daemon.motion_cap import Commissioning, knows_tool
from shearloop.daemon.reach import Reach
from shearloop.daemon.torques import SIGNS, TorqueSource
from shearloop.drivers.ranges import LARGEST_TORQUE_NM
from shearloop.estimation import Measured


def beyond_reach(file: ExperimentFile, sources: Mapping[str, TorqueSource]) -> Iterator[tuple[int, str]]:
    """Yield the number, from 0, of each step that asks for a torque which a sensor cannot measure, with the reason.

    One that only supervises would hold the wrist there as well, because it has no torque.
    """
    tool = None if file.tool_mm is None else Measured(file.tool_mm, 0.0)
    reaches = {name: reach for name, source in sources.items() if (reach := _reach(source, tool)) is not None}
    for number, step in enumerate(file.steps):
        torque_nm = _asked_nm(step)
        # An unknown torque, as in an outline, is 0; a larger one than any is no torque.
        if not 0.0 < abs(torque_nm) <= LARGEST_TORQUE_NM:
            continue
        for name, reach in reaches.items():
            # What reads as 0 is another mistake.
            if sources[name].as_read_nm(torque_nm) and not reach.low_nm <= torque_nm <= reach.high_nm:
                role = "" if name == file.torque_source else ", which supervises,"
                yield (
                    number,
                    f"{step.do} asks for {torque_nm:+.3g} N·m, and {name}{role} measures {reach.low_nm:+.3g} to "
                    f"{reach.high_nm:+.3g} N·m: {reach.why}",
                )


def _asked_nm(step: Step) -> float:
    match step:
        case HoldTorqueStep(signed_torque_nm=torque_nm):
            return torque_nm
        case TightenStep(direction=direction, until_torque_nm=torque_nm):
            return SIGNS[direction] * torque_nm
    return 0.0


def _reach(source: TorqueSource, tool: Measured | None) -> Reach | None:
    """Return what a source can measure on a tool, None where that is not known."""
    if source.calibration is None or not source.measures_torque:
        return source.reach
    try:
        torque = source.calibration.for_tool(tool).torque
    except CalibrationError:
        # It is another mistake, or the gripper will measure the diameter.
        return None
    if torque is None:
        return None
    ends = torque.regressor.range.ends
    return Reach(*ends, "ask for less, or calibrate it further")


def tool_note(
    file: ExperimentFile, config: DaemonConfig, sources: Mapping[str, TorqueSource], robot: Commissioning | None
) -> str:
    """Return what the driving torque rests on that nothing will check about the tool; empty without anything."""
    driving = sources.get(file.torque_source)
    if driving is None or driving.calibration is None:
        return ""
    return driving.calibration.tool_note(driving.name, tool_known=knows_tool(file.tool_mm, config, robot))
