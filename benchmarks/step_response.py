"""A torque step on the emulated rig's physics, judged on the true torque over many seeds.

    python -m benchmarks.step_response --out run/step_response.json [--seeds 200]
        [--bank run/demo.bank [--calibration SEED]]

For each seed the gel has another stiffness. The loop identifies it with the torque that drives, then steps to
0.10 N·m. A fingertip errs by 0.012 N·m a frame. Then a screw is tightened to 0.12 N·m on the load cell. With `--bank`
the default estimator also closes the loop on the rig's own frames from both fingertips, for 20 grips. Then the torque
is kicked by 0.03 N·m up and down, and the tool slips. Simulated time, so the numbers are the same on every machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import parser_of, write_figures
from shearloop.bank.arrays import FloatArray
from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.torque_controller import TorqueController
from shearloop.daemon.summary_text import BAND
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.emulated_rig import SIDES
from shearloop.emulators.gripper import Gripper
from shearloop.emulators.scene import Joint, Scene, Twin, TwinSettings
from shearloop.emulators.synthetic_frames import RigFrames
from shearloop.estimation import Calibration, Session, TactileFrame
from shearloop.studies.charts import simulated_loop as sim
from shearloop.studies.emulated_calibration import ACTIVATE, GRIP, IDLE_S, SETTLE_S, calibrate, lines_of, record
from shearloop.tools.creep import Stretch, fit_creep

TARGET_NM = 0.10
# The stiffness of possible gels; the emulated rig's is 0.8.
GEL_NM_PER_RAD = (0.5, 1.1)
# A stiff gel needs less travel for its identification.
AMPLITUDE_RAD = 0.12
TWIN_SCENARIOS = tuple(replace(one, excite=replace(one.excite, amplitude_rad=AMPLITUDE_RAD)) for one in sim.SCENARIOS)
# The shipped experiments' grip force.
GRIP_FORCE_N = 60.0
# The recording for the creep's calibration: ten twists of 40 s and the rests between them.
CREEP_S = 600.0
# Kicks while the torque is held, the time that each gets, and the torque that is left after a slip.
KICKS_NM, KICKED_S, SLIPS_TO_NM = (-0.03, 0.03), 10.0, 0.02
# As config/experiments/tighten.yaml.
TIGHTEN_NM, TIGHTEN_RAD_PER_S = 0.12, 0.05
DIAMETER_MM = 25.0


@dataclass(slots=True)
class TwinPlant(sim.Plant):
    """The emulated rig's physics as a plant: a gel that creeps and lags, a grip that slips, a lever.

    With `sees_gel` the sensor is a fingertip and sees the gel's shear; otherwise it sees the torque. `creep` corrects
    each sample for the gel's creep, as the loop does.
    """

    twin: Twin = field(default_factory=Twin)
    sees_gel: bool = True
    creep: Creep | None = None

    def collect(self) -> list[sim.PlantSample]:
        """Return the measurements that have become known, each once."""
        known = sim.Plant.collect(self)
        if self.creep is None:
            return known
        return [
            replace(sample, torque_nm=self.creep.torque_nm(sample.torque_nm, round(sample.t_mid_s * 1e9)))
            for sample in known
        ]

    def _update_torque(self) -> None:
        self.twin.kick_nm = self.disturbance_nm
        self.torque_nm = self.twin.step(self.period_s, self.angle_rad, GRIP_FORCE_N).torque_nm

    def _update_reading(self) -> None:
        state = self.twin.state
        self._reading.torque_nm = state.shear_torque_nm if self.sees_gel else state.torque_nm


@dataclass(slots=True)
class RigPlant(sim.Plant):
    """The emulated rig with both boards' frames as a plant; an estimator's torques are the measurements."""

    frames: RigFrames = field(kw_only=True)
    tracker: Session = field(kw_only=True)
    scene: Scene = field(init=False)
    not_valid: int = 0
    estimated: int = 0
    outside_interval: int = 0

    def __post_init__(self) -> None:
        """Activate the gripper, stay idle, grip, and let the gel settle."""
        sim.Plant.__post_init__(self)
        gripper = Gripper(object_mm=DIAMETER_MM)
        self.scene = Scene(gripper)
        gripper.write(ACTIVATE)
        while gripper.sta != 3:
            self.step(0.0)
        self._rest(IDLE_S)
        gripper.write(GRIP)
        self._rest(SETTLE_S)
        self.not_valid = self.estimated = self.outside_interval = 0

    def _rest(self, seconds: float) -> None:
        for _ in range(round(seconds / self.period_s)):
            self.step(0.0)
        self._samples.clear()

    def _update_torque(self) -> None:
        self.scene.step(self.period_s, self.angle_rad)
        self.torque_nm = self.scene.twin.state.torque_nm

    def _measure(self) -> None:
        self.t_s += self.period_s
        if self.t_s < self._reading.ends_s:
            return
        self._reading.ends_s += FRAME_PERIOD_S
        lines, t_mid_s = lines_of(self.scene, self.frames), self.t_s - FRAME_PERIOD_S / 2
        true_nm = self.scene.conversion_nm(FRAME_PERIOD_S)
        estimate = self.tracker.estimate(
            TactileFrame.of(t_mid_s, np.array([PAPER_TABLE.channels_of_line(one) for one in lines]))
        )
        if estimate.torque_nm is None or estimate.torque_low_nm is None or estimate.torque_high_nm is None:
            self.not_valid += 1
            return
        self.estimated += 1
        self.outside_interval += not estimate.torque_low_nm <= true_nm <= estimate.torque_high_nm
        self._samples.append(sim.PlantSample(estimate.torque_nm, t_mid_s, self.t_s + self.sensor.transfer_s))

    def disturb(self, controller: TorqueController) -> tuple[list[float], float]:
        """Kick the held torque, then let the tool slip; return how long each took to come back, and to be found, in s.

        Infinite where that did not happen. The kicks come at different times within a frame.
        """
        back_s = []
        for kick_nm in KICKS_NM:
            sim.run(self, controller, float(self.rng.uniform(0.0, FRAME_PERIOD_S)))
            self.scene.kick(kick_nm)
            back_s.append(sim.run(self, controller, KICKED_S).back_after_s(TARGET_NM))
        self.scene.slip(SLIPS_TO_NM)
        slipped_s = self.t_s
        while not controller.filter.slipped and self.t_s < slipped_s + KICKED_S:
            sim.run(self, controller, self.period_s)
        return back_s, self.t_s - slipped_s if controller.filter.slipped else np.inf


def step(plant: sim.Plant, scenario: sim.LoopScenario) -> tuple[FloatArray, TorqueController]:
    """Identify the tool and step to TARGET_NM; return the true torques, and the controller."""
    found = sim.identified(plant, scenario)
    controller = sim.started_controller(plant, found, sim.settings_for(found, scenario))
    while controller.filter.fresh_ns is None:
        sim.run(plant, controller, plant.period_s)
    controller.change_set_point(TARGET_NM)
    return sim.run(plant, controller, scenario.hold_s).torque_nm, controller


def judge_steps(rows: Sequence[FloatArray], settled_s: float) -> dict[str, float]:
    """Return the figures of merit of true torques, one row per seed, after the step at time 0."""
    # Rounding of the time makes some rows one sample longer.
    error = np.array([row[: min(map(len, rows))] for row in rows]) / TARGET_NM - 1.0
    late = error[:, round(settled_s / sim.PERIOD_S) :]
    inside = np.abs(late) <= BAND
    return {
        "seeds": float(len(error)),
        "in_band_at_settling_time_share": float(inside[:, 0].mean()),
        "time_in_band_worst_seed": float(inside.mean(axis=1).min()),
        "time_in_band_mean": float(inside.mean()),
        "overshoot_worst_seed": float(error.max()),
        "mean_error": float(late.mean()),
        "mean_error_worst_seed": float(np.abs(late.mean(axis=1)).max()),
    }


@cache
def calibrated_creep() -> Creep:
    """Return the creep that ten held twists of one gel reveal, with the load cell: a fingertip's calibration."""
    rng = np.random.default_rng(26)
    plants = [TwinPlant(sim.SimulatedTool(), each, rng) for each in (sim.EIT, sim.LOAD_CELL)]
    plants[1].sees_gel = False
    series: list[FloatArray] = []
    for plant in plants:
        rows: list[tuple[float, float]] = []
        while plant.t_s < CREEP_S:
            wanted_rad = 0.15 if plant.t_s % 60.0 < 40.0 else 0.0
            plant.step(5.0 * (wanted_rad - plant.angle_rad))
            rows += [(sample.t_mid_s, sample.torque_nm) for sample in plant.collect()]
        series.append(np.array(rows))
    (eit_s, shear_nm), (load_s, load_nm) = (table.T for table in series)
    return fit_creep([Stretch(eit_s, shear_nm, np.interp(eit_s, load_s, load_nm))], scale_is_right=True).creep


