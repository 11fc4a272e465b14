"""Time per bank cell and per unknown of fingertips, one thread: conductivity, batch solve, and both.

    python -m benchmarks.cell_speed config/fingertips/*.yaml --out FILE

Each rectangle is also measured with every second of its electrodes. Times are processor times, the least of the turns.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common import parser_of, write_figures
from shearloop.bank.eit.fingertip import Fingertip, RectangularFingertip
from shearloop.bank.eit.forward import BatchForwardModel
from shearloop.bank.eit.models import ConductivityModel
from shearloop.daemon.analysis.charts.forward_methods import MODEL
from shearloop.daemon.bank_config import FingertipGeometryConfig
from shearloop.daemon.config_file import load_yaml_model

N_CELLS = 100


def cell_times(fingertip: Fingertip, turns: int) -> dict[str, float]:
    """Return the electrodes, the unknowns, the ms per cell of both parts, and the ns per unknown of a fingertip."""
    mesh = fingertip.mesh()
    forward, of = BatchForwardModel(mesh, fingertip.table), ConductivityModel(mesh)
    # σ of 0.4 heights is positive everywhere.
    sigma, ks = 0.4 * mesh.height_cm, np.linspace(0.3, 0.8, N_CELLS) * mesh.height_cm
    parts = np.full((turns, 2), np.inf)
    for turn in range(turns):
        start = time.process_time()
        cells = np.array([of.conductivity(MODEL, k, sigma) for k in ks.tolist()])
        middle = time.process_time()
        forward.voltages(cells)
        parts[turn] = middle - start, time.process_time() - middle
    conductivity_ms, solve_ms = (1e3 * parts.min(axis=0) / N_CELLS).tolist()
    unknowns = len(mesh.nodes) + mesh.n_electrodes
    return {
        "electrodes": mesh.n_electrodes,
        "unknowns": unknowns,
        "conductivity_ms": conductivity_ms,
        "solve_ms": solve_ms,
        "ns_per_unknown": 1e6 * (conductivity_ms + solve_ms) / unknowns,
    }


def main() -> None:
    """Measure all and write the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("fingertips", type=Path, nargs="+")
    parser.add_argument("--turns", type=int, default=7)
    args = parser.parse_args()
    found = {}
    for path in args.fingertips:
        fingertip = load_yaml_model(path, FingertipGeometryConfig).fingertip()
        found[path.name] = cell_times(fingertip, args.turns)
        if isinstance(fingertip, RectangularFingertip):
            half = replace(fingertip, electrodes=fingertip.electrodes[::2])
            found[f"{path.name}, every second electrode"] = cell_times(half, args.turns)
    print(write_figures(args.out, found))


if __name__ == "__main__":
    main()
