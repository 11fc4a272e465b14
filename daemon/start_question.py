"""The question before a start: the first motion, what happens to a held tool, and the plan.

Nothing moves while somebody asks, so its modules are loaded then.
"""

from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.operator_view import OperatorView
from shearloop.daemon.control.plan import plan_of
from shearloop.daemon.control.step_motions import first_grip, first_gripper_step, first_motion_before_grip
from shearloop.daemon.experiment_files import ExperimentFiles, ReadExperiment
from shearloop.daemon.questions import Question, digest_of


def question_of(
    experiment: ReadExperiment, files: ExperimentFiles, operator: OperatorView, warm_up_s: float, *occasion: str
) -> Question:
    """Return the question before the start of an experiment; `files` know its rig.

    `warm_up_s` passes after a grip until the first torque. `occasion` changes with each process, stop and run.
    """
    file = experiment.file
    limits = files.robot.settings.limits if files.robot is not None else None
    start, loop = operator.known_at_start(), files.config.loop
    plan = plan_of(file, limits, files.gripper, warm_up_s=warm_up_s, start=start, loop=loop)
    motion, note = plan.first_motion, activation_note(operator, file)
    text, sentences = f"Start {file.name!r}? {motion[0].upper()}{motion[1:]}.{note}", tuple(plan.sentences())
    if tool_note := files.tool_note(file):
        sentences = (*sentences, f"  {tool_note}")
    held = operator.release_stakes() if operator.tool.may_hold() else ()
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
        turned = operator.clamped_turn()
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
