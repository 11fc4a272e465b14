"""The stages of a commissioning in order: each is written into the report as soon as it has ended."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from shearloop.daemon.commissioning_report import Report, StageResult, stage_number
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.motion_cap import why_not_emulated
from shearloop.daemon.report_validity import old_stages
from shearloop.daemon.rig import gripper_calibration, open_settings
from shearloop.daemon.rig_identity import identity_of, judged_by, judged_sha256s
from shearloop.daemon.robot_files import RobotFiles, lock_robot
from shearloop.daemon.sensing.skin_task import check_circuit
from shearloop.daemon.sensors import load_cell_calibration
from shearloop.errors import UserError
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.commission import boards, gripper, identity, motion, rtde, stops, tool, wrench
from shearloop.tools.commission.context import Context, Counts
from shearloop.tools.commission.limits import EMULATED
from shearloop.tools.commission.operator import Operator
from shearloop.tools.commission.remembered import LeftRobot
from shearloop.tools.commission.report import Measured, page_path, report_for, with_stage, without_stage
from shearloop.tools.commission.report_file import ReportFile
from shearloop.tools.commission.rig import ConnectedRig, Rig
from shearloop.tools.commission.tactile import calibrated_sessions
from shearloop.tools.outputs import check_apart

Measure = Callable[[Context], Measured]

STAGES: Final[dict[str, Measure]] = {
    identity.STAGE: identity.measure,
    rtde.STAGE: rtde.measure,
    gripper.STAGE: gripper.measure,
    motion.STAGE: motion.measure,
    stops.STAGE: stops.measure,
    wrench.STAGE: wrench.measure,
    boards.STAGE: boards.measure,
    tool.STAGE: tool.measure,
}


def commission(
    config: DaemonConfig,
    path: Path,
    out: Path,
    operator: Operator,
    counts: Counts,
    only: Sequence[str] = (),
    rig: Rig | None = None,
) -> tuple[Report, Path]:
    """Run the stages that the report in `out` lacks, up to the first that fails; return the report and its page.

    `only` names stages by their first figures, and runs these again. `rig` has the devices, by default the devices of
    the configuration. The report is written after each stage. Raises UserError if a stage cannot be measured,
    DriverError for a missing device.
    """
    if unknown := [figure for figure in only if figure not in map(stage_number, STAGES)]:
        raise UserError(f"--stages: there is no stage {', '.join(unknown)}; there are {', '.join(STAGES)}")
    settings = open_settings(config)
    if settings is None:
        raise UserError(f"{path} has no robot to commission: add `robot: ur.yaml`")
    check_apart("--out", page_path(out), [(f"the configuration {path}", path)])
    with ExitStack() as opened:
        # Before any device is asked: it may be the name of another file.
        file = opened.enter_context(ReportFile.opened(out))
        earlier = file.written
        _open_files(config)
        # A daemon would drive the robot at the same time.
        files = RobotFiles(settings.host)
        opened.enter_context(lock_robot(files, gripper=config.gripper_address))
        left = LeftRobot.acknowledged(config, files, operator)
        devices = rig or ConnectedRig(config, settings)
        controller = devices.controller()
        if config.emulated and (reason := why_not_emulated(settings.host, controller.serial_number)):
            raise UserError(f"{reason.clause}.")
        begun = earlier.rig if earlier is not None else None
        rig_identity = identity_of(config, controller.version, controller.serial_number, begun)
        report = report_for(rig_identity, earlier, out)
        report = _without_changed(report, config, operator, only)
        context = Context(config, settings, devices, controller, operator, report, counts, opened)
        with file.saying_what_is_kept():
            return _run(context, left, file, only)


def _open_files(config: DaemonConfig) -> None:
    """Open the files that later stages need; raises UserError or DriverError for one that cannot be used."""
    calibrated_sessions(config)
    if config.load_cell is not None:
        load_cell_calibration(config.load_cell)
    if config.gripper is not None:
        gripper_calibration(config.gripper)
    if config.skin is not None:
        check_circuit(config.skin, load_calibration(config.skin.calibration))


def _without_changed(report: Report, config: DaemonConfig, operator: Operator, only: Sequence[str]) -> Report:
    """Return the report without the stages that are measured again because something that they judged has changed.

    A stage that `only` does not name stays, and the report counts for nothing until it is measured again.
    """
    for stage, differs in old_stages(report, config):
        changed = " and ".join(differs)
        if only and stage.number not in only:
            operator.say(
                f"Stage {stage.stage} judged another value of {changed}. The report raises nothing until it is "
                f"measured again: `--stages {stage.number}`."
            )
        else:
            operator.say(f"Stage {stage.stage} is measured again, because {changed} changed.")
            report = without_stage(report, stage)
    return report


def _run(context: Context, left: LeftRobot, file: ReportFile, only: Sequence[str]) -> tuple[Report, Path]:
    operator = context.operator
    if context.config.emulated:
        times = ", and its limits on times allow for a busy computer" if context.limits is EMULATED else ""
        operator.say(f"The report says EMULATED{times}.")
    name = operator.word_of("Your name:")
    for stage, measure in STAGES.items():
        number = stage_number(stage)
        done = context.report.stage(number)
        if only:
            is_due = number in only
        else:
            is_due = done is None or not done.passed
        if not is_due:
            continue
        if failed := [one for one in context.report.stages if not one.passed and one.number < number]:
            raise UserError(f"stage {failed[0].stage} failed: mend it and run it again before stage {stage}")
        operator.say(f"Stage {stage}")
        file.begin(stage, [one for one in map(stage_number, STAGES) if one in only and one >= number])
        if stage != identity.STAGE:
            # A daemon of another computer may have begun since the last stage.
            context.expect_no_other_program()
        with left.during(stage) as context.operator:
            measured = measure(context)
        result = StageResult(
            stage=stage,
            operator=name,
            date=datetime.now(UTC),
            lines=tuple(measured.lines),
            supplies=measured.supplies,
            judged_sha256s=judged_by(number, judged_sha256s(context.config)),
        )
        context.report = with_stage(context.report, result)
        # First, because the disk may be full.
        for line in result.lines:
            limit = f" (limit: {line.limit})" if line.limit else ""
            operator.say(f"{line.verdict:<6} {line.what}: {line.value}{limit}")
        file.save(context.report, not_measured(context.report))
        if not result.passed:
            operator.say(f"Stage {stage} failed: mend the cause, and run the commissioning again.")
            break
    page = file.save(context.report, not_measured(context.report))
    return context.report, page


def not_measured(report: Report) -> list[str]:
    """Return the stages that a report lacks."""
    return [stage for stage in STAGES if report.stage(stage_number(stage)) is None]
