"""The shear skin's models, time against error to the converged 2-D solution, and the contact solver's steps.

    python -m benchmarks.skin

Follows one loading to 1 N and one hysteresis loop between ± 1 N under 1 N of normal force. Errors are the largest
difference of response, relative to the largest response. Times are the best of several runs, per load step. The
reference is converged to 2e-5. The contact solver follows random load paths on random skins and meshes.
"""

import timeit
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.common import table_head, table_row
from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin.characterisation import loading, loop, responses
from shearloop.bank.skin.membrane import PAPER_SECTION, loading_response, paper_membrane, section_membrane
from shearloop.bank.skin.plane_strain import (
    MESH_112,
    CondensedSkin,
    ContactState,
    MeshSize,
    apply_load,
    condense,
    gauge_responses,
    states_along,
    unloaded,
)

NORMAL_N, AMPLITUDE_N = 1.0, 1.0
MESHES = {56: MeshSize(3, 4, 6, 2, 2), 112: MESH_112, 448: MESH_112.refined(2)}
RANDOM_PATHS = 110
Model = Callable[[FloatArray], FloatArray]


def two_dimensional(mesh: MeshSize) -> Model:
    """Return the 2-D model on a mesh."""
    skin = condense(PAPER_SECTION, mesh)
    return lambda path: gauge_responses(skin, states_along(skin, NORMAL_N, path.tolist()))


def models() -> dict[str, Model]:
    """Return the models by name."""
    return {
        "closed form": lambda path: np.array(
            [loading_response(PAPER_SECTION, NORMAL_N, shear) for shear in path.tolist()]
        ),
        "1-D, paper's F/(EA)": partial(responses, paper_membrane(), normal_n=NORMAL_N),
        "1-D, section's EA": partial(responses, section_membrane(), normal_n=NORMAL_N),
        **{f"2-D, {elements} elements": two_dimensional(mesh) for elements, mesh in MESHES.items()},
    }


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


def main() -> None:
    """Measure and print the tables."""
    up, there_and_back = loading(AMPLITUDE_N), loop(AMPLITUDE_N)
    reference = two_dimensional(MESH_112.refined(4))
    true_up, true_loop = reference(up), reference(there_and_back)
    scale = abs(true_loop).max()
    print(table_head("model", "µs per step", "loading", "whole loop"))
    for name, model in models().items():
        step_us = 1e6 * min(timeit.repeat(partial(model, there_and_back), number=1)) / len(there_and_back)
        errors = abs(model(up) - true_up).max() / scale, abs(model(there_and_back) - true_loop).max() / scale
        print(table_row(name, step_us, *(f"{error:.3%}" for error in errors)), flush=True)
    states = [state for seed in range(RANDOM_PATHS) for _, state in random_states(seed)]
    steps, pivoted = [state.steps for state in states], sum(state.pivoted for state in states)
    print("\n" + table_head("random solves", "median of steps", "90 %", "99 %", "most", "with pivoting"))
    print(table_row(len(states), *np.percentile(steps, [50, 90, 99, 100]).tolist(), pivoted))


if __name__ == "__main__":
    main()
