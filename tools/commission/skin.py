"""Stage 6, the shear skin: rate, noise and faults of its gauges, their order, and their change under a press."""

import statistics
from collections.abc import Sequence
from typing import Final

from shearloop.daemon.commissioning_report import Line
from shearloop.daemon.sensing.skin_estimator import MAX_DEVIATION, MAX_NOISE, are_exchanged
from shearloop.drivers.shear_skin.skin import MAX_CHANGE, STUCK_AFTER, SkinFault, SkinSample
from shearloop.estimation.skin.calibration import SkinCalibration
from shearloop.estimation.skin.membrane import Direction
from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.limits import REAL
from shearloop.tools.commission.listening import SILENT_S
from shearloop.tools.commission.report import judged
from shearloop.tools.commission.tap import RISE_S, resistances

# In messages and lines.
SKIN: Final = "the skin"
# Enough for the driver to find a converter that stands still.
_READINGS: Final = STUCK_AFTER + 10
_NO_SOURCE: Final = {SkinFault.SOURCE_STARTING, SkinFault.SOURCE_LOST}


def read_at_rest(skin: Arrivals[SkinSample], rate_hz: float) -> list[SkinSample]:
    """Return readings of a skin that nothing touches, once its current source answers; UserError if it is silent."""
    skin.wait_for(lambda sample: not _NO_SOURCE.intersection(sample.faults), 0, SILENT_S)
    return skin.take(_READINGS, SILENT_S + 1.0 / rate_hz)


def largest_shear_n(calibration: SkinCalibration, normal_n: float) -> float:
    """Return the largest shear force within the calibrated curve that the driver takes for no disturbance."""
    changes = MAX_CHANGE, -MAX_CHANGE
    return max(abs(calibration.band(change, normal_n, Direction.UNKNOWN).shear_n) for change in changes)


def why_not_timed(readings: Sequence[SkinSample], rate_hz: float, clocks_s: float = REAL.clocks_s) -> str:
    """Return why a skin with such readings at rest does not show the moment of a press; empty where it does."""
    if any(reading.faults for reading in readings):
        return "the skin has a fault"
    if 0.5 / rate_hz > clocks_s:
        return f"readings {1.0 / rate_hz:.2g} s apart do not show a moment to {1e3 * clocks_s:g} ms"
    return ""


def judge_skin(
    readings: Sequence[SkinSample], rate_hz: float, calibration: SkinCalibration, tolerance: float = REAL.rate_tolerance
) -> list[Line]:
    """Return the lines on a skin that nothing touches."""
    rate = (len(readings) - 1) / ((readings[-1].t_arrival_ns - readings[0].t_arrival_ns) / 1e9) / rate_hz
    faults = dict.fromkeys(str(fault) for reading in readings for fault in reading.faults)
    lines = [
        judged(
            "rate of the skin",
            f"{rate:.3f} of the configured one",
            f"1 ± {tolerance:g}",
            "skin.daq.rate_hz is right",
            passed=abs(rate - 1.0) <= tolerance,
            count=len(readings),
        ),
        judged(
            "faults of the skin",
            "; ".join(faults) or "none",
            "none",
            "both gauges are measured",
            passed=not faults,
            count=len(readings),
        ),
    ]
    measured = resistances(readings)
    if len(measured) < 2:
        why = "not measured: no reading is without a fault"
        return [*lines, Line(what="noise of the skin's gauges", value=why), Line(what=_ORDER, value=why)]
    gauges = [[pair[gauge] for _, pair in measured] for gauge in (0, 1)]
    return [
        *lines,
        *(_noise(gauge, ohms) for gauge, ohms in enumerate(gauges, start=1)),
        _order(calibration.rest_ohm, (statistics.fmean(gauges[0]), statistics.fmean(gauges[1])), len(measured)),
    ]


def _noise(gauge: int, ohms: Sequence[float]) -> Line:
    noise = statistics.stdev(ohms) / statistics.fmean(ohms)
    return judged(
        f"noise of the skin's gauge {gauge}",
        f"{100 * noise:.3f} % of its resistance",
        f"at most {100 * MAX_NOISE:g} %",
        "a zero can be taken",
        passed=noise <= MAX_NOISE,
        count=len(ohms),
    )


_ORDER: Final = "order of the skin's gauges"


def _order(rest_ohm: tuple[float, float], found_ohm: tuple[float, float], count: int) -> Line:
    """Return the line on gauges whose wires may be swapped. Which way a press stretches them depends on the hand."""
    calibrated = f"{rest_ohm[0]:.2f} and {rest_ohm[1]:.2f} Ω"
    if not are_exchanged(rest_ohm, rest_ohm[1], rest_ohm[0]):
        return Line(
            what=_ORDER, value=f"not measured: the calibration's {calibrated} are too similar to tell them apart"
        )
    return judged(
        _ORDER,
        f"{found_ohm[0]:.2f} and {found_ohm[1]:.2f} Ω",
        f"not the calibration's {calibrated}, exchanged",
        "a shear force has its sign",
        passed=not are_exchanged(rest_ohm, *found_ohm),
        count=count,
    )


def judge_pressed(readings: Sequence[SkinSample], at_s: float, calibration: SkinCalibration) -> Line:
    """Return the line on the change of both gauges by a press: a gauge that does not change fails it."""
    changes = []
    for gauge in (0, 1):
        before, after = (
            statistics.fmean(
                pair[gauge] for t_ns, pair in resistances(readings) if way * (t_ns / 1e9 - at_s) > 0.5 * RISE_S
            )
            for way in (-1.0, 1.0)
        )
        changes.append(after / before - 1.0)
    return judged(
        "skin's gauges under the press",
        f"gauge 1 {100 * changes[0]:+.1f} %, gauge 2 {100 * changes[1]:+.1f} %",
        f"within {100 * MAX_DEVIATION:g} % of the calibrated curve",
        "the daemon accepts the readings",
        passed=abs(calibration.slack_deviation(*changes)) <= MAX_DEVIATION,
    )
