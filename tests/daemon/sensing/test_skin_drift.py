"""The drift that a skin's zeros show: friction, noise and a hand are none, and a real one is in the interval.

The truth of each simulation is known: the skin's load, and the drift that is added to one of its gauges.
"""

from pathlib import Path
from random import Random

import pytest

from shearloop.daemon.sensing.skin_drift import MEMORY_S, SHORTEST_S, DriftLearner
from shearloop.daemon.sensing.skin_estimator import SkinEstimator
from shearloop.drivers.defaults import DRIFT_PER_HOUR
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.estimation.skin.calibration import SkinCalibration, load_calibration

ZERO_SAMPLES, NOISE, PERIOD_S = 20, 1e-4, 0.1
# The largest change of a gauge at rest: the daemon refuses zeros that differ by 2 % from the calibration.
LARGEST_CHANGE = 0.012
EXPLAINED = 0.009


@pytest.fixture(scope="module")
def calibration() -> SkinCalibration:
    return load_calibration(Path(__file__).parents[3] / "config" / "calibrations" / "skin_demo.yaml")


class DriftingSkin:
    """A skin under the normal force of its calibration, one gauge of which drifts up and down at a constant rate."""

    def __init__(self, calibration: SkinCalibration, per_hour: float = 0.0, seed: int = 0) -> None:
        self.skin = SyntheticSkin(normal_n=1.0, seed=seed)
        self.estimator = SkinEstimator(calibration, normal_n=1.0, zero_samples=ZERO_SAMPLES)
        self.time_s = 0.0
        self.random = Random(seed)
        self._per_s = per_hour / 3600.0
        self.tare()

    def drifted(self) -> float:
        """Return the gauge's change since the calibration: it rises, falls and rises between two ends."""
        phase = (self._per_s * self.time_s / LARGEST_CHANGE + 1.0) % 4.0
        return LARGEST_CHANGE * (min(phase, 4.0 - phase) - 1.0)

    def rest(self, seconds: float) -> None:
        self.time_s += seconds
        self.skin.rest(seconds)

    def push(self, shear_n: float, readings: int = 5) -> bool:
        """Load the skin; return whether the last interval holds the force."""
        self.skin.push(shear_n)
        for _ in range(readings):
            self.time_s += PERIOD_S
            r1, r2 = self.skin.resistances_ohm()
            r1 *= 1.0 + self.drifted()
            r1, r2 = (ohm * (1.0 + self.random.gauss(0.0, NOISE)) for ohm in (r1, r2))
            t_ns = round(self.time_s * 1e9)
            reading = self.estimator.update(SkinSample(r1, r2, t_ns, t_ns, 0, paused=True))
        interval = reading.interval
        return interval is None or interval.low_n <= shear_n <= interval.high_n

    def tare(self, shear_n: float = 0.0) -> None:
        self.estimator.tare()
        self.push(shear_n, ZERO_SAMPLES)
        assert self.estimator.zero is not None


def test_what_friction_leaves_after_opposite_loads_is_no_drift(calibration):
    skin = DriftingSkin(calibration)
    for load_n in (1.0, -1.0) * 3:
        skin.push(load_n)
        skin.push(0.0)
        skin.tare()
        skin.rest(10.0)
    assert skin.estimator.drift_per_hour == pytest.approx(DRIFT_PER_HOUR)
    skin.rest(SHORTEST_S)
    skin.push(1.0)
    skin.push(0.0)
    skin.tare()
    assert skin.estimator.drift_per_hour == pytest.approx(DRIFT_PER_HOUR)
    assert not skin.estimator.drift_warning


@pytest.mark.parametrize("apart_s", [15.0, 1.2 * SHORTEST_S])
@pytest.mark.parametrize("touched", [0, 1, 2])
def test_a_hand_during_one_tare_is_forgotten_after_clean_ones(calibration, apart_s, touched):
    skin = DriftingSkin(calibration)
    for number in range(5):
        skin.rest(apart_s)
        skin.tare(0.22 if number == touched else 0.0)
    assert skin.estimator.drift_per_hour == pytest.approx(DRIFT_PER_HOUR)


def test_a_drift_is_learnt_said_with_its_cure_and_forgotten_when_it_has_ended():
    learner = DriftLearner(DRIFT_PER_HOUR, EXPLAINED)
    time_s, response = 0.0, 0.0
    for _ in range(6):
        learner.add(time_s, response, 1e-5)
        time_s, response = time_s + 600.0, response + 0.004
    assert learner.per_s == pytest.approx(0.004 / 600.0, rel=0.1)
    assert learner.has_learned
    while time_s < 3000.0 + MEMORY_S + 1200.0:
        learner.add(time_s, response, 1e-5)
        time_s += 600.0
    assert learner.per_s * 3600.0 == pytest.approx(DRIFT_PER_HOUR)
    assert not learner.has_learned


def test_two_zeros_far_apart_show_a_drift_too():
    learner = DriftLearner(DRIFT_PER_HOUR, EXPLAINED)
    learner.add(0.0, 0.0, 1e-5)
    learner.add(5 * MEMORY_S, 0.05, 1e-5)
    assert learner.per_s * 3600.0 == pytest.approx(0.005)


def test_a_drift_is_never_learnt_as_more_than_twice_of_what_is_proved():
    learner = DriftLearner(0.0, EXPLAINED)
    learner.add(0.0, 0.0, 0.0)
    learner.add(SHORTEST_S, 1.1 * EXPLAINED, 0.0)
    assert learner.per_s == pytest.approx(0.2 * EXPLAINED / SHORTEST_S)


def test_the_warning_says_what_the_drift_costs_and_the_cure(calibration):
    skin = DriftingSkin(calibration, per_hour=0.03)
    skin.rest(1400.0)
    skin.tare()
    assert 0.01 < skin.estimator.drift_per_hour < 0.06
    warning = skin.estimator.drift_warning
    assert warning.startswith("the skin drifts, or a zero was taken under load")
    assert " N an hour; tare with nothing on the skin" in warning


@pytest.mark.long
@pytest.mark.parametrize("per_hour", [0.0, 0.002, 0.01, 0.03])
def test_the_interval_holds_the_force_at_drifts_of_known_rates_and_is_not_much_wider(calibration, per_hour):
    """Random loads, and tares at random moments, each after a random load."""
    held, learned = [], []
    for seed in range(6):
        skin = DriftingSkin(calibration, per_hour if seed % 2 else -per_hour, seed)
        due_s, tares = 0.0, 0
        while skin.time_s < 6 * 3600.0:
            skin.rest(skin.random.expovariate(1 / 60.0))
            shear_n = skin.random.uniform(-1.5, 1.5)
            skin.push(0.5 * shear_n)
            holds = skin.push(shear_n)
            if tares >= 3:
                held.append(holds)
            if skin.time_s > due_s:
                skin.push(0.0)
                skin.tare()
                learned.append(skin.estimator.drift_per_hour)
                due_s, tares = skin.time_s + skin.random.expovariate(1 / 600.0), tares + 1
    assert len(held) > 500
    assert sum(held) >= 0.95 * len(held)
    assert max(learned) <= 1.7 * max(per_hour, DRIFT_PER_HOUR)
