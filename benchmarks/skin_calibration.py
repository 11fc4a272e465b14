"""The calibration of the emulated shear skin, made as a real one's is: loadings, a table, a fit.

`python -m benchmarks.skin_calibration` plays loops to ± 1.2 N and ± 5 N under three normal forces with the paper's
noise,
writes the table that a bench would record, and fits `config/calibrations/skin_demo.yaml` to it.
"""

import argparse
from pathlib import Path

import numpy as np

from shearloop.bank.skin.calibration_file import COLUMNS, read_table, save_calibration
from shearloop.bank.skin.calibration_fit import fit_calibration
from shearloop.daemon.synthetic_skin import SyntheticSkin, calibration_table
from shearloop.drivers.emulators.skin import NOISE_V

# The noise of one gauge, relative to the 0.125 V across it.
NOISE = NOISE_V / 0.125


def main() -> None:
    """Play, write, fit, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, default=Path("run/skin_demo.csv"), help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=Path("config/calibrations/skin_demo.yaml"))
    args = parser.parse_args()
    args.table.parent.mkdir(parents=True, exist_ok=True)
    table = calibration_table(SyntheticSkin(), NOISE)
    rows = np.column_stack([getattr(table, name) for name in COLUMNS])
    np.savetxt(args.table, rows, fmt="%.6f", delimiter=",", header=",".join(COLUMNS), comments="")
    calibration = fit_calibration(read_table(args.table))
    save_calibration(calibration, args.out)
    print(f"{len(rows)} rows: friction {calibration.friction:.4f}, {calibration.slope_per_n:.4f} /N -> {args.out}")


if __name__ == "__main__":
    main()
