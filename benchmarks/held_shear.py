"""The daemon's own loop around the emulated skin in virtual time, over gains, delays and normal forces.

What is measured with it and why is told in `benchmarks/skin_loop.py`; the chart is in
`daemon/analysis/charts/limit_cycle.py`.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin.calibration import SkinCalibration
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.loop_inputs import ArmStatus, TorqueSample, TorqueSource
from shearloop.daemon.control.settings import LoopConfig
from shearloop.daemon.control.step_runner import Action, ExperimentPhase, Tare
from shearloop.daemon.sensing.skin_estimator import SkinEstimator
from shearloop.daemon.sensing.skin_task import SKIN, skin_torque
from shearloop.daemon.synthetic_skin import SyntheticSkin, SyntheticSkinSettings
from shearloop.drivers.emulators.skin.daq import NOISE_V
from shearloop.drivers.shear_skin.judge import SkinSample

TICK_S, SAMPLE_TICKS = 0.008, 12.5
# What a reading takes from the middle of its conversion to the controller, and a speed until the wrist has it.
AGE_S, ACTUATION_TICKS = 0.06, 2
# A reading of a quarter of a second ago is stale: the loop holds, and there is no loop any more.
AGES_S = (0.02, 0.06, 0.1, 0.15, 0.2)
RADIUS_MM, SET_POINTS_N = 15.0, (1.0, 0.6, 1.0)
CALIBRATION = Path(__file__).parents[1] / "config" / "calibrations" / "skin_demo.yaml"
SOURCE = TorqueSource(name=SKIN, period_s=SAMPLE_TICKS * TICK_S, has_friction_band=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One run: the loop's gain and deadband, the normal force that is and the one that is configured."""

    name: str
    kp: float = 0.5
    normal_n: float = 1.0
    configured_n: float | None = None
    deadband_nm: float = 0.0003
    # Whether the estimator takes friction out, and whether the loop is told the band that friction leaves.
    knows_friction: bool = True
    band: bool = True
    age_s: float = AGE_S
    seed: int = 0
    # Of each hold, of which the last three fifths count.
    hold_s: float = 20.0


@dataclass(frozen=True, slots=True)
class Held:
    """What came of it, in N: the widest remaining oscillation and the largest mean distance from a set point."""

    case: Case
    width_n: float
    offset_n: float
    bound_n: float
    phase: str


class SkinLoop:
    """The daemon's loop around the emulated skin, tick by tick; nothing is waited for."""

    def __init__(self, case: Case, calibration: SkinCalibration) -> None:
        """Put the tool on the skin, and everything at rest."""
        self._random = np.random.default_rng(case.seed)
        settings = SyntheticSkinSettings(radius_mm=RADIUS_MM, normal_n=case.normal_n)
        self.skin = SyntheticSkin(settings, seed=case.seed)
        configured_n = case.normal_n if case.configured_n is None else case.configured_n
        if not case.knows_friction:
            calibration = replace(calibration, friction=0.0)
        self.estimator = SkinEstimator(calibration, normal_n=configured_n)
        # Every margin is allowed here: where the boundary lies is what is asked.
        config = LoopConfig.model_validate(
            {
                **{"kp": case.kp, "deadband_nm": case.deadband_nm, "jump_nm": 0.006, "slip_nm": 0.006},
                **{"gain_margin": 1.0, "phase_margin_deg": 0.0},
            }
        )
        self._band, self._hold_s, self._age_s = case.band, case.hold_s, case.age_s
        self.brain = ControlLoop(config, {SKIN: replace(SOURCE, has_friction_band=case.band)}, ())
        self._speeds = deque([0.0] * ACTUATION_TICKS)
        self._angle_rad = 0.0
        self._tick = self._samples = 0
        self._due: list[tuple[int, TorqueSample]] = []
        self._zero_begun = False
        self.truth_n: list[float] = []
        self.estimate_n: list[float] = []
        self.set_point_n: list[float] = []

    @property
    def t_ns(self) -> int:
        """The virtual time."""
        return round(self._tick * TICK_S * 1e9)

    def run(self, most_s: float) -> str:
        """Run the experiment of this bench to its end; return how it ended."""
        for _ in range(50):
            self._step()
        why = self.brain.start(_experiment(self._hold_s), self.t_ns)
        if why:
            raise RuntimeError(why)
        experiment = self.brain.experiment
        while experiment is not None and experiment.running and self._tick * TICK_S < most_s:
            self._step()
        if experiment is None:
            raise RuntimeError("no experiment was begun")
        return (
            experiment.phase.value
            if experiment.phase is ExperimentPhase.DONE
            else f"{experiment.phase.value}: {experiment.stop_reason}"
        )

    def _step(self) -> None:
        self._tick += 1
        self._angle_rad += self._speeds.popleft() * TICK_S
        self.skin.turn(self._angle_rad)
        if self._tick * TICK_S >= self._samples * SOURCE.period_s:
            self._samples += 1
            self._measure()
        while self._due and self._due[0][0] <= self.t_ns:
            torque = self._due.pop(0)[1]
            self.brain.on_torque(torque)
            if self._zero_begun and self.estimator.zero is not None:
                self._zero_begun = False
                self.brain.on_action_ended()
        self.brain.inputs.arm = ArmStatus(self._angle_rad, self.t_ns)
        orders = self.brain.tick(self.t_ns)
        speed = 0.0 if orders.stop else orders.wrist_rad_per_s
        self.brain.on_speed_sent(speed)
        self._speeds.append(speed)
        self._begin(orders.action)
        controller = self.brain.controller
        wanted_nm = controller.state.set_point_nm if controller is not None else None
        self.truth_n.append(self.skin.shear_n)
        self.set_point_n.append(math.nan if wanted_nm is None else wanted_nm / RADIUS_MM * 1e3)

    def _begin(self, action: Action | None) -> None:
        if isinstance(action, Tare):
            self.estimator.tare()
            self._zero_begun = True

    def _measure(self) -> None:
        self.skin.rest(SOURCE.period_s)
        noise = self._random.normal(0.0, NOISE_V / 0.125, 2)
        r1, r2 = (ohm * (1.0 + error) for ohm, error in zip(self.skin.resistances_ohm(), noise, strict=True))
        now_ns, known_ns = self.t_ns, self.t_ns + round(self._age_s * 1e9)
        reading = self.estimator.update(SkinSample(r1, r2, 0.0, 0.0, 5e-3, now_ns, known_ns, self._samples))
        torque = skin_torque(reading, RADIUS_MM * 1e-3, now_ns, known_ns)
        if not self._band:
            torque = replace(torque, low_nm=None, high_nm=None)
        self._due.append((known_ns, torque))
        self.estimate_n += [math.nan if reading.shear_n is None else reading.shear_n] * round(
            self._tick - len(self.estimate_n)
        )


