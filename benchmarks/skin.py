"""The shear skin's models: time against error, readings of the paper, calibrations, depths, and contact solves.

    python -m benchmarks.skin

The models follow one loading to 1 N and one hysteresis loop between ± 1 N under 1 N of normal force. Errors are the
largest difference from the 2-D model at finite strain, relative to its largest response. Times are the best of several
runs, per load step. The readings of the paper are origin slopes up to 1.2 N. The contact solver follows random load
paths on random skins and meshes.
"""

import time
import timeit
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from benchmarks.common import table_head, table_row
from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin.calibration import CalibrationTable, fit_calibration
from shearloop.bank.skin.characterisation import (
    PAPER_MEASURED_SENSITIVITY,
    fit_line,
    loading,
    loop,
    origin_slope,
    responses,
)
from shearloop.bank.skin.finite_strain import FiniteStrainSkin
from shearloop.bank.skin.membrane import (
    GAUGE_FACTOR,
    PAPER_SECTION,
    THICK_SECTION,
    Membrane,
    Section,
)
from shearloop.bank.skin.plane_strain import (
    MESH_112,
    CondensedSkin,
    ContactState,
    MeshSize,
    apply_load,
    condense,
    gauge_responses,
    gauge_strains,
    line_strain,
    states_along,
    unloaded,
)

NORMAL_N, AMPLITUDE_N = 1.0, 1.0
MESHES = {56: MeshSize(3, 4, 6, 2, 2), 112: MESH_112, 448: MESH_112.refined(2)}
RANDOM_PATHS = 110
READ = loading(1.2)
Model = Callable[[FloatArray], FloatArray]


def two_dimensional(mesh: MeshSize) -> Model:
    """Return the linear 2-D model on a mesh."""
    return partial(linear_responses, condense(PAPER_SECTION, mesh), NORMAL_N)


def linear_responses(skin: CondensedSkin, normal_n: float, path: FloatArray) -> FloatArray:
    """Return the responses of a linear skin along a path of shear forces."""
    return gauge_responses(skin, states_along(skin, normal_n, path.tolist()))


def at_finite_strain(section: Section, normal_n: float, path: FloatArray) -> FloatArray:
    """Return the responses of the 2-D model at finite strain, converged to 0.2 %."""
    skin = FiniteStrainSkin(section)
    found: FloatArray = skin.gauge_responses(skin.states_along(normal_n, path.tolist())) @ [1, -1]
    return found


def models() -> dict[str, Model]:
    """Return the models by name."""
    return {
        "1-D, finite strain": partial(responses, Membrane(PAPER_SECTION), normal_n=NORMAL_N),
        **{f"2-D, linear, {elements} elements": two_dimensional(mesh) for elements, mesh in MESHES.items()},
    }


def compare_models() -> None:
    """Print each model's time and errors."""
    up, there_and_back = loading(AMPLITUDE_N), loop(AMPLITUDE_N)
    begin = time.process_time()
    true_loop = at_finite_strain(PAPER_SECTION, NORMAL_N, there_and_back)
    finite_us = 1e6 * (time.process_time() - begin) / len(there_and_back)
    true_up, scale = true_loop[: len(up)], abs(true_loop).max()
    print(table_head("model", "µs per step", "loading", "whole loop"))
    for name, model in models().items():
        step_us = 1e6 * min(timeit.repeat(partial(model, there_and_back), number=1)) / len(there_and_back)
        errors = abs(model(up) - true_up).max() / scale, abs(model(there_and_back) - true_loop).max() / scale
        print(table_row(name, step_us, *(f"{error:.1%}" for error in errors)), flush=True)
    print(table_row("2-D, finite strain, 112 elements", finite_us, "–", "–"), flush=True)


def compare_readings() -> None:
    """Print the sensitivities of both readings of the paper, and the largest strain at 2 N of both forces."""
    names = ("thickness, theory", "F/(EA)", *(f"{normal_n} N" for normal_n in PAPER_MEASURED_SENSITIVITY))
    print("\n" + table_head(*names, "kink at 1 N", "largest strain"))
    for section in (PAPER_SECTION, replace(PAPER_SECTION, mid_radius_mm=5.94, thickness_mm=0.82), THICK_SECTION):
        stiffness_n = section.young_mpa * section.width_mm * section.thickness_mm
        linear, finite = condense(section), FiniteStrainSkin(section)
        strained = line_strain(linear, states_along(linear, 2.0, [2.0])[0]).max()
        stretched = finite.strain_map(finite.states_along(2.0, [1.0, 2.0])[-1])[1].max()
        theories = {
            "linear": (partial(linear_responses, linear), strained),
            "finite strain": (partial(at_finite_strain, section), stretched),
        }
        for theory, (respond, strain) in theories.items():
            found = {normal_n: respond(normal_n, READ) for normal_n in PAPER_MEASURED_SENSITIVITY}
            slopes = [f"{origin_slope(READ, each):.4f}" for each in found.values()]
            name, kink = f"{section.thickness_mm:.2f} mm, {theory}", f"{fit_line(READ, found[1.0]).kink_n:.3f}"
            print(table_row(name, f"{GAUGE_FACTOR / stiffness_n:.4f}", *slopes, kink, f"{strain:.1%}"), flush=True)


