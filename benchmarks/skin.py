"""The shear skin's models, time against error to the converged 2-D solution.

    python -m benchmarks.skin

Follows one loading to 1 N and one hysteresis loop between ± 1 N under 1 N of normal force. Errors are the largest
difference of response, relative to the largest response. Times are the best of several runs, per load step. The
reference is converged to 2e-5.
"""

import timeit
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.common import table_head, table_row
from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin.characterisation import loading, loop, responses
from shearloop.bank.skin.membrane import PAPER_SECTION, loading_response, paper_membrane, section_membrane
from shearloop.bank.skin.plane_strain import MESH_112, MeshSize, condense, gauge_responses, states_along

NORMAL_N, AMPLITUDE_N = 1.0, 1.0
MESHES = {56: MeshSize(3, 4, 6, 2, 2), 112: MESH_112, 448: MESH_112.refined(2)}
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


def main() -> None:
    """Measure and print a table."""
    up, there_and_back = loading(AMPLITUDE_N), loop(AMPLITUDE_N)
    reference = two_dimensional(MESH_112.refined(4))
    true_up, true_loop = reference(up), reference(there_and_back)
    scale = abs(true_loop).max()
    print(table_head("model", "µs per step", "loading", "whole loop"))
    for name, model in models().items():
        step_us = 1e6 * min(timeit.repeat(partial(model, there_and_back), number=1)) / len(there_and_back)
        errors = abs(model(up) - true_up).max() / scale, abs(model(there_and_back) - true_loop).max() / scale
        print(table_row(name, step_us, *(f"{error:.3%}" for error in errors)), flush=True)


if __name__ == "__main__":
    main()
