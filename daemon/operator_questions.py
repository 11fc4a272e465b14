"""The questions before a start, a release and an unlock: what moves, and what happens to a held tool.

Nothing moves while a question is open, so its modules are loaded then.
"""

from pathlib import Path

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_schema import ExperimentFile, TareStep
from shearloop.daemon.control.known_tool import KnownTool, known_at_start
from shearloop.daemon.control.operator_view import OperatorView, activation_sentence
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.sensor_reach import tool_note
from shearloop.daemon.control.step_motions import first_grip, first_gripper_step, first_motion_before_grip
from shearloop.daemon.experiment_files import ExperimentFiles, ReadExperiment
from shearloop.daemon.questions import Question, digest_of
from shearloop.errors import UserError


async def startable(path: Path, files: ExperimentFiles, operator: OperatorView) -> ReadExperiment:
    """Return the experiment of a file; raises UserError if it is not valid, or cannot begin with the present tool."""
    experiment = await files.read(path)
    if (reason := file_refusal(operator, experiment.file)) is not None:
        raise UserError(reason)
    return experiment


def question_of(experiment: ReadExperiment, files: ExperimentFiles, loop: ControlLoop, *occasion: str) -> Question:
    """Return the question before the start of an experiment; `files` know its rig.

    `occasion` changes with each process, stop and run.
    """
    file, operator = experiment.file, loop.operator
    limits = files.robot.settings.limits if files.robot is not None else None
    start, speeds = start_of(operator), files.config.loop
    plan = plan_of(file, limits, files.config.gripper_model, warm_up_s=loop.warm_up_s, start=start, loop=speeds)
    motion, note = plan.first_motion, activation_note(operator, file)
    text, sentences = f"Start {file.name!r}? {motion[0].upper()}{motion[1:]}.{note}", tuple(plan.sentences())
    if rests_on := tool_note(file, files.config, files.sources, files.robot):
        sentences = (*sentences, f"  {rests_on}")
    held = release_stakes(operator) if operator.tool.may_hold() else ()
    # The question depends on the gripper's state and on the tool in it, and the plan on the rig's limits.
    digest = digest_of(experiment.data, text, *sentences, *occasion, *held)
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
        turned = _clamped_turn(operator)
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
    if (reason := operator.why_not_with_tool(file)) is not None:
        return reason
    if isinstance(file.steps[0], TareStep) and (reason := operator.why_no_tare_step()) is not None:
        return f"step 1 (tare): {reason}"
    return None


def start_of(operator: OperatorView) -> KnownTool:
    """Return the known angle and torque of the tool at a start."""
    return known_at_start(loaded=operator.tool.may_be_loaded(), twisted_rad=operator.tool.twisted_rad)


def release_question(operator: OperatorView) -> str:
    """Return what a release would do, for the operator who confirms it."""
    if not operator.tool.has_gripper:
        present = f"at present {turned}" if (turned := _clamped_turn(operator)) else "no angle counts at present"
        from_zero = "the angle of the clamped tool counts from 0 at the next start"
        return f"nothing opens, because no gripper is configured; {from_zero}; {present}"
    gripper = operator.inputs.gripper
    apart = f"its fingers are {gripper.width_mm:.0f} mm apart" if gripper is not None else "its width is unknown"
    what = operator.tool.held or f"the gripper reports no object, and {apart}"
    renewed = "; it is activated first: the fingers open and close once" if operator.tool.activates else ""
    return f"the gripper opens fully, and a tool in it drops; {what}{renewed}"


def unlock_question(operator: OperatorView) -> str:
    """Return what an unlock would drop, for the operator who confirms it; empty if it drops no tool."""
    gripper = operator.inputs.gripper
    if gripper is None or not gripper.fault or not operator.tool.may_hold():
        return ""
    may_hold = f"its fingers are {gripper.width_mm:.1f} mm apart, and may hold a tool"
    return activation_sentence(operator.tool.held or may_hold)


def release_stakes(operator: OperatorView) -> tuple[str, ...]:
    """Return the facts that a confirmation of `release_question` covers; the width varies and is none of them."""
    held = "held" if operator.tool.held is not None else "nothing held"
    renewed = "renewed" if operator.tool.activates else "as it is"
    # An exchanged tool shows as another request, or as another angle.
    gripper, grip = operator.inputs.gripper, operator.tool.grip
    requests = f"{gripper.requested_counts}, {gripper.others_requests} of others" if gripper is not None else "none"
    return held, renewed, requests, f"{grip.force_n} N from {grip.origin_rad} rad"


def _clamped_turn(operator: OperatorView) -> str:
    """Return how far a clamped tool is turned, as a sentence; empty if no angle counts."""
    arm, origin_rad = operator.inputs.arm, operator.tool.grip.origin_rad
    if arm is None or origin_rad is None:
        return ""
    return f"it is turned by {arm.wrist_rad - origin_rad:+.3f} rad"