def rig_twin(sensor: sim.SimulatedSensor, rng: np.random.Generator) -> sim.Plant:
    """Return the rig's physics with a gel of random stiffness."""
    sees_gel = sensor is sim.EIT
    creep = Creep(calibrated_creep().share, calibrated_creep().time_s) if sees_gel else None
    twin = Twin(TwinSettings(gel_stiffness_nm_per_rad=float(rng.uniform(*GEL_NM_PER_RAD))))
    return TwinPlant(sim.SimulatedTool(), sensor, rng, twin=twin, sees_gel=sees_gel, creep=creep)


def tightened(seed: int) -> tuple[float, float]:
    """Return how far a screw ends beyond its target in N·m, and how far one load cell sample lets the torque travel."""
    rng = np.random.default_rng((25, seed))
    settings = TwinSettings(
        gel_stiffness_nm_per_rad=float(rng.uniform(*GEL_NM_PER_RAD)), joint=Joint.TIGHTENING, tightening_nm_per_rad=0.15
    )
    plant = TwinPlant(sim.SimulatedTool(), sim.LOAD_CELL, rng, twin=Twin(settings), sees_gel=False)
    latest_nm = 0.0
    while latest_nm < TIGHTEN_NM:
        plant.step(-TIGHTEN_RAD_PER_S)
        for sample in plant.collect():
            latest_nm = -sample.torque_nm
    # The robot still carries out the speeds sent before the stop.
    for _ in range(round(1.0 / sim.PERIOD_S)):
        plant.step(0.0)
    # A fresh gel and the joint, in series.
    stiffness = 1.0 / (1.0 / settings.gel_stiffness_nm_per_rad + 1.0 / settings.joint_stiffness_nm_per_rad)
    return -plant.torque_nm - TIGHTEN_NM, stiffness * TIGHTEN_RAD_PER_S * sim.LOAD_CELL.period_s


