"""The question before a start: what moves, and what happens to a held tool.

Nothing moves while the question is open, so its modules are loaded then.
"""

from dataclasses import replace

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_schema import ExperimentFile, TareStep
from shearloop.daemon.control.known_tool import UNKNOWN
from shearloop.daemon.control.operator_view import OperatorView, clamped_turn, release_stakes
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.sensor_reach import tool_note
from shearloop.daemon.control.step_motions import first_grip, first_gripper_step, first_motion_before_grip
from shearloop.daemon.experiment_files import ExperimentFiles, ReadExperiment
from shearloop.daemon.questions import Question, digest_of


def question_of(experiment: ReadExperiment, files: ExperimentFiles, loop: ControlLoop, *occasion: str) -> Question:
    """Return the question before the start of an experiment; `files` know its rig.

    `occasion` changes with each process, stop and run.
    """
    file, operator = experiment.file, loop.operator
    limits = files.robot.settings.limits if files.robot is not None else None
    start, speeds, gripper = operator.known_tool(), files.config.loop, files.config.gripper_model
    plan = plan_of(file, limits, gripper, warm_up_s=loop.warm_up_s, start=start, loop=speeds)
    # The wrist's angle wavers: of it, nothing is confirmed.
    start = replace(start, wrist_rad=UNKNOWN)
    confirmed = plan_of(file, limits, gripper, warm_up_s=loop.warm_up_s, start=start, loop=speeds)
    motion, note = plan.first_motion, activation_note(operator, file)
    text, sentences = f"Start {file.name!r}? {motion[0].upper()}{motion[1:]}.{note}", tuple(plan.sentences())
    rests_on = tool_note(file, files.config, files.sources, files.robot)
    if rests_on:
        sentences = (*sentences, f"  {rests_on}")
    held = release_stakes(operator) if operator.tool.may_hold() else ()
    # The question depends on the gripper's state and on the tool in it, and the plan on the rig's limits.
    said = (confirmed.first_motion, note, *confirmed.sentences(), rests_on)
    digest = digest_of(experiment.data, *said, *occasion, *held)
    # The width in this note wavers.
    return Question(text + held_note(operator, file), digest, sentences)


def activation_note(operator: OperatorView, file: ExperimentFile) -> str:
    """Return a sentence on the activation before the first step with the gripper; empty without one."""
    first = first_gripper_step(file)
    if first is None or not operator.tool.activates or not operator.tool.may_hold():
        return ""
    number, _ = first
    return f" Before step {number} the gripper is activated: its fingers open and close once, and a tool drops."


def held_note(operator: OperatorView, file: ExperimentFile) -> str:
    """Return a sentence on the held tool; empty if no step turns it or lets it go."""
    tool = operator.tool
    if not tool.has_gripper:
        turned = clamped_turn(operator)
        from_zero = "if another tool is clamped, `shearloop command release --yes` lets its angle count from 0"
        return f" At present the clamped tool's angle continues: {turned}; {from_zero}." if turned else ""
    drops, unknown = operator.drop_sentence(file), tool.unknown_grip
    present = f" {drops[0].upper()}{drops[1:]}." if drops else f" At present {tool.held}."
    # A `grip` only closes tighter on the held tool, so the angle stays unknown.
    tightens_unknown = bool(unknown) and first_grip(file) is not None
    turns = tightens_unknown or first_motion_before_grip(file) is not None
    if tool.held is None or not turns:
        return present if drops else ""
    angle = f" The grip is not known ({unknown}): its angle counts from the start." if unknown else ""
    stated = tool.why_not_stated(file.tool_mm)
    return f"{present}{angle}{f' But {stated}.' if stated else ''}"


def file_refusal(operator: OperatorView, file: ExperimentFile) -> str | None:
    """Return why this experiment cannot begin with the present tool and zeros, or None."""
    if (reason := operator.why_not_begun(file)) is not None:
        return reason
    if isinstance(file.steps[0], TareStep) and (reason := operator.why_no_tare_step()) is not None:
        return f"step 1 (tare): {reason}"
    return None
