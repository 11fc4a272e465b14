"""Stage 0: which robot, which software and which settings the report is about. Nothing moves."""

import math
from dataclasses import dataclass, replace

from shearloop.daemon.commissioning_report import Line
from shearloop.daemon.config import DaemonConfig, SerialDevice
from shearloop.drivers.ranges import LARGEST_PAYLOAD_KG
from shearloop.drivers.ur.control_box import ControllerInfo, untested
from shearloop.drivers.ur.limits import PAYLOAD_KG, slowed_by, tool_difference
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.settings import InstalledTool, UrSettings
from shearloop.tools.arm_models import UNKNOWN_ARM, Arm
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged
from shearloop.tools.robot_use import Registers, program_in_words, used_registers

STAGE = "0 identity"
CHECKSUM_QUESTION = "The safety checksum, as the pendant shows it at the top right (CB3: under Safety):"
EMULATED_CHECKSUM = "0000"
SHOWN_QUESTION = "This controller does not report its payload. The payload in kg that the pendant shows"
MOUNTED_QUESTION = "The mass in kg of all that is mounted at the flange, weighed or from data sheets"
# The wrench and the protective stops of the arm depend on its payload. This is for typed values: of those that the
# controller reports, the daemon refuses motion at a smaller difference.
TYPED_TOLERANCE_KG = 0.1


@dataclass(frozen=True, slots=True)
class Identity:
    """What the robot and this computer report, and what the operator typed.

    `typed_kg` is the payload at the pendant and the mounted mass, where the controller reports no payload.
    """

    controller: ControllerInfo
    outputs: RtdeOutputs
    safety_checksum: str
    typed_kg: tuple[float, float] | None = None
    arm: Arm = UNKNOWN_ARM


def measure(context: Context) -> Measured:
    """Return the stage's lines; raises RobotLostError if the controller does not answer."""
    outputs = context.rig.outputs(context.registers)
    if (newer := untested(context.controller.version)) is not None:
        context.operator.accept(newer.sentence)
    checksum = context.operator.ask(CHECKSUM_QUESTION, Played(f"the pendant shows {EMULATED_CHECKSUM}"))
    typed_kg = None
    if math.isnan(outputs.payload_kg) and context.settings.tool.payload_kg is None:
        shown_kg = context.operator.number(SHOWN_QUESTION, 0.0, LARGEST_PAYLOAD_KG)
        typed_kg = shown_kg, context.operator.number(MOUNTED_QUESTION, 0.0, LARGEST_PAYLOAD_KG)
    found = Identity(context.controller, outputs, checksum, typed_kg, context.rig.arm())
    return Measured(judge_identity(found, context.settings, context.config))


def judge_identity(identity: Identity, settings: UrSettings, config: DaemonConfig) -> tuple[Line, ...]:
    """Return the stage's lines: versions and modes are known, payload and tool centre point are as in the settings."""
    outputs, tool, seen = identity.outputs, settings.tool, identity.controller
    major = int(seen.version.split(".", maxsplit=1)[0])
    slowed = slowed_by(outputs)
    lines = [
        _polyscope(seen.version),
        judged(
            "generation",
            f"PolyScope {major}",
            settings.facts.name,
            "limits of force and torque fit the arm",
            passed=major == settings.facts.major,
        ),
        judged("robot mode", seen.robot_mode, "RUNNING", "ready to move", passed=seen.robot_mode == "RUNNING"),
        judged("safety mode", seen.safety_mode, "NORMAL", "ready to move", passed=seen.safety_mode == "NORMAL"),
        *_other_programs(seen, outputs),
        judged(
            "speed slider",
            slowed.sentence if slowed else f"{outputs.speed_slider:.0%}",
            "100%",
            "the loop's gain",
            passed=not slowed,
        ),
        _payload(identity, tool.payload_kg, emulated=config.emulated),
        *_rated(identity, tool.payload_kg),
        judged(
            "safety checksum",
            identity.safety_checksum or "not given",
            "typed from the pendant",
            "the rated limits are known",
            passed=bool(identity.safety_checksum),
        ),
        _tool_centre(outputs, tool),
    ]
    lines += [
        Line(what=f"serial number of {key}", value=section.serial_number)
        for key, section in config.walk()
        if isinstance(section, SerialDevice) and section.serial_number is not None
    ]
    return tuple(lines)


