"""Stage 0: which robot, which software and which settings the report is about. Nothing moves."""

import math
from dataclasses import dataclass
from importlib import metadata

from shearloop.daemon.config import DaemonConfig, SerialDevice
from shearloop.drivers.ur.control_box import RtdeReceiver, query_controller, untested_sentence
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.script import UPPER
from shearloop.drivers.ur.settings import UrSettings
from shearloop.tools.commission.report import Line, Verdict

STAGE = "0 identity"
CHECKSUM_QUESTION = "The safety checksum, as the pendant shows it at the top right (CB3: under Safety):"
# The wrench and the protective stops of the arm depend on its payload.
PAYLOAD_TOLERANCE_KG = 0.1


@dataclass(frozen=True, slots=True)
class Identity:
    """What the robot and this computer report, and what the operator read from the pendant."""

    polyscope: str
    robot_mode: str
    safety_mode: str
    outputs: RtdeOutputs
    ur_rtde: str
    safety_checksum: str


def read_identity(settings: UrSettings, safety_checksum: str) -> Identity:
    """Ask the controller; raises RobotLostError if it does not answer."""
    seen = query_controller(settings.host, settings.connect_timeout_s)
    registers = seen.registers or UPPER
    receiver = RtdeReceiver(settings.host, settings.rate_hz, settings.connect_timeout_s, registers)
    try:
        outputs = receiver.latest()
    finally:
        receiver.close()
    try:
        ur_rtde = metadata.version("ur-rtde")
    except metadata.PackageNotFoundError:
        ur_rtde = "not installed"
    return Identity(seen.version, seen.robot_mode, seen.safety_mode, outputs, ur_rtde, safety_checksum)


def judge_identity(identity: Identity, settings: UrSettings, config: DaemonConfig) -> tuple[Line, ...]:
    """Return the stage's lines: versions and modes are known, payload and tool centre point are as in the settings."""
    outputs, tool = identity.outputs, settings.tool
    untested = untested_sentence(identity.polyscope)
    lines = [
        _judged("PolyScope", identity.polyscope, "a version that ur-rtde is tested on", not untested, "known versions"),
        _judged(
            "generation",
            f"PolyScope {identity.polyscope.split('.', maxsplit=1)[0]}",
            settings.facts.name,
            int(identity.polyscope.split(".", maxsplit=1)[0]) == settings.facts.major,
            "limits of force and torque fit the arm",
        ),
        Line(what="ur-rtde", value=identity.ur_rtde),
        _judged("robot mode", identity.robot_mode, "RUNNING", identity.robot_mode == "RUNNING", "ready to move"),
        _judged("safety mode", identity.safety_mode, "NORMAL", identity.safety_mode == "NORMAL", "ready to move"),
        _judged(
            "speed slider",
            f"{outputs.speed_slider:.0%}",
            "100%",
            math.isclose(outputs.speed_slider, 1.0, abs_tol=1e-6),
            "the loop's gain",
        ),
        _payload(outputs.payload_kg, tool.payload_kg),
        _judged(
            "safety checksum",
            identity.safety_checksum or "not given",
            "typed from the pendant",
            bool(identity.safety_checksum),
            "the rated limits are known",
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
        return _judged("payload", value, "`tool.payload_kg` of the robot's settings, which is absent", False, "payload")
    limit = f"{wanted_kg:g} ± {PAYLOAD_TOLERANCE_KG:g} kg"
    # The sum keeps a payload at the edge inside.
    return _judged("payload", value, limit, abs(set_kg - wanted_kg) <= PAYLOAD_TOLERANCE_KG + 1e-9, "payload")


def _judged(what: str, value: str, limit: str, passed: bool, promise: str) -> Line:
    verdict: Verdict = "passed" if passed else "failed"
    return Line(what=what, value=value, limit=limit, promise=promise, verdict=verdict)
