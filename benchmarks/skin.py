"""The shear skin's models: time against error, readings of the paper, calibrations, depths, and contact solves.

    python -m benchmarks.skin --out DIR

The models follow one loading to 1 N and one hysteresis loop between ± 1 N under 1 N of normal force. Errors are the
largest difference from the 2-D model at finite strain, relative to its largest response. Under a plate narrower than
the skin the reference is that model's response times the width factor of the finest sheet. Times are the best of
several runs, per load step. The chart `skin-speed-accuracy` goes to DIR. The readings of the paper are origin slopes up
to 1.2 N. The contact solver follows random load paths on random skins and meshes.
"""

import time
import timeit
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import parser_of, table_head, table_row
from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.calibration_fit import CalibrationTable, fit_calibration
from shearloop.estimation.skin.membrane import (
    GAUGE_FACTOR,
    PAPER_SECTION,
    THICK_SECTION,
    Membrane,
    Section,
    sensitivity_per_n,
)
from shearloop.estimation.skin.plane_strain import (
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
from shearloop.studies.skin.characterisation import (
    PAPER_MEASURED_SENSITIVITY,
    fit_line,
    loading,
    loop,
    origin_slope,
    responses,
)
from shearloop.studies.skin.finite_strain import FiniteStrainSkin
from shearloop.studies.skin.sheet import PLATE_MM, SheetSkin

NORMAL_N, AMPLITUDE_N = 1.0, 1.0
MESHES = {56: MeshSize(3, 4, 6, 2, 2), 112: MESH_112, 448: MESH_112.refined(2)}
RANDOM_PATHS = 110
READ = loading(1.2)
Model = Callable[[FloatArray], FloatArray]


def two_dimensional(mesh: MeshSize, _: float) -> Model:
    """Return the linear 2-D model on a mesh, for a plate of any width."""
    return partial(linear_responses, condense(PAPER_SECTION, mesh), NORMAL_N)


def linear_responses(skin: CondensedSkin, normal_n: float, path: FloatArray) -> FloatArray:
    """Return the responses of a linear skin along a path of shear forces."""
    return gauge_responses(skin, states_along(skin, normal_n, path.tolist()))


def at_finite_strain(section: Section, normal_n: float, path: FloatArray) -> FloatArray:
    """Return the responses of the 2-D model at finite strain, converged to 0.2 %."""
    skin = FiniteStrainSkin(section)
    found: FloatArray = skin.gauge_responses(skin.states_along(normal_n, path.tolist())) @ [1, -1]
    return found


def sheet(finer: int, plate_mm: float) -> Model:
    """Return the sheet under a plate; a plate of the skin's width has held edges, as plane strain does."""
    skin = SheetSkin(PAPER_SECTION, plate_mm, finer, held_edges=plate_mm == PAPER_SECTION.width_mm)
    return lambda path: np.array([skin.response(NORMAL_N, shear_n) for shear_n in path.tolist()])


def models() -> dict[str, Callable[[float], Model]]:
    """Return the models by name, each as a function of the plate's width in mm; only the sheet depends on it."""
    return {
        "1-D, finite strain": lambda _: partial(responses, Membrane(PAPER_SECTION), normal_n=NORMAL_N),
        "sheet, 520 elements": partial(sheet, 1),
        **{f"2-D, linear, {elements} elements": partial(two_dimensional, mesh) for elements, mesh in MESHES.items()},
    }


def compare_models() -> list[dict[str, Any]]:
    """Print and return each model's set-up in ms, time per load step in µs, and errors over the largest response."""
    up, there_and_back, whole_mm = loading(AMPLITUDE_N), loop(AMPLITUDE_N), PAPER_SECTION.width_mm
    begin = time.process_time()
    true_loop = at_finite_strain(PAPER_SECTION, NORMAL_N, there_and_back)
    finite_us = 1e6 * (time.process_time() - begin) / len(there_and_back)
    true_up = true_loop[: len(up)]
    under_plate = true_up * sheet(3, PLATE_MM)(up)[-1] / sheet(3, whole_mm)(up)[-1]
    found = []
    print(table_head("model", "set-up, ms", "µs per step", "loading", "whole loop", "14 mm plate"))
    for name, make in models().items():
        set_up_ms = 1e3 * min(timeit.repeat(partial(make, PLATE_MM), number=1, repeat=3))
        model = make(whole_mm)
        step_us = 1e6 * min(timeit.repeat(partial(model, up), number=1)) / len(up)
        even, plate = _error(model(up), true_up), _error(make(PLATE_MM)(up), under_plate)
        found.append({"name": name, "set_up_ms": set_up_ms, "step_us": step_us, "loading": even, "plate": plate})
        around = "–" if "sheet" in name else f"{_error(model(there_and_back), true_loop):.1%}"
        print(table_row(name, set_up_ms, step_us, f"{even:.1%}", around, f"{plate:.1%}"), flush=True)
    ignored = f"{_error(true_up, under_plate):.1%}"
    print(table_row("2-D, finite strain, 112 elements", "–", finite_us, "–", "–", ignored), flush=True)
    return found


def _error(found: FloatArray, true: FloatArray) -> float:
    return float(abs(found - true).max() / abs(true).max())


def draw(found: Sequence[dict[str, Any]], out: Path) -> None:
    """Draw each model's error over its time per step, for an even load and for the plate, and write both."""
    from shearloop.tools import drawing

    made = drawing.figure(8.0, 4.6)
    axes = made.subplots()
    drawing.plain_log(axes)
    points: list[tuple[float, float, str]] = []
    for number, (scene, key) in enumerate((("even load over 20 mm", "loading"), ("plate of 14 mm", "plate"))):
        times_us, errors = [each["step_us"] for each in found], [100 * each[key] for each in found]
        axes.plot(times_us, errors, label=scene, **drawing.look(number) | {"linestyle": "none"})
        points += zip(times_us, errors, (each["name"] for each in found), strict=True)
    axes.set(xlabel="time per load step, µs", ylabel="largest error while loading, %")
    axes.set_title("The skin's models: speed against accuracy, Fn = 1 N")
    axes.grid(alpha=0.25)
    axes.legend(loc="lower right")
    axes.margins(0.25, 0.15)
    drawing.lay_out(made)
    drawing.write_names(axes, points)
    drawing.save(made, {"models": found}, out, "skin-speed-accuracy")


def compare_scenes() -> None:
    """Print the slopes of the models that a scene distinguishes, and the crosstalk of a tilted normal force."""
    print("\n" + table_head("scene", "closed form", "2-D", "sheet", "sheet, 0.88 mm"))
    skin = condense(PAPER_SECTION)
    closed, flat = sensitivity_per_n(PAPER_SECTION), fit_line(READ, linear_responses(skin, NORMAL_N, READ)).slope_per_n
    for name, plate_mm, held in (
        ("even load, edges held", 20.0, True), ("even load, edges free", 20.0, False),
        ("plate of 14 mm", 14.0, False), ("plate of 10 mm", 10.0, False),
    ):  # fmt: skip
        slopes = [
            SheetSkin(each, plate_mm, held_edges=held).response(0.0, 1.0) for each in (PAPER_SECTION, THICK_SECTION)
        ]
        print(table_row(name, closed, flat, *slopes))
    sheet_14 = SheetSkin(PAPER_SECTION)
    print(table_row("1 N across, response", 0, 0, f"{abs(sheet_14.response(NORMAL_N, 0.0, 1.0)):.0e}", "–"))
    more = sheet_14.response(NORMAL_N, 0.5, 0.5) / sheet_14.response(NORMAL_N, 0.5) - 1
    print(table_row("0.5 N across and 0.5 N along, against along alone", "–", "–", f"{more:+.1%}", "–"))
    tilt = np.radians(0.25)
    pressed_n, tilted_n = 2 * np.cos(tilt), 2 * np.sin(tilt)
    pressed = apply_load(skin, unloaded(skin), pressed_n, 0.0)
    tilted = gauge_responses(
        skin, [apply_load(skin, start, pressed_n, tilted_n) for start in (unloaded(skin), pressed)]
    ).tolist()
    for name, response in zip(("2 N that rises at 0.25°", "2 N that then tilts by 0.25°"), tilted, strict=True):
        print(table_row(name, 0, response, sheet_14.response(pressed_n, tilted_n), "–"))


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
    print("\n" + table_head("thickness, mm", "depth, mm", "stretched side", "slack side", "ratio"))
    for section, depth_mm in product((PAPER_SECTION, THICK_SECTION), (-0.35, -0.026, 0.0, 0.35)):
        skin = condense(replace(section, gauge_depth_mm=depth_mm))
        stretched, slack = gauge_strains(skin, states_along(skin, NORMAL_N, loading(AMPLITUDE_N).tolist()))[-1].tolist()
        print(table_row(section.thickness_mm, depth_mm, f"{stretched:.2%}", f"{slack:.2%}", slack / stretched))


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
    """Measure, print the tables and draw the chart."""
    args = parser_of(__doc__).parse_args()
    draw(compare_models(), args.out)
    compare_scenes()
    compare_readings()
    compare_calibrations()
    compare_depths()
    count_steps()


if __name__ == "__main__":
    main()