def _experiment(hold_s: float) -> ExperimentFile:
    holds = [
        {"do": "hold_torque", "torque_nm": n * RADIUS_MM * 1e-3, "ramp_nm_per_s": 0.005, "hold_s": hold_s}
        for n in SET_POINTS_N
    ]
    steps = [{"do": "tare"}, {"do": "identify", "amplitude_rad": 0.1}, *holds]
    return ExperimentFile.model_validate({"name": "bench", "drive": "skin", "steps": steps, "limits": {"angle_rad": 1}})


def holds_of(loop: SkinLoop, settled_s: float) -> list[FloatArray]:
    """Return the true force over the settled end of each hold, in the order of the set points."""
    set_points, truth = np.array(loop.set_point_n), np.array(loop.truth_n)
    set_points = np.round(set_points, 6)
    changes = np.flatnonzero(np.diff(np.nan_to_num(set_points, nan=-1.0))) + 1
    ends = [*changes.tolist(), len(truth)]
    settled = round(settled_s / TICK_S)
    return [truth[end - settled : end] for begin, end in pairwise(ends) if np.isfinite(set_points[begin])]


def judge(case: Case, calibration: SkinCalibration) -> tuple[Held, SkinLoop]:
    """Run one case."""
    loop = SkinLoop(case, calibration)
    phase = loop.run(200.0)
    bound_n = 2.0 * loop.skin.membrane.friction * case.normal_n
    found = holds_of(loop, 0.6 * case.hold_s)
    if phase != ExperimentPhase.DONE.value or len(found) != len(SET_POINTS_N):
        return Held(case, math.nan, math.nan, bound_n, phase), loop
    width_n = max(float(np.ptp(truth)) for truth in found)
    offset_n = max(abs(float(truth.mean()) - wanted) for truth, wanted in zip(found, SET_POINTS_N, strict=True))
    return Held(case, width_n, offset_n, bound_n, phase), loop


# The whole range that a configuration may ask for: with 1 each reading is believed outright.
GAINS = (0.05, 0.15, 0.5, 1.0)
NORMALS_N = (0.5, 1.0, 2.0)
SEEDS = 3
KINDS = (
    *(Case(name=f"Fn = {n:g} N", normal_n=n) for n in NORMALS_N),
    Case(name="Fn = 1 N, no deadband", deadband_nm=0.0),
    Case(name="Fn = 2 N, configured as 1 N", normal_n=2.0, configured_n=1.0),
    Case(name="Fn = 1 N, loop not told the band", band=False),
    Case(name="Fn = 1 N, friction ignored", knows_friction=False, band=False),
)


def over_gains() -> list[Case]:
    """Return every kind of case at every gain."""
    return [replace(kind, kp=kp, seed=10 * seed) for seed, kind in enumerate(KINDS) for kp in GAINS]


def over_delays() -> list[Case]:
    """Return loops that are told the band and not, at the usual and the highest gain, with older and older readings."""
    told = Case(name="told the band")
    not_told = Case(name="not told the band", band=False)
    return [
        replace(kind, name=f"{kind.name}, kp = {kp:g}", kp=kp, age_s=age_s)
        for kind in (told, not_told)
        for kp in (0.5, 1.0)
        for age_s in AGES_S
    ]


def worst(calibration: SkinCalibration, case: Case) -> Held:
    """Return the widest oscillation and the largest offset over several noises; or the run that broke off."""
    found = [judge(replace(case, seed=case.seed + seed), calibration)[0] for seed in range(SEEDS)]
    broken = next((held for held in found if math.isnan(held.width_n)), None)
    if broken is not None:
        return broken
    width_n, offset_n = max(held.width_n for held in found), max(held.offset_n for held in found)
    return replace(found[0], width_n=width_n, offset_n=offset_n)