def _other_programs(seen: ControllerInfo, outputs: RtdeOutputs) -> list[Line]:
    """Return the lines on other programs. Where some registers are left, the operator is asked before stage 1."""
    registers, program = used_registers(seen), program_in_words(outputs)
    promise, free = "no other program commands the robot", Registers.FREE.value
    if registers is Registers.UPPER_IN_USE:
        value = f"{registers.value}: another program may command the robot"
        lines = [Line(what="registers", value=value, limit=free)]
    else:
        lines = [judged("registers", registers.value, free, promise, passed=registers is Registers.FREE)]
    if program:
        lines.append(Line(what="program on the robot", value=f"{program}, and not of the commissioning", limit="none"))
    else:
        lines.append(judged("program on the robot", "none", "none", promise, passed=True))
    return lines


def _polyscope(version: str) -> Line:
    """Return the line on the version; a newer one than the tested ones is noted, after the operator went on with it."""
    if (newer := untested(version)) is not None:
        return Line(what="PolyScope", value=f"{newer.sentence} The operator went on with it.")
    return judged("PolyScope", version, "a version that ur-rtde is tested on", "known versions", passed=True)


def _payload(identity: Identity, wanted_kg: float | None, *, emulated: bool) -> Line:
    """Return the line on the payload: within the daemon's own tolerance, else the daemon refuses every motion."""
    set_kg, promise = identity.outputs.payload_kg, "forces and protective stops fit the load"
    if math.isnan(set_kg):
        return _unreported_payload(identity.typed_kg, wanted_kg, promise)
    value = f"{set_kg:.3f} kg"
    if wanted_kg is None and emulated:
        # A real robot does not run before it is filled in.
        return Line(what="payload", value=f"{value}, not compared: `tool` is not in the robot's settings")
    if wanted_kg is None:
        limit = "`tool.payload_kg` of the robot's settings, which is absent"
        return judged("payload", value, limit, promise, passed=False)
    limit = f"{wanted_kg:g} ± {PAYLOAD_KG:g} kg; else the daemon refuses motion"
    differs = tool_difference(identity.outputs, InstalledTool(payload_kg=wanted_kg))
    return judged("payload", value, limit, promise, passed=not differs)


def _rated(identity: Identity, wanted_kg: float | None) -> list[Line]:
    """Return the line on the arm's rated payload, or none where the arm's model is not known."""
    arm, typed_kg = identity.arm, identity.typed_kg or ()
    if not arm.rated_kg:
        return []
    given_kg = (identity.outputs.payload_kg, wanted_kg, *typed_kg)
    beyond_kg = next(filter(arm.is_beyond, given_kg), None)
    unsure_kg = next(filter(arm.may_be_beyond, given_kg), None)
    what, limit = "rated payload", f"at most {arm.rated}, the rated payload of a {arm.model}"
    if beyond_kg is None and unsure_kg is not None:
        value = f"{unsure_kg:g} kg: read on the arm's type plate whether it is rated for it"
        return [Line(what=what, value=value, limit=limit)]
    value = "not exceeded" if beyond_kg is None else f"{beyond_kg:g} kg"
    return [judged(what, value, limit, "the arm can hold its load", passed=beyond_kg is None)]


def _unreported_payload(typed_kg: tuple[float, float] | None, wanted_kg: float | None, promise: str) -> Line:
    if wanted_kg is not None or typed_kg is None:
        value = "not reported: PolyScope has it from 3.12 and 5.5.1 on"
        limit = "`tool: {reported: false}` in the robot's settings: else the daemon refuses motion on this controller"
        return judged("payload", value, limit, promise, passed=False)
    shown_kg, mounted_kg = typed_kg
    limit = f"the mounted mass, {mounted_kg:g} ± {TYPED_TOLERANCE_KG:g} kg; both typed by the operator"
    # The sum keeps a payload at the edge inside.
    passed = abs(shown_kg - mounted_kg) <= TYPED_TOLERANCE_KG + 1e-9
    return judged("payload", f"{shown_kg:.3f} kg, typed from the pendant", limit, promise, passed=passed)


def _tool_centre(outputs: RtdeOutputs, tool: InstalledTool) -> Line:
    """Return the line on the tool centre point and the centre of gravity, which the daemon compares if they are set."""
    what, value = "tool centre point", " ".join(f"{value:.4g}" for value in outputs.tcp_offset)
    compared = replace(tool, payload_kg=None)
    if compared in (InstalledTool(), InstalledTool(reported=False)):
        return Line(what=what, value=value)
    differs = tool_difference(outputs, compared)
    limit = "as in the robot's settings; else the daemon refuses motion"
    return judged(what, differs.sentence if differs else value, limit, "positions are of the tool", passed=not differs)
