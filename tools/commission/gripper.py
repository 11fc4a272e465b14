"""Stage 2: the gripper: activation, the time of an exchange, a table of widths, and the detection of objects."""

from collections.abc import Sequence
from typing import Final

from shearloop.daemon.commissioning_report import Line
from shearloop.daemon.config import GripperConfig
from shearloop.daemon.supplied_values import Supplied
from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.drivers.robotiq.gripper import ACTIVATION_DEADLINE_NS, PAUSE_NS, RESET_DEADLINE_NS
from shearloop.drivers.robotiq.messages import GripperState
from shearloop.drivers.robotiq.models import MODELS, ModelName
from shearloop.drivers.robotiq.width_fit import fit_width
from shearloop.tools.commission.context import Context
from shearloop.tools.commission.fingers import FINGERS_MM_PER_S, GENTLE_N, Gripper, close_fingers, open_fingers
from shearloop.tools.commission.operator import Played
from shearloop.tools.commission.report import Measured, judged, percentile_99

STAGE: Final = "2 gripper"
WIDTH_MM: Final = 1.0
# Any two widths lie on a line.
MIN_WIDTHS: Final = 3
# The driver gives up then: a reset, its pause, and twice the stroke.
LONGEST_ACTIVATION_S: Final = (RESET_DEADLINE_NS + PAUSE_NS + ACTIVATION_DEADLINE_NS) / 1e9
# Emulated objects, as fractions of the stroke.
_OBJECTS: Final = (0.05, 0.6, 0.25, 0.4)


def measure(context: Context) -> Measured:
    """Return the stage's lines and the table of widths."""
    config = context.config.gripper
    if config is None:
        return Measured([Line(what="gripper", value="none is configured")])
    model = MODELS[config.model]
    context.operator.allow(
        f"the gripper is activated, also where it is active already: its fingers open and close once over the whole "
        f"stroke of {model.stroke_mm:g} mm, at a speed of their own of up to {model.speed_mm_per_s.high:g} mm/s; "
        "nothing is between them"
    )
    with context.gripper() as gripper:
        lines = [_activation(context, gripper), _exchanges(context, gripper)]
        width_line, supplies = judge_widths(measured_gauges(context, gripper), config)
        return Measured([*lines, width_line, *_objects(context, gripper)], supplies)


def _activation(context: Context, gripper: Gripper) -> Line:
    """Activate the gripper, and return the line on the time that it took."""
    begun_ns = context.clock.now_ns()
    gripper.activate(operator_confirmed=True)
    time_s = (context.clock.now_ns() - begun_ns) / 1e9
    return judged(
        "activation",
        f"{time_s:.1f} s, with the reset before it",
        f"at most {LONGEST_ACTIVATION_S:g} s",
        "the gripper is ready after a start",
        passed=time_s <= LONGEST_ACTIVATION_S,
    )


def _exchanges(context: Context, gripper: Gripper) -> Line:
    """Return the line on the time of an exchange, as the daemon has it ten times a second."""
    times_s = []
    for _ in range(context.counts.exchanges):
        begun_ns = context.clock.now_ns()
        gripper.poll()
        times_s.append((context.clock.now_ns() - begun_ns) / 1e9)
    return judge_exchanges(times_s, context.limits.longest_exchange_s)


def judge_exchanges(times_s: Sequence[float], longest_s: float) -> Line:
    """Return the line on the times of exchanges."""
    p99_s = percentile_99(times_s)
    return judged(
        "exchange with the gripper, p99",
        f"{1e3 * p99_s:.1f} ms",
        f"below {1e3 * longest_s:g} ms",
        "its state is younger than 0.25 s",
        passed=p99_s < longest_s,
        count=len(times_s),
    )


