"""The paper's figures of merit next to the models' and estimators': one table and three figures' curves.

Noise, drift and temperature are properties of a made skin. For those the table shows estimates from synthetic
recordings with the paper's figure as the true one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin import membrane, statistics
from shearloop.bank.skin.membrane import PAPER_SECTION, Gauge, Section, response_of_strains
from shearloop.bank.skin.plane_strain import (
    ContactState,
    apply_load,
    condense,
    gauge_strains,
    midline_strain,
    states_along,
    unloaded,
)
from shearloop.bank.skin.statistics import loading, loop, responses

NORMAL_FORCES_N = (0.5, 1.0, 1.5, 2.0)
FULL_RANGE_N = 5.0
PAPER_MEASURED_SENSITIVITY = {0.5: "0.078", 1.0: "0.076", 1.5: "0.080", 2.0: "0.080"}


@dataclass(frozen=True, slots=True)
class FigureOfMerit:
    """One quantity: the paper's computed and measured values, as printed, and each model's or estimator's."""

    quantity: str
    unit: str
    paper_computed: str = ""
    paper_measured: str = ""
    closed_form: float | None = None
    membrane: float | None = None
    two_d: float | None = None
    synthetic: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """Responses (n,) of both models along shear forces (n,) in N, and of the two-dimensional one without friction."""

    shear_n: FloatArray
    membrane: FloatArray
    two_d: FloatArray
    two_d_slippery: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Characterisation:
    """The table, and the data of figures 5 to 7.

    `strain_profiles` is (11, m): ε_θθ at `midline_deg` under 1 N of normal force and 0, 0.1, … 1 N of shear.
    `near_zero` and `wide` are loadings from zero under 1 N; `wide_by_normal` by normal force, up to 1.6 N.
    """

    rows: tuple[FigureOfMerit, ...]
    midline_deg: FloatArray
    strain_profiles: FloatArray
    near_zero: ResponseCurve
    wide: ResponseCurve
    wide_by_normal: dict[float, ResponseCurve]


def characterise(rng: np.random.Generator, section: Section = PAPER_SECTION) -> Characterisation:
    """Return the contents of the paper's table 1 and figures 5 to 7, from the models; takes a few seconds."""
    models = _Models(section)
    pressed = apply_load(models.skin, unloaded(models.skin), 1.0, 0.0)
    profiles = [pressed, *states_along(models.skin, 1.0, loading(1.0))]
    return Characterisation(
        rows=(*_model_rows(models, profiles[-1]), *_gauge_rows(), *_estimator_rows(models, rng)),
        midline_deg=models.skin.midline_deg,
        strain_profiles=np.array([midline_strain(models.skin, state) for state in profiles]),
        near_zero=models.curve(loading(0.15, 0.005), 1.0),
        wide=models.curve(loading(1.0, 0.02), 1.0),
        wide_by_normal={normal_n: models.curve(loading(1.6), normal_n) for normal_n in NORMAL_FORCES_N},
    )


