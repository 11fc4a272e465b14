"""A skin's figures of merit by the paper's definitions: one table, and the curves of its figures.

Responses follow equation (1), forces are in N. Noise and drift are properties of a made skin: no model gives them.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit
from scipy.stats import linregress

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.membrane import (
    EXCITATION_A,
    GAUGE_RESISTANCE_OHM,
    PAPER_SECTION,
    THICK_SECTION,
    UNSTRETCHED,
    Membrane,
    joule_heating_k,
    warming_change,
)
from shearloop.estimation.skin.plane_strain import (
    CondensedSkin,
    ContactState,
    apply_load,
    condense,
    gauge_responses,
    line_strain,
    states_along,
    unloaded,
)
from shearloop.estimation.values import LEVEL
from shearloop.studies.skin.finite_strain import FiniteStrainSkin

# The paper's response is straight up to here.
PAPER_LINEAR_N = 1.2
# From 25 °C to 40 °C.
WARM_K = 15.0
# By the normal force in N.
PAPER_MEASURED_SENSITIVITY = {0.5: "0.078", 1.0: "0.076", 1.5: "0.080", 2.0: "0.080"}


def origin_slope(shear_n: FloatArray, response: FloatArray) -> float:
    """Return Σxy/Σx², the slope in 1/N of the straight line through the origin.

    The sensitivity of the paper's table 1: over one loading from zero in equal steps up to 1.2 N, deadband included.
    It is about μ F_n Σx/Σx² smaller than the slope beyond the deadband.
    """
    return float(shear_n @ response) / float(shear_n @ shear_n)


@dataclass(frozen=True, slots=True)
class LineFit:
    """A straight calibration line, response over shear force: its slope, and the force where it crosses zero.

    prediction_half_width_n is ± the 95 % interval of a new single force read off the line near zero.
    """

    slope_per_n: float
    kink_n: float
    prediction_half_width_n: float


def fit_line(shear_n: FloatArray, response: FloatArray) -> LineFit:
    """Return the least-squares line of at least three responses."""
    line, freedom = linregress(shear_n, response), len(shear_n) - 2
    residuals = response - line.intercept - line.slope * shear_n
    scatter = np.hypot(np.sqrt(residuals @ residuals / freedom), line.intercept_stderr)
    half_width = stdtrit(freedom, (1 + LEVEL) / 2) * scatter / abs(line.slope)
    return LineFit(float(line.slope), float(-line.intercept / line.slope), float(half_width))


def loading(up_to_n: float, step_n: float = 0.1) -> FloatArray:
    """Return the paper's shear forces: from the first step to `up_to_n`, without zero."""
    return np.arange(1.0, round(up_to_n / step_n) + 1) * step_n


def loop(amplitude_n: float, step_n: float = 0.1) -> FloatArray:
    """Return a whole cycle: from the first step to the amplitude, to its negative, and back to the amplitude."""
    n = round(amplitude_n / step_n)
    return np.concatenate([np.arange(1.0, n), np.arange(n, -n, -1), np.arange(-n, n + 1)]) * step_n


def responses(membrane: Membrane, shear_n: Iterable[float], normal_n: float) -> FloatArray:
    """Return the membrane's responses along a path of shear forces, from the unstretched skin."""
    state, found = UNSTRETCHED, []
    for shear in shear_n:
        state = membrane.step(state, float(shear), normal_n)
        found.append(membrane.response(state))
    return np.array(found)


@dataclass(frozen=True, slots=True)
class FigureOfMerit:
    """One quantity: the paper's computed and measured values, as printed, and each model's."""

    quantity: str
    unit: str
    paper_computed: str = ""
    paper_measured: str = ""
    membrane: float | None = None
    two_d: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """Responses (n,) of both models along shear forces (n,) in N, and of the two-dimensional one without friction."""

    shear_n: FloatArray
    membrane: FloatArray
    two_d: FloatArray
    two_d_slippery: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Characterisation:
    """The table, and the data of figures 4 to 8.

    `strain_maps` are places (2, elements, 3, 3) and strains under 1 N of normal force, by shear force.
    `strain_profiles` is (11, m): ε_θθ at `line_deg` under 1 N of normal force and 0, 0.1, … 1 N of shear.
    `near_zero` and `wide` are loadings from zero under 1 N; `wide_by_normal` by normal force, up to 1.6 N.
    """

    rows: tuple[FigureOfMerit, ...]
    strain_maps: dict[float, tuple[FloatArray, FloatArray]]
    line_deg: FloatArray
    strain_profiles: FloatArray
    near_zero: ResponseCurve
    wide: ResponseCurve
    wide_by_normal: dict[float, ResponseCurve]


def characterise() -> Characterisation:
    """Return the contents of the paper's table 1 and figures 4 to 8, from the models; takes about ten seconds."""
    models = _Models()
    pressed = apply_load(models.skin, unloaded(models.skin), 1.0, 0.0)
    profiles = [pressed, *states_along(models.skin, 1.0, loading(1.0))]
    finite = FiniteStrainSkin(PAPER_SECTION)
    steps = finite.states_along(1.0, loading(1.0))
    return Characterisation(
        rows=(*_model_rows(models, profiles[-1]), *_prediction_rows(models)),
        strain_maps={state.shear_n: finite.strain_map(state) for state in (steps[4], steps[-1])},
        line_deg=models.skin.line_deg,
        strain_profiles=np.array([line_strain(models.skin, state) for state in profiles]),
        near_zero=models.curve(loading(0.15, 0.005), 1.0),
        wide=models.curve(loading(1.0, 0.02), 1.0),
        wide_by_normal={normal_n: models.curve(loading(1.6), normal_n) for normal_n in PAPER_MEASURED_SENSITIVITY},
    )