def compare_calibrations() -> None:
    """Print what the fit finds on skins that follow the membrane at finite strain, without noise."""
    print("\n" + table_head("recorded under", "friction", "slope, 1/N", "95 % interval, ± N"))
    for normal_forces in ((1.0,), (0.5, 1.0, 1.5, 2.0)):
        rows = []
        for normal_n, path in product(normal_forces, (READ, -READ)):
            rows += [(1.0, 1.0, 0.0, 0.0)] * 2
            for shear_n, response in zip(
                path, responses(Membrane(THICK_SECTION), path.tolist(), normal_n), strict=True
            ):
                rows.append((1 + max(response, 0.0), 1 + max(-response, 0.0), shear_n, normal_n))
        found = fit_calibration(CalibrationTable(*np.array(rows).T))
        name = f"{normal_forces[0]} to {normal_forces[-1]} N" if len(normal_forces) > 1 else f"{normal_forces[0]} N"
        print(table_row(name, found.friction, found.slope_per_n, found.prediction_half_width_n), flush=True)


def compare_depths() -> None:
    """Print the strains of both gauges at 1 N of both forces, by their depth outwards from mid-thickness."""
    print("\n" + table_head("depth, mm", "stretched side", "slack side", "ratio"))
    for depth_mm in (-0.35, -0.026, 0.0, 0.35):
        skin = condense(replace(PAPER_SECTION, gauge_depth_mm=depth_mm))
        stretched, slack = gauge_strains(skin, states_along(skin, NORMAL_N, loading(AMPLITUDE_N).tolist()))[-1].tolist()
        print(table_row(depth_mm, f"{stretched:.2%}", f"{slack:.2%}", slack / stretched))


def random_states(seed: int) -> Iterator[tuple[CondensedSkin, ContactState]]:
    """Yield a random skin with its state after each step of a random load path.

    The load rises at a constant tilt, or its shear turns at a constant normal force, or both are random. Raises
    ContactError where the contact solver fails.
    """
    rng = np.random.default_rng(seed)
    bracket, gauge, flank, load = rng.integers(1, (8, 12, 30, 18)).tolist()
    section = replace(
        PAPER_SECTION,
        thickness_mm=rng.choice([0.3, 0.7, 0.88, 2.0, 6.0]),
        poisson_ratio=rng.choice([0.3, 0.49, 0.4999]),
        friction=rng.choice([0.0, 0.04, 0.3, 1.0]),
    )
    skin = condense(section, MeshSize(bracket, gauge, flank, load, int(rng.choice([2, 4]))))
    steps, top_n = rng.integers(1, 21), rng.uniform(0.5, 3.0)
    rising, random = np.linspace(0, 1, steps + 1)[1:], rng.uniform(-3.0, 3.0, steps)
    tilt = np.radians(rng.uniform(-2.0, 2.0))
    paths = [
        np.outer(rising * top_n, [np.cos(tilt), np.sin(tilt)]),
        np.column_stack([np.full(steps, top_n), rising * random]),
        np.column_stack([rng.uniform(0.0, 3.0, steps), random]),
    ]
    state = unloaded(skin)
    for normal_n, shear_n in paths[rng.integers(3)].tolist():
        state = apply_load(skin, state, normal_n, shear_n)
        yield skin, state


def count_steps() -> None:
    """Print the distribution of the contact solver's steps over random loads on random skins."""
    states = [state for seed in range(RANDOM_PATHS) for _, state in random_states(seed)]
    steps, pivoted = [state.steps for state in states], sum(state.pivoted for state in states)
    print("\n" + table_head("random solves", "median of steps", "90 %", "99 %", "most", "with pivoting"))
    print(table_row(len(states), *np.percentile(steps, [50, 90, 99, 100]).tolist(), pivoted))


def main() -> None:
    """Measure and print the tables."""
    compare_models()
    compare_readings()
    compare_calibrations()
    compare_depths()
    count_steps()


if __name__ == "__main__":
    main()
