"""The loop closed by the default estimator on the emulated rig: `python -m benchmarks.fused_loop --bank run/demo.bank`.

`fused` is calibrated on twists of the rig with one tool, and then drives the twist controller to 0.10 N·m with both
fingertips, on the rig's own physics and frames: gripper, gel, boards, everything but ports and clocks. Simulated time,
so the same numbers on every machine. Each seed grips anew, after idle frames.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.closed_loop import run
from benchmarks.plant import EIT, Plant, Sample, Tool
from benchmarks.rig_twists import ACTIVATE, GRIP, IDLE_S, SETTLE_S, calibrate, lines_of, record
from benchmarks.step_response import PERIOD_S, SOURCES, TARGET_NM, identified, judged, settings_for, started
from benchmarks.twin_step import AMPLITUDE_RAD
from shearloop.bank.eit.channels import channels_of_line
from shearloop.bank.estimation import Calibration, EstimatorSession, TactileFrame
from shearloop.daemon.synthetic import frame_maker
from shearloop.drivers.eit_kit import FRAME_PERIOD_S
from shearloop.drivers.emulators.rig import SIDES, FrameOf
from shearloop.drivers.emulators.robotiq.gripper import Gripper
from shearloop.drivers.emulators.scene import Scene

DIAMETER_MM = 25.0
SETTLED_S, HOLD_S = 6.0, 30.0


@dataclass(slots=True)
class RigPlant(Plant):
    """The emulated rig as the controller's plant: what is measured is what an estimator says of both boards' frames.

    `not_valid` counts the frames that it said nothing of, `outside` the estimates whose interval misses the truth.
    """

    frame_of: FrameOf = field(kw_only=True)
    tracker: EstimatorSession = field(kw_only=True)
    scene: Scene = field(init=False)
    not_valid: int = 0
    estimated: int = 0
    outside: int = 0

    def __post_init__(self) -> None:
        """Activate the gripper, stay idle, grip, and let the gel settle."""
        Plant.__post_init__(self)
        gripper = Gripper(between=lambda _: DIAMETER_MM)
        self.scene = Scene(gripper)
        gripper.command = ACTIVATE
        while gripper.sta != 3:
            self.step(0.0)
        self._still(IDLE_S)
        gripper.command = GRIP
        self._still(SETTLE_S)
        self.not_valid = self.estimated = self.outside = 0

    @property
    def stiffness_nm_per_rad(self) -> float:
        """Return that of gel and joint in series, on a fresh gel."""
        own = self.scene.twin.settings
        return 1.0 / (1.0 / own.gel_stiffness_nm_per_rad + 1.0 / own.joint_stiffness_nm_per_rad)

    def _still(self, seconds: float) -> None:
        for _ in range(round(seconds / self.period_s)):
            self.step(0.0)
        self._samples.clear()

    def _load(self) -> None:
        self.scene.step(self.period_s, self.angle_rad)
        self.torque_nm = self.scene.twin.state.torque_nm

    def _measure(self) -> None:
        self.t_s += self.period_s
        if self.t_s < self._next_end_s:
            return
        self._next_end_s += FRAME_PERIOD_S
        lines, t_mid_s = lines_of(self.scene, self.frame_of), self.t_s - FRAME_PERIOD_S / 2
        true_nm = self.scene.conversion_nm(FRAME_PERIOD_S)
        estimate = self.tracker.estimate(TactileFrame.of(t_mid_s, np.array([channels_of_line(one) for one in lines])))
        if estimate.torque_nm is None or estimate.torque_low_nm is None or estimate.torque_high_nm is None:
            self.not_valid += 1
            return
        self.estimated += 1
        self.outside += not estimate.torque_low_nm <= true_nm <= estimate.torque_high_nm
        self._samples.append(Sample(estimate.torque_nm, t_mid_s, self.t_s + self.sensor.transfer_s))


def calibrated(bank: Path, seed: int, diameters_mm: tuple[float, ...] = (DIAMETER_MM,)) -> Calibration:
    """Return the default's calibration of both fingertips on what the rig plays with these tools."""
    recordings = [recorded.series(mm) for mm, recorded in record(bank, seed, diameters_mm)]
    return calibrate(recordings, tuple(SIDES))


def held(bank: Path, calibration: Calibration, seeds: Sequence[int]) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Return the true torques (seed, time) after the step to TARGET_NM, and what the estimates were worth meanwhile."""
    source = SOURCES[0]
    excite = replace(source.excite, amplitude_rad=AMPLITUDE_RAD)
    rows, plants = [], []
    for seed in seeds:
        plant = RigPlant(
            Tool(), EIT, np.random.default_rng((30, seed)), PERIOD_S,
            frame_of=frame_maker(bank, seed), tracker=EstimatorSession(calibration),
        )  # fmt: skip
        found = identified(plant, replace(source, excite=excite))
        rows.append(run(plant, started(plant, found, settings_for(found, source)), HOLD_S).torque_nm)
        plants.append(plant)
    table = np.array([row[: min(map(len, rows))] for row in rows])
    estimated, not_valid = (
        sum(counts) for counts in zip(*((one.estimated, one.not_valid) for one in plants), strict=True)
    )
    return table, {
        "not_valid_share": not_valid / (estimated + not_valid),
        "coverage_95": 1.0 - sum(plant.outside for plant in plants) / estimated if estimated else np.nan,
        "held_nm_mean": float(table[:, round(SETTLED_S / PERIOD_S) :].mean()),
        "held_nm_worst": float(np.abs(table[:, round(SETTLED_S / PERIOD_S) :].mean(axis=1) - TARGET_NM).max()),
    }


def main() -> None:
    """Calibrate, hold, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("build/fused-loop"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    table, figures = held(args.bank, calibrated(args.bank, 7), range(args.seeds))
    figures |= judged(table, PERIOD_S, SETTLED_S)
    (args.out / "fused_loop.json").write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
