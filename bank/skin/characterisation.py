"""The paper's figures of merit beside what the models give and what the estimators find: one table, three curves.

A model answers what it can; noise, drift and temperature are properties of a made skin, so for those the table shows
what the estimators find in synthetic recordings into which the paper's figure was put.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin import closed_form, statistics
from shearloop.bank.skin.annulus import CondensedSkin, condense
from shearloop.bank.skin.contact import ContactState, follow, gauge_strains, load, midline_strain, unloaded
from shearloop.bank.skin.gauge import Gauge, response_of_strains
from shearloop.bank.skin.membrane import Membrane, paper_membrane
from shearloop.bank.skin.section import PAPER_SECTION, Section
from shearloop.bank.skin.synthetic import Figures, loading, loop, recover, responses

NORMAL_FORCES_N = (0.5, 1.0, 1.5, 2.0)
FULL_RANGE_N = 5.0
PAPER_MEASURED_SENSITIVITY = {0.5: "0.078", 1.0: "0.076", 1.5: "0.080", 2.0: "0.080"}


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity: what the paper computed and measured, in its words, and what each model or estimator gives."""

    quantity: str
    unit: str
    paper_computed: str = ""
    paper_measured: str = ""
    closed_form: float | None = None
    membrane: float | None = None
    two_d: float | None = None
    synthetic: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Responses (n,) of both models along shear forces (n,) in N, and of the two-dimensional one without friction."""

    shear_n: FloatArray
    membrane: FloatArray
    two_d: FloatArray
    two_d_slippery: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Characterisation:
    """The table, and what figures 5 to 7 are drawn from.

    `strain_profiles` is (11, m): ε_θθ at `midline_deg` under 1 N of normal force and 0, 0.1, … 1 N of shear.
    `near_zero` and `wide` are loadings from zero under 1 N; `wide_by_normal` by normal force, up to 1.6 N.
    """

    rows: tuple[Row, ...]
    midline_deg: FloatArray
    strain_profiles: FloatArray
    near_zero: Curve
    wide: Curve
    wide_by_normal: dict[float, Curve]


def characterise(rng: np.random.Generator, section: Section = PAPER_SECTION) -> Characterisation:
    """Return everything the paper's table 1 and figures 5 to 7 show, from the models; takes a few seconds."""
    models = _Models(section)
    pressed = load(models.skin, unloaded(models.skin), 1.0, 0.0)
    profiles = [pressed, *follow(models.skin, 1.0, loading(1.0))]
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
        self.membrane: Membrane = paper_membrane(section)
        self.skin: CondensedSkin = condense(section)

    def in_closed_form(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        return np.array([closed_form.loading_response(self.section, normal_n, float(s)) for s in shear_n])

    def in_1d(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        return responses(self.membrane, shear_n.tolist(), normal_n)

    def in_2d(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        return self._response(follow(self.skin, normal_n, shear_n.tolist()))

    def in_2d_slippery(self, shear_n: FloatArray, normal_n: float) -> FloatArray:
        state, states = unloaded(self.skin), []
        for shear in (0.0, *shear_n.tolist()):
            state = load(self.skin, state, normal_n, shear, friction=0.0)
            states.append(state)
        return self._response(states[1:])

    def curve(self, shear_n: FloatArray, normal_n: float) -> Curve:
        models = (self.in_1d, self.in_2d, self.in_2d_slippery)
        return Curve(shear_n, *(model(shear_n, normal_n) for model in models))

    def _response(self, states: list[ContactState]) -> FloatArray:
        return response_of_strains(*gauge_strains(self.skin, states).T)


def _model_rows(models: _Models, fully_loaded: ContactState) -> list[Row]:
    section, skin = models.section, models.skin
    all_three = (models.in_closed_form, models.in_1d, models.in_2d)

    def each(estimate: Callable[[FloatArray, FloatArray], float], normal_n: float) -> list[float]:
        shear_n = loading(normal_n)
        return [estimate(shear_n, model(shear_n, normal_n)) for model in all_three]

    rows = [
        Row(
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
    without = replace(section, friction=0.0)
    no_friction = statistics.origin_slope(loading(1.0), models.in_2d_slippery(loading(1.0), 1.0))
    pressed = models.in_2d(np.zeros(1), 2.0)[0]
    given = models.membrane.gauge_factor / models.membrane.axial_stiffness_n
    return [
        *rows,
        Row("slope beyond the deadband, Fn = 1 N", "1/N", "", "", *each(_slope, 1.0)),
        Row("slope without friction", "1/N", "0.088", "", closed_form.sensitivity_per_n(without), given, no_friction),
        Row("deadband, Fn = 1 N", "N", "0.04", "0.04", *each(_kink, 1.0)),
        Row("fall of tension between 75° and 15°", "%", "< 4", "", falls, falls, 100 * np.ptp(flank) / flank.max()),
        Row("|ε₂/ε₁|, Fn = Ft = 1 N", "", "much lower", "much lower", 0.0, 0.0, abs(strain_2 / strain_1)),
        Row("response to 2 N of normal force alone", "", "", "< 1.24e-4", 0.0, 0.0, abs(pressed)),
    ]


def _slope(shear_n: FloatArray, response: FloatArray) -> float:
    return statistics.fit_line(shear_n, response).slope_per_n


def _kink(shear_n: FloatArray, response: FloatArray) -> float:
    line = statistics.fit_line(shear_n, response)
    return -line.offset / line.slope_per_n


def _gauge_rows() -> list[Row]:
    gauge = Gauge()
    return [
        Row("gauge resistance", "Ω", "25", "25", gauge.resistance_ohm),
        Row("power of a gauge at 5 mA", "mW", "", "", 1e3 * gauge.power_at_current_w()),
        Row("Joule heating at 5 mA", "K", "< 5", "", gauge.joule_heating_k()),
    ]


def _estimator_rows(models: _Models, rng: np.random.Generator) -> list[Row]:
    found = recover(models.membrane, Figures(), rng)
    bits = statistics.dynamic_range_bits(FULL_RANGE_N, found.noise_floor_n)
    up, around = loading(1.0), loop(1.0)

    def half_width(shear_n: FloatArray, response: FloatArray) -> float:
        return statistics.fit_line(shear_n, response).prediction_half_width_n(0.0)

    both_ways = np.concatenate([-up, up])
    loaded = [half_width(both_ways, np.concatenate([-y, y])) for y in (models.in_1d(up, 1.0), models.in_2d(up, 1.0))]
    cycled = [half_width(around, model(around, 1.0)) for model in (models.in_1d, models.in_2d)]
    return [
        Row("noise floor", "N", "", "0.0016", synthetic=found.noise_floor_n),
        Row("dynamic range to 5 N", "bit", "", "> 10", synthetic=bits),
        Row("95 % prediction interval", "± N", "", "0.0802", synthetic=found.prediction_half_width_n),
        Row("  from friction alone, loading ± 1 N", "± N", "", "", None, *loaded),
        Row("  from friction alone, whole loop ± 1 N", "± N", "", "", None, *cycled),
        Row("drift over an hour, std of the response", "", "", "1.48e-4", synthetic=found.drift_std),
        Row("crosstalk, response to 2 N of normal force", "", "", "< 1.24e-4", synthetic=found.crosstalk),
        Row("change of sensitivity over 15 K", "%", "", "< 2", synthetic=100 * 15 * found.sensitivity_per_k),
    ]