def measured_gauges(context: Context, gripper: Gripper) -> list[tuple[float, float]]:
    """Return (counts, mm) of gauges that the gripper held."""
    gauges: list[tuple[float, float]] = []
    for number in range(1, context.counts.gauges + 1):
        question = f"Hold gauge {number} of {context.counts.gauges} between the fingers; its width in mm"
        for_instance_mm = gripper.model.stroke_mm * (number - 0.5) / context.counts.gauges
        played = Played(
            f"a gauge as wide as you type is held for you, for instance {for_instance_mm:g}", ("object {}",)
        )
        width_mm = context.operator.number(question, 0.5, gripper.model.stroke_mm, played)
        if width_mm in [measured_mm for _, measured_mm in gauges]:
            context.operator.say(
                f"A gauge of {width_mm:g} mm was measured already: hold one of another width, or type {width_mm:g} "
                "again to measure it a second time."
            )
            width_mm = context.operator.number(question, 0.5, gripper.model.stroke_mm, played)
        state = _close_and_open(context, gripper, f"gauge {number}")
        gauges.append((float(state.position_counts), width_mm))
    return gauges


def _close_and_open(context: Context, gripper: Gripper, what: str) -> GripperState:
    """Close onto something, open again, and return the closed gripper's state."""
    context.operator.allow(
        f"the fingers close at {FINGERS_MM_PER_S:g} mm/s with at most {GENTLE_N:g} N onto {what}, then open"
    )
    closed = close_fingers(gripper)
    open_fingers(gripper)
    return closed


def judge_widths(gauges: Sequence[tuple[float, float]], config: GripperConfig) -> tuple[Line, Supplied]:
    """Return the line on a table of widths through gauges, and the table."""
    limit, promise = f"± {WIDTH_MM:g} mm", "diameters are right"
    if len({width_mm for _, width_mm in gauges}) < MIN_WIDTHS:
        few = f"fewer than {MIN_WIDTHS} different widths, which no other width confirms: run the stage again"
        return judged("widths", few, limit, promise, passed=False, count=len(gauges)), Supplied()
    try:
        errors_mm = [_error_mm(gauge, gauges, config.model) for gauge in gauges]
    except DeviceCalibrationError as error:
        return judged("widths", str(error), limit, promise, passed=False, count=len(gauges)), Supplied()
    passed = max(errors_mm) <= WIDTH_MM
    value = f"{max(errors_mm):.2f} mm off, each gauge between two others by the table of those"
    line = judged("widths", value, limit, promise, passed=passed, count=len(gauges))
    return line, Supplied(widths=tuple(gauges)) if passed else Supplied()


def _error_mm(gauge: tuple[float, float], gauges: Sequence[tuple[float, float]], model: ModelName) -> float:
    """Return the error at a gauge of the table of all other widths, or of all where it is the narrowest or widest.

    A table of other widths says what happens at a tool that no gauge was like. Outside its gauges a table is a guess.
    Raises DeviceCalibrationError where no table goes through the gauges.
    """
    counts, width_mm = gauge
    others = [other for other in gauges if other[1] != width_mm]
    widths_mm = [width_mm for _, width_mm in gauges]
    between = min(widths_mm) < width_mm < max(widths_mm)
    table = fit_width(others if between else gauges, model)
    return abs(table.width_mm(counts) - width_mm)


def _objects(context: Context, gripper: Gripper) -> list[Line]:
    """Return the lines on objects that are held, and on nothing that is held."""
    count, seen = context.counts.objects, 0
    for number in range(1, count + 1):
        width_mm = gripper.model.stroke_mm * _OBJECTS[(number - 1) % len(_OBJECTS)]
        context.operator.act(
            f"Hold object {number} of {count} between the fingers: a thin, a thick, a soft, a hard one",
            Played(f"a hard object of {width_mm:g} mm is held for you", (f"object {width_mm:g}",)),
        )
        seen += _close_and_open(context, gripper, f"object {number}").diameter_mm is not None
    context.operator.act("Take everything out of the gripper", Played("it is taken out for you", ("object none",)))
    empty = _close_and_open(context, gripper, "nothing").diameter_mm is None
    return [
        judged(
            "objects that are detected",
            f"{seen} of {count}",
            "all",
            "a dropped tool stops the experiment",
            passed=seen == count,
            count=count,
        ),
        judged(
            "no object",
            "detected as none" if empty else "an object is reported",
            "none",
            "a grip of nothing is an error",
            passed=empty,
        ),
    ]