def measure(seeds: int) -> dict[str, Any]:
    """Return the figures of the steps by scenario, and of the screws."""
    numbers: dict[str, Any] = {}
    for scenario in TWIN_SCENARIOS:
        plants = [rig_twin(scenario.sensor, np.random.default_rng((20, seed))) for seed in range(seeds)]
        numbers[scenario.name] = judge_steps([step(plant, scenario)[0] for plant in plants], scenario.settled_s)
    beyond_nm, travel_nm = np.array([tightened(seed) for seed in range(seeds)]).T
    numbers["tighten"] = {
        "beyond_target_nm_worst": float(np.abs(beyond_nm).max()),
        "one_samples_travel_nm": [float(travel_nm.min()), float(travel_nm.max())],
        "within_share": float(np.mean(np.abs(beyond_nm) <= 0.005 + travel_nm)),
    }
    return numbers


def rig_calibration(bank: Path, seed: int) -> Calibration:
    """Return the default estimator's calibration of both fingertips on the rig's frames."""
    return calibrate(list(record(bank, seed, (DIAMETER_MM,))), tuple(SIDES))


def estimator_in_the_loop(bank: Path, calibration: Calibration, seeds: Sequence[int]) -> dict[str, float]:
    """Return the figures of merit of a step driven by the default estimator."""
    scenario = replace(TWIN_SCENARIOS[0], hold_s=30.0)
    rows, plants, back_s, found_s = [], [], [], []
    for seed in seeds:
        plant = RigPlant(
            sim.SimulatedTool(), sim.EIT, np.random.default_rng((30, seed)),
            frames=RigFrames(bank, seed), tracker=Session(calibration),
        )  # fmt: skip
        torque_nm, controller = step(plant, scenario)
        rows.append(torque_nm)
        plants.append(plant)
        back, found = plant.disturb(controller)
        back_s += back
        found_s.append(found)
    estimated, not_valid = sum(one.estimated for one in plants), sum(one.not_valid for one in plants)
    return judge_steps(rows, scenario.settled_s) | {
        "not_valid_share": not_valid / (estimated + not_valid),
        "coverage_95": 1.0 - sum(one.outside_interval for one in plants) / estimated if estimated else np.nan,
        "kick_back_s_median": float(np.median(back_s)),
        "kick_back_s_worst": max(back_s),
        "slip_found_s_worst": max(found_s),
    }


def main() -> None:
    """Measure and write the numbers."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--bank", type=Path, help="the emulated rig's bank, to close the loop with the estimator too")
    parser.add_argument(
        "--calibration",
        type=int,
        default=7,
        metavar="SEED",
        help="of the estimator's calibration (default: %(default)s)",
    )
    args = parser.parse_args()
    numbers = measure(args.seeds)
    if args.bank is not None:
        calibration = rig_calibration(args.bank, args.calibration)
        numbers["estimator"] = estimator_in_the_loop(args.bank, calibration, range(20))
    print(write_figures(args.out, numbers))


if __name__ == "__main__":
    main()
