"""Stage 0: which robot, which software and which settings the report is about. Nothing moves."""

import math
from dataclasses import dataclass

from shearloop.daemon.commissioning import Line
from shearloop.daemon.config import DaemonConfig, SerialDevice
from shearloop.drivers.ur.control_box import ControllerInfo, untested_sentence
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.settings import UrSettings
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged

STAGE = "0 identity"
CHECKSUM_QUESTION = "The safety checksum, as the pendant shows it at the top right (CB3: under Safety):"
EMULATED_CHECKSUM = "0000"
# The wrench and the protective stops of the arm depend on its payload.
PAYLOAD_TOLERANCE_KG = 0.1


@dataclass(frozen=True, slots=True)
class Identity:
    """What the robot and this computer report, and what the operator read from the pendant."""

    controller: ControllerInfo
    outputs: RtdeOutputs
    safety_checksum: str


def measure(context: Context) -> Measured:
    """Return the stage's lines; raises RobotLostError if the controller does not answer."""
    checksum = context.operator.ask(CHECKSUM_QUESTION, Played(f"the pendant shows {EMULATED_CHECKSUM}"))
    found = Identity(context.controller, context.rig.outputs(context.registers), checksum)
    return Measured(judge_identity(found, context.settings, context.config))


def judge_identity(identity: Identity, settings: UrSettings, config: DaemonConfig) -> tuple[Line, ...]:
    """Return the stage's lines: versions and modes are known, payload and tool centre point are as in the settings."""
    outputs, tool, seen = identity.outputs, settings.tool, identity.controller
    untested = untested_sentence(seen.version)
    major = int(seen.version.split(".", maxsplit=1)[0])
    slider = outputs.speed_slider
    lines = [
        judged("PolyScope", seen.version, "a version that ur-rtde is tested on", "known versions", passed=not untested),
        judged(
            "generation",
            f"PolyScope {major}",
            settings.facts.name,
            "limits of force and torque fit the arm",
            passed=major == settings.facts.major,
        ),
        judged("robot mode", seen.robot_mode, "RUNNING", "ready to move", passed=seen.robot_mode == "RUNNING"),
        judged("safety mode", seen.safety_mode, "NORMAL", "ready to move", passed=seen.safety_mode == "NORMAL"),
        judged(
            "registers",
            "free" if seen.registers is not None else "in use",
            "free",
            "nobody else commands the robot",
            passed=seen.registers is not None,
        ),
        judged(
            "speed slider", f"{slider:.0%}", "100%", "the loop's gain", passed=math.isclose(slider, 1.0, abs_tol=1e-6)
        ),
        _payload(outputs.payload_kg, tool.payload_kg),
        judged(
            "safety checksum",
            identity.safety_checksum or "not given",
            "typed from the pendant",
            "the rated limits are known",
            passed=bool(identity.safety_checksum),
        ),
        Line(what="tool centre point", value=" ".join(f"{value:.4g}" for value in outputs.tcp_offset)),
    ]
    lines += [
        Line(what=f"serial number of {key}", value=section.serial_number)
        for key, section in config.walk()
        if isinstance(section, SerialDevice) and section.serial_number is not None
    ]
    return tuple(lines)


def _payload(set_kg: float, wanted_kg: float | None) -> Line:
    value = "not reported" if math.isnan(set_kg) else f"{set_kg:.3f} kg"
    if wanted_kg is None:
        limit = "`tool.payload_kg` of the robot's settings, which is absent"
        return judged("payload", value, limit, "payload", passed=False)
    limit = f"{wanted_kg:g} ± {PAYLOAD_TOLERANCE_KG:g} kg"
    # The sum keeps a payload at the edge inside.
    return judged("payload", value, limit, "payload", passed=abs(set_kg - wanted_kg) <= PAYLOAD_TOLERANCE_KG + 1e-9)