class _Models:
    """The three models of one section, each as responses along a path of shear forces."""

    def __init__(self, section: Section) -> None:
        self.section = section
        self.membrane = membrane.paper_membrane(section)
        self.skin = condense(section)

    def in_closed_form(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        return np.array([membrane.loading_response(self.section, normal_n, float(s)) for s in shear_n])

    def in_1d(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        return responses(self.membrane, shear_n.tolist(), normal_n)

    def in_2d(self, shear_n: FloatArray, normal_n: float, friction: float | None = None) -> FloatArray:
        states = states_along(self.skin, normal_n, shear_n.tolist(), friction=friction)
        return response_of_strains(*gauge_strains(self.skin, states).T)

    def curve(self, shear_n: FloatArray, normal_n: float) -> ResponseCurve:
        return ResponseCurve(
            shear_n,
            self.in_1d(shear_n, normal_n),
            self.in_2d(shear_n, normal_n),
            self.in_2d(shear_n, normal_n, friction=0.0),
        )


def _model_rows(models: _Models, fully_loaded: ContactState) -> list[FigureOfMerit]:
    section, skin = models.section, models.skin

    def each(estimate: Callable[[FloatArray, FloatArray], float], normal_n: float) -> list[float]:
        shear_n = loading(normal_n)
        return [
            estimate(shear_n, model(shear_n, normal_n)) for model in (models.in_closed_form, models.in_1d, models.in_2d)
        ]

    rows = [
        FigureOfMerit(
            f"sensitivity, fit through origin, Fn = {normal_n} N",
            "1/N",
            "0.078",
            PAPER_MEASURED_SENSITIVITY[normal_n],
            *each(statistics.origin_slope, normal_n),
        )
        for normal_n in NORMAL_FORCES_N
    ]
    strain = midline_strain(skin, fully_loaded)
    flank = strain[(skin.midline_deg > 15) & (skin.midline_deg < 75)]
    falls = 100 * (1 - float(np.exp(-section.friction * np.radians(60))))
    strain_1, strain_2 = skin.gauge_weights @ strain
    without = membrane.sensitivity_per_n(replace(section, friction=0.0))
    no_friction = statistics.origin_slope(loading(1.0), models.in_2d(loading(1.0), 1.0, friction=0.0))
    pressed = models.in_2d(np.zeros(1), 2.0)[0]
    given = models.membrane.gauge_factor / models.membrane.axial_stiffness_n
    return [
        *rows,
        FigureOfMerit("slope beyond the deadband, Fn = 1 N", "1/N", "", "", *each(_slope, 1.0)),
        FigureOfMerit("slope without friction", "1/N", "0.088", "", without, given, no_friction),
        FigureOfMerit("deadband, Fn = 1 N", "N", "0.04", "0.04", *each(_kink, 1.0)),
        FigureOfMerit(
            "fall of tension between 75° and 15°", "%", "< 4", "", falls, falls, 100 * np.ptp(flank) / flank.max()
        ),
        FigureOfMerit("|ε₂/ε₁|, Fn = Ft = 1 N", "", "much lower", "much lower", 0.0, 0.0, abs(strain_2 / strain_1)),
        FigureOfMerit("response to 2 N of normal force alone", "", "", "< 1.24e-4", 0.0, 0.0, abs(pressed)),
    ]


def _slope(shear_n: FloatArray, response: FloatArray) -> float:
    return statistics.fit_line(shear_n, response).slope_per_n


def _kink(shear_n: FloatArray, response: FloatArray) -> float:
    line = statistics.fit_line(shear_n, response)
    return -line.offset / line.slope_per_n


def _gauge_rows() -> list[FigureOfMerit]:
    gauge = Gauge()
    return [
        FigureOfMerit("gauge resistance", "Ω", "25", "25", gauge.resistance_ohm),
        FigureOfMerit("power of a gauge at 5 mA", "mW", "", "", 1e3 * gauge.power_at_current_w()),
        FigureOfMerit("Joule heating at 5 mA", "K", "< 5", "", gauge.joule_heating_k()),
    ]


def _estimator_rows(models: _Models, rng: np.random.Generator) -> list[FigureOfMerit]:
    found = statistics.estimated_figures(models.membrane, statistics.SkinFigures(), rng)
    bits = statistics.dynamic_range_bits(FULL_RANGE_N, found.noise_floor_n)
    up, around = loading(1.0), loop(1.0)

    def half_width(shear_n: FloatArray, response: FloatArray) -> float:
        return statistics.fit_line(shear_n, response).prediction_half_width_n(0.0)

    both_ways = np.concatenate([-up, up])
    loaded = [half_width(both_ways, np.concatenate([-y, y])) for y in (models.in_1d(up, 1.0), models.in_2d(up, 1.0))]
    cycled = [half_width(around, model(around, 1.0)) for model in (models.in_1d, models.in_2d)]
    return [
        FigureOfMerit("noise floor", "N", "", "0.0016", synthetic=found.noise_floor_n),
        FigureOfMerit("dynamic range to 5 N", "bit", "", "> 10", synthetic=bits),
        FigureOfMerit("95 % prediction interval", "± N", "", "0.0802", synthetic=found.prediction_half_width_n),
        FigureOfMerit("  from friction alone, loading ± 1 N", "± N", "", "", None, *loaded),
        FigureOfMerit("  from friction alone, whole loop ± 1 N", "± N", "", "", None, *cycled),
        FigureOfMerit("drift over an hour, std of the response", "", "", "1.48e-4", synthetic=found.drift_std),
        FigureOfMerit("crosstalk, response to 2 N of normal force", "", "", "< 1.24e-4", synthetic=found.crosstalk),
        FigureOfMerit("change of sensitivity over 15 K", "%", "", "< 2", synthetic=100 * 15 * found.sensitivity_per_k),
    ]
