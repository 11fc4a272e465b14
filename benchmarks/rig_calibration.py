"""Calibrates the emulated rig's fingertip: `python -m benchmarks.rig_calibration --bank run/demo.bank --out FILE`.

A real fingertip is calibrated on recordings. The emulated one is calibrated in the same way on its own frames, at
torques that are known because it made them: each is matched as the daemon does, and the curves are fitted.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.calibration import Calibration
from shearloop.bank.eit.channels import channels_of_line
from shearloop.bank.eit.matching import ReferenceMatcher, best_match
from shearloop.daemon.synthetic import frame_maker

TORQUES_NM = np.linspace(-0.06, 0.18, 49)
DIAMETERS_MM = (10.0, 20.0, 30.0, 40.0)
BASELINE_FRAMES = 10
REPEATS = 3


def calibrate(bank_path: Path, seed: int) -> Calibration:
    """Return the calibration of the emulated fingertip on a bank."""
    bank = Bank.open(bank_path)
    matcher = ReferenceMatcher.from_bank(bank)
    make = frame_maker(bank_path, seed)

    def channels(grip: float, torque_nm: float, diameter_mm: float) -> NDArray[np.float64]:
        return channels_of_line(make(np.full(32, grip), np.full(32, torque_nm), diameter_mm))

    homogeneous = np.mean([channels(0.0, 0.0, 30.0) for _ in range(BASELINE_FRAMES)], axis=0)
    cases = [(torque, diameter) for torque in TORQUES_NM for diameter in DIAMETERS_MM for _ in range(REPEATS)]
    differences = np.array([channels(1.0, torque, diameter) - homogeneous for torque, diameter in cases])
    found = [best_match(heatmap, bank.k_grid, bank.sigma_grid) for heatmap in matcher.heatmaps(differences)]
    torque_nm, diameter_mm = np.array(cases).T
    return Calibration.fit(
        bank.identity,
        "the emulated rig's own frames, by python -m benchmarks.rig_calibration",
        torque=(np.array([match.sigma for match in found]), torque_nm),
        diameter=(np.array([match.k for match in found]), diameter_mm),
    )


def main() -> None:
    """Write the calibration and print what it is worth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    calibration = calibrate(args.bank, args.seed)
    calibration.save(args.out)
    torque, diameter = calibration.torque_fit, calibration.diameter_fit
    if torque is not None and diameter is not None:
        print(f"torque ± {torque.residual_std:.4f} N·m, diameter ± {diameter.residual_std:.1f} mm (std of one frame)")


if __name__ == "__main__":
    main()
