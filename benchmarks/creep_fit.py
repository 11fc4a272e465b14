"""How well ten held twists tell a gel's creep: `python -m benchmarks.creep_fit`.

The rig's own gel is twisted as `config/experiments/held_twists.yaml` does, and read with noise. For each noise, over
many seeds: the lowest, the mean and the highest share and time constant that `calibrate creep` would print.
"""

import argparse
import json

import numpy as np

from shearloop.daemon.control.creep import Stretch, fit_creep
from shearloop.drivers.eit_kit import FRAME_PERIOD_S
from shearloop.drivers.emulators.scene import Twin, TwinSettings

TWISTED_RAD, HELD_S, TWISTS = 0.15, 40.0, 10
NOISES_NM = (0.003, 0.006, 0.012)


def twisted() -> Stretch:
    """Return what a fingertip without noise would say of the gel's shear, beside its torque."""
    twin = Twin(TwinSettings(hysteresis_rad=0.0))
    t_s = np.arange(0.0, 2.0 * HELD_S * TWISTS, FRAME_PERIOD_S)
    states = [twin.step(FRAME_PERIOD_S, TWISTED_RAD if t % (2 * HELD_S) < HELD_S else 0.0, 60.0) for t in t_s.tolist()]
    return Stretch(
        t_s, np.array([state.shear_torque_nm for state in states]), np.array([state.torque_nm for state in states])
    )


def told(clean: Stretch, noise_nm: float, seed: int) -> tuple[float, float]:
    """Return share and time constant (s) from readings with noise."""
    noise = np.random.default_rng((31, seed, round(1e6 * noise_nm))).normal(0.0, noise_nm, clean.t_s.size)
    found = fit_creep([Stretch(clean.t_s, clean.shear_nm + noise, clean.torque_nm)]).creep
    return found.share, found.time_s


def main() -> None:
    """Fit, and print as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    clean, own = twisted(), TwinSettings()
    rows = {}
    for noise_nm in NOISES_NM:
        found = np.array([told(clean, noise_nm, seed) for seed in range(args.seeds)])
        rows[f"{noise_nm:g} N·m"] = {
            name: dict(zip(("low", "mean", "high"), np.round([each.min(), each.mean(), each.max()], 3), strict=True))
            for name, each in zip(("share", "time_s"), found.T, strict=True)
        }
    print(json.dumps({"seeds": args.seeds, "true": [own.relaxing_share, own.relaxation_s], **rows}, indent=1))


if __name__ == "__main__":
    main()