class _Models:
    """The 1-D model of the thick section and the linear 2-D model of the other, as responses along a path of forces."""

    def __init__(self) -> None:
        self.membrane = Membrane(THICK_SECTION)
        self.skin = condense(PAPER_SECTION)
        # Friction acts in the contact alone.
        self.slippery_skin = replace(self.skin, section=replace(PAPER_SECTION, friction=0.0))

    def both(self, shear_n: FloatArray, normal_n: float) -> list[FloatArray]:
        return [responses(self.membrane, shear_n, normal_n), _responses_2d(self.skin, shear_n, normal_n)]

    def curve(self, shear_n: FloatArray, normal_n: float) -> ResponseCurve:
        in_1d, in_2d = self.both(shear_n, normal_n)
        return ResponseCurve(shear_n, in_1d, in_2d, _responses_2d(self.slippery_skin, shear_n, normal_n))


def _responses_2d(skin: CondensedSkin, shear_n: FloatArray, normal_n: float) -> FloatArray:
    return gauge_responses(skin, states_along(skin, normal_n, shear_n))


def _model_rows(models: _Models, fully_loaded: ContactState) -> list[FigureOfMerit]:
    skin = models.skin
    straight, near = loading(PAPER_LINEAR_N), np.array([0.02])
    rows = []
    for normal_n, measured in PAPER_MEASURED_SENSITIVITY.items():
        slopes = (origin_slope(straight, found) for found in models.both(straight, normal_n))
        name = f"sensitivity, fit through origin, Fn = {normal_n} N"
        rows.append(FigureOfMerit(name, "1/N", "0.078", measured, *slopes))
    fitted = [fit_line(straight, found) for found in models.both(straight, 1.0)]
    in_deadband = [origin_slope(near, found) for found in models.both(near, 1.0)]
    strain = line_strain(skin, fully_loaded)
    flank = strain[(skin.line_deg > 15) & (skin.line_deg < 75)]
    falls = 100 * (1 - float(np.exp(-models.membrane.belt.friction * np.radians(60))))
    strain_1, strain_2 = skin.gauge_weights @ strain
    up, slippery = loading(1.0), Membrane(replace(THICK_SECTION, friction=0.0))
    free = responses(slippery, up, 1.0), _responses_2d(models.slippery_skin, up, 1.0)
    without = [origin_slope(up, found) for found in free]
    pressed = _responses_2d(skin, np.zeros(1), 2.0)[0]
    power_w = EXCITATION_A**2 * GAUGE_RESISTANCE_OHM
    return [
        *rows,
        FigureOfMerit("slope beyond the deadband, Fn = 1 N", "1/N", "", "", *(line.slope_per_n for line in fitted)),
        FigureOfMerit("slope without friction", "1/N", "0.088", "", *without),
        FigureOfMerit("slope within the deadband, Fn = 1 N", "1/N", "0", "0", *in_deadband),
        FigureOfMerit("deadband, Fn = 1 N", "N", "0.04", "0.04", *(line.kink_n for line in fitted)),
        FigureOfMerit("response at 1.6 N above the line, Fn = 1 N", "%", "", "< 30", *_upturns(models)),
        FigureOfMerit("fall of tension between 75° and 15°", "%", "< 4", "", falls, 100 * np.ptp(flank) / flank.max()),
        FigureOfMerit("|ε₂/ε₁|, Fn = Ft = 1 N", "", "much lower", "much lower", None, abs(strain_2 / strain_1)),
        FigureOfMerit("response to 2 N of normal force alone", "", "", "< 1.24e-4", 0.0, abs(pressed)),
        FigureOfMerit(
            "change of sensitivity over 15 K, zero from before", "%", "", "< 2", *[100 * warming_change(WARM_K)] * 2
        ),
        FigureOfMerit("gauge resistance", "Ω", "25", "25", GAUGE_RESISTANCE_OHM),
        FigureOfMerit("power of a gauge at 5 mA", "mW", "", "", 1e3 * power_w),
        FigureOfMerit("Joule heating at 5 mA", "K", "< 5", "", joule_heating_k(power_w)),
    ]


def _upturns(models: _Models) -> list[float]:
    """Return by how much (%) the last response of a loading to 1.6 N exceeds the line through the origin to 1.2 N."""
    shear_n, straight = loading(1.6), slice(len(loading(PAPER_LINEAR_N)))
    found = models.both(shear_n, 1.0)
    return [
        100 * (response[-1] / (1.6 * origin_slope(shear_n[straight], response[straight])) - 1) for response in found
    ]


def _prediction_rows(models: _Models) -> list[FigureOfMerit]:
    up, around = loading(1.0), loop(1.0)
    both_ways = np.concatenate([-up, up])
    loaded = [fit_line(both_ways, np.concatenate([-y, y])) for y in models.both(up, 1.0)]
    cycled = [fit_line(around, found) for found in models.both(around, 1.0)]
    return [
        FigureOfMerit("95 % prediction interval", "± N", "", "0.0802"),
        FigureOfMerit(
            "  from friction alone, loading ± 1 N", "± N", "", "", *(line.prediction_half_width_n for line in loaded)
        ),
        FigureOfMerit(
            "  from friction alone, whole loop ± 1 N", "± N", "", "", *(line.prediction_half_width_n for line in cycled)
        ),
    ]
