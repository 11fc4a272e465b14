"""Simulates the twist loop: a tool in a soft grip on a turning wrist, and a torque sensor that reads it late.

    wrist speed → actuation delay → angle → relaxing spring → torque → sensor that averages, lags and errs

Simulated time only, in s from 0. Angle and true torque are 0 at the start. All randomness comes from the generator.
"""

import copy
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.experiment import TrackTorque
from shearloop.daemon.control.identification import ExciteSettings, StiffnessExcitation, ToolModel
from shearloop.daemon.control.margins import integral_gain
from shearloop.daemon.control.torque_controller import ControllerSettings, TorqueController, WristCommand
from shearloop.daemon.control.wrist_controller import controller_settings
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.summary_text import BAND, recovered_s
from shearloop.daemon.torques import TorqueSample, TorqueSource
from shearloop.drivers.defaults import FRAME_PERIOD_S

PERIOD_S = 0.008
# The standard deviation of torque that noise may cause; it sets the gain.
ALLOWED_NOISE_NM = 0.0018


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedTool:
    """The gripped tool. At a fixed angle its torque relaxes by `relaxing_share` with time constant `relaxing_s`."""

    stiffness_nm_per_rad: float = 0.25
    relaxing_share: float = 0.06
    relaxing_s: float = 5.0
    actuation_s: float = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedSensor:
    """Measures the mean torque of each period; the value is known `transfer_s` after the period's end.

    Under constant torque the reading falls by `relaxing_share`, and it has play.
    """

    period_s: float
    transfer_s: float
    jitter_s: float = 0.0
    noise_nm: float = 0.0
    relaxing_share: float = 0.0
    relaxing_s: float = 20.0
    play_nm: float = 0.0


EIT = SimulatedSensor(
    period_s=FRAME_PERIOD_S, transfer_s=0.05, jitter_s=0.02, noise_nm=0.012, relaxing_share=0.03, play_nm=0.002
)
LOAD_CELL = SimulatedSensor(period_s=1 / 10.9, transfer_s=0.01, jitter_s=0.005, noise_nm=0.0005)


@dataclass(frozen=True, slots=True)
class PlantSample:
    """One measurement: the torque, the middle of its period, and when it is known."""

    torque_nm: float
    t_mid_s: float
    t_s: float


@dataclass(slots=True)
class _Reading:
    # With play, before relaxation.
    torque_nm: float = 0.0
    relaxed_nm: float = 0.0
    # Of the open period, and its end.
    integral: float = 0.0
    ends_s: float = 0.0


@dataclass(slots=True)
class Plant:
    """Advances by one command period at a time and measures on the way."""

    tool: SimulatedTool
    sensor: SimulatedSensor
    rng: np.random.Generator
    period_s: float = PERIOD_S
    disturbance_nm: float = 0.0
    t_s: float = 0.0
    angle_rad: float = 0.0
    torque_nm: float = 0.0
    _speeds: list[float] = field(default_factory=list)
    _relaxed_nm: float = 0.0
    _reading: _Reading = field(default_factory=_Reading)
    _samples: list[PlantSample] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Start the sensor at a random moment of its period, and fill the actuation delay."""
        self._reading.ends_s = self.sensor.period_s + self.rng.uniform(0.0, self.sensor.period_s)
        self._speeds = [0.0] * (int(self.tool.actuation_s / self.period_s) + 1)

    def step(self, speed_rad_per_s: float) -> None:
        """Send a wrist speed and let one command period pass."""
        part = self.tool.actuation_s / self.period_s % 1.0
        self._speeds.append(speed_rad_per_s)
        earlier = self._speeds.pop(0)
        self.angle_rad += self.period_s * ((1.0 - part) * self._speeds[0] + part * earlier)
        self._update_torque()
        self._measure()

    def collect(self) -> list[PlantSample]:
        """Return the measurements that have become known, each once."""
        known = [sample for sample in self._samples if sample.t_s <= self.t_s]
        self._samples = [sample for sample in self._samples if sample.t_s > self.t_s]
        return known

    def _update_torque(self) -> None:
        tool = self.tool
        elastic_nm = tool.stiffness_nm_per_rad * self.angle_rad
        self._relaxed_nm += (tool.relaxing_share * elastic_nm - self._relaxed_nm) * self.period_s / tool.relaxing_s
        self.torque_nm = elastic_nm - self._relaxed_nm + self.disturbance_nm

    def _update_reading(self) -> None:
        """Apply the sensor's play and relaxation to the present torque."""
        sensor, reading, half_play = self.sensor, self._reading, 0.5 * self.sensor.play_nm
        reading.torque_nm = min(max(reading.torque_nm, self.torque_nm - half_play), self.torque_nm + half_play)
        towards = sensor.relaxing_share * reading.torque_nm - reading.relaxed_nm
        reading.relaxed_nm += towards * self.period_s / sensor.relaxing_s

    def _measure(self) -> None:
        sensor, reading = self.sensor, self._reading
        before_nm = reading.torque_nm - reading.relaxed_nm
        self._update_reading()
        after_nm = reading.torque_nm - reading.relaxed_nm
        start_s, self.t_s = self.t_s, self.t_s + self.period_s
        while True:
            # The part of this step inside the period; the reading changes linearly over the step.
            low, high = max(start_s, reading.ends_s - sensor.period_s), min(self.t_s, reading.ends_s)
            if high > low:
                middle = (0.5 * (low + high) - start_s) / (self.t_s - start_s)
                reading.integral += (before_nm + (after_nm - before_nm) * middle) * (high - low)
            if reading.ends_s > self.t_s:
                return
            mean = reading.integral / sensor.period_s
            noise, late_s = self.rng.normal(0.0, 1.0) * sensor.noise_nm, self.rng.uniform(0.0, 1.0) * sensor.jitter_s
            known_s = reading.ends_s + sensor.transfer_s + late_s
            self._samples.append(PlantSample(mean + noise, reading.ends_s - 0.5 * sensor.period_s, known_s))
            reading.integral = 0.0
            reading.ends_s += sensor.period_s


@dataclass(slots=True)
class UncompensatedController:
    """The twist controller without its delay compensator: it takes each torque for the present one."""

    settings: ControllerSettings
    _set_point_nm: float = 0.0
    _ramp_nm: float = 0.0
    _offset_nm: float = 0.0
    _creep_nm: float = 0.0
    _origin_rad: float | None = None
    _t_ns: int = 0

    def change_set_point(self, torque_nm: float) -> None:
        """Set the torque to reach."""
        self._set_point_nm = torque_nm

    def measure(self, torque: TorqueSample) -> None:
        """Correct the offset by the difference from the present ramp."""
        if torque.torque_nm is None:
            return
        excess = torque.torque_nm - self._ramp_nm
        self._creep_nm += self.settings.ki * excess
        self._offset_nm += self.settings.kp * excess + self._creep_nm

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:
        """Return the speed towards the corrected angle."""
        settings = self.settings
        if self._origin_rad is None:
            self._origin_rad, self._t_ns = wrist_angle_rad, t_ns
        most = settings.ramp_nm_per_s * (t_ns - self._t_ns) / 1e9 if t_ns > self._t_ns else 0.0
        self._t_ns = t_ns
        self._ramp_nm += max(-most, min(most, self._set_point_nm - self._ramp_nm))
        goal = self._origin_rad + (self._ramp_nm - self._offset_nm) / settings.stiffness_nm_per_rad
        speed = settings.wrist_bandwidth_per_s * (goal - wrist_angle_rad)
        return WristCommand(settings.wrist_limit.clip(speed))


LoopController: TypeAlias = TorqueController | UncompensatedController


@dataclass(frozen=True, slots=True)
class Trace:
    """A run: time and true torque (n,) after each command period."""

    t_s: FloatArray
    torque_nm: FloatArray

    def back_after_s(self, target_nm: float) -> float:
        """Return the time until the torque is in its band, and stays; infinite if it does not."""
        return recovered_s(self.t_s, self.torque_nm, target_nm) - float(self.t_s[0])


def nanoseconds(time_s: float) -> int:
    """Return a simulated time in the controller's unit."""
    return round(time_s * 1e9)


def run(
    plant: Plant,
    controller: LoopController,
    duration_s: float,
    keep: Callable[[int], bool] = lambda _: True,
    bound_nm: float = np.inf,
    latest: deque[PlantSample] | None = None,
) -> Trace:
    """Close the loop for a time, or until the torque leaves the bound.

    `keep` drops measurements by their number. The controller gets the mean of the `latest` measurements, by default of
    a single one, stamped with the mean of their times.
    """
    rows: list[tuple[float, float]] = []
    end_s, count = plant.t_s + duration_s, 0
    latest = deque(maxlen=1) if latest is None else latest
    while plant.t_s < end_s and abs(plant.torque_nm) <= bound_nm:
        now_ns = nanoseconds(plant.t_s)
        for sample in plant.collect():
            if keep(count):
                latest.append(sample)
                middles_ns = [nanoseconds(measurement.t_mid_s) for measurement in latest]
                torque_nm = float(np.mean([measurement.torque_nm for measurement in latest]))
                t_mid_ns = round(float(np.mean(middles_ns)))
                controller.measure(TorqueSample("plant", torque_nm, "", t_mid_ns, now_ns))
            count += 1
        command = controller.command(now_ns, plant.angle_rad)
        plant.step(command.speed_rad_per_s)
        rows.append((plant.t_s, plant.torque_nm))
    return Trace(*np.array(rows).T)


@dataclass(frozen=True, slots=True)
class LoopScenario:
    """A torque that drives the loop, and the settings and requirements of a step with it."""

    name: str
    sensor: SimulatedSensor
    settled_s: float
    ramp_nm_per_s: float
    wrist_bandwidth_per_s: float
    excite: ExciteSettings
    hold_s: float

    @property
    def source(self) -> TorqueSource:
        """The sensor as the control loop knows it."""
        return TorqueSource(name=self.name, period_s=self.sensor.period_s, window_s=self.sensor.period_s)


def _excite(dwell_s: float, share: float) -> ExciteSettings:
    return ExciteSettings(amplitude_rad=0.35, torque_limit_nm=0.17, stiffness_share=share, dwell_s=dwell_s)


SCENARIOS = (
    LoopScenario("eit", EIT, 6.0, 0.035, 4.0, _excite(2.5, 0.04), 40.0),
    LoopScenario("load_cell", LOAD_CELL, 2.0, 0.1, 6.0, _excite(0.8, 0.02), 15.0),
)


def identified(plant: Plant, scenario: LoopScenario) -> ToolModel:
    """Return the tool model that the identification step finds; raises RuntimeError where it fails."""
    step = StiffnessExcitation(scenario.excite, scenario.source, LoopConfig())
    while not step.done:
        now_ns = nanoseconds(plant.t_s)
        for sample in plant.collect():
            step.measure(sample.torque_nm, nanoseconds(sample.t_mid_s), now_ns)
        plant.step(step.command(now_ns, plant.angle_rad))
    if step.result is None:
        raise RuntimeError(step.failure)
    return step.result


def settings_for(found: ToolModel, scenario: LoopScenario) -> ControllerSettings:
    """Return the controller's settings for an identified tool, as the control loop chooses them."""
    config = LoopConfig(
        allowed_noise_nm=ALLOWED_NOISE_NM, torque_bandwidth_per_s=scenario.wrist_bandwidth_per_s,
        wrist_speed_rad_per_s=0.8, wrist_acceleration_rad_per_s2=6.0,
    )  # fmt: skip
    return controller_settings(config, found, scenario.source, TrackTorque(0.0, scenario.ramp_nm_per_s))


def started_controller(plant: Plant, found: ToolModel, settings: ControllerSettings) -> TorqueController:
    """Return a twist controller that starts at the plant's present angle."""
    torque = found.torque_nm + found.stiffness_nm_per_rad * (plant.angle_rad - found.angle_rad)
    return TorqueController(settings, nanoseconds(plant.t_s), plant.angle_rad, torque, found.known_measurements)


# The chart's loop panel: how closely the torque follows over how many frames are averaged.
WINDOWS = (1, 2, 3, 4, 6, 9)
# All smoothing is in the window: each mean corrects by this fraction. The tuned controller takes single frames.
GAIN = 0.5
LOOPS = ("twist controller", "no delay compensator", "twist controller, gain tuned to the noise")
# The set point wanders and an unknown load comes and goes; only measurements reveal the load.
_TARGET_NM, _SWING_NM, _SWING_PERIOD_S = 0.10, 0.02, 40.0
_LOAD_NM, _LOAD_PERIOD_S = 0.02, 30.0
_RUN_S, _SETTLING_S, _CHUNK_S, _COMMAND_PERIOD_S = 90.0, 15.0, 0.25, 0.016
_ATTEMPTS = 10


@dataclass(frozen=True, slots=True)
class TrackingError:
    """One loop, noise of a frame and window: the delay of the mean, and the RMS of torque − set point in N·m."""

    loop: str
    noise_nm: float
    frames: int
    delay_s: float
    rms_nm: float
    rms_low_nm: float
    rms_high_nm: float


def tracking_errors(noises_nm: Sequence[float], seeds: int, windows: Sequence[int] = WINDOWS) -> list[TrackingError]:
    """Return the tracking error of every loop and window, for every noise of a single frame."""
    rms: dict[tuple[str, float, int], list[float]] = {}
    for noise in noises_nm:
        scenario = replace(SCENARIOS[0], sensor=replace(EIT, noise_nm=noise))
        for seed in range(seeds):
            gripped, found = _identified_plant(scenario, seed)
            for name in LOOPS:
                for frames in windows if name != LOOPS[2] else (1,):
                    plant = copy.deepcopy(gripped)
                    controller = _controller(name, frames, plant, found, settings_for(found, scenario))
                    rms.setdefault((name, noise, frames), []).append(_rms_error(plant, controller, frames))
    tracked = []
    for (name, noise, frames), errors in rms.items():
        # From the middle of the mean until it is known.
        delay_s = 0.5 * frames * EIT.period_s + EIT.transfer_s
        tracked.append(TrackingError(name, noise, frames, delay_s, float(np.median(errors)), min(errors), max(errors)))
    return tracked


def _identified_plant(scenario: LoopScenario, seed: int) -> tuple[Plant, ToolModel]:
    """Return a plant and its identified tool; an identification that the noise spoils is repeated, as on the rig."""
    rng = np.random.default_rng((31, seed))
    tool = SimulatedTool(stiffness_nm_per_rad=float(rng.uniform(0.2, 0.35)))
    for _ in range(_ATTEMPTS):
        plant = Plant(tool, scenario.sensor, rng, period_s=_COMMAND_PERIOD_S)
        with suppress(RuntimeError):
            return plant, identified(plant, scenario)
    raise RuntimeError(f"the tool cannot be identified at {scenario.sensor.noise_nm:g} N·m of noise")


def _controller(name: str, frames: int, plant: Plant, found: ToolModel, settings: ControllerSettings) -> LoopController:
    if name != LOOPS[2]:
        settings = replace(
            settings, kp=GAIN, ki=integral_gain(GAIN), noise_nm=settings.noise_nm / float(np.sqrt(frames)),
            window_s=settings.window_s + (frames - 1) * found.sample_period_s,
            age_limit_s=settings.age_limit_s + frames * found.sample_period_s,
        )  # fmt: skip
    return UncompensatedController(settings) if name == LOOPS[1] else started_controller(plant, found, settings)


def _rms_error(plant: Plant, controller: LoopController, frames: int) -> float:
    """Return the RMS of true torque − set point in N·m, after settling."""
    begun, squares, n = plant.t_s, 0.0, 0
    latest: deque[PlantSample] = deque(maxlen=frames)
    while plant.t_s - begun < _RUN_S:
        t_s = plant.t_s - begun
        wanted = _TARGET_NM + _SWING_NM * float(np.sin(2 * np.pi * t_s / _SWING_PERIOD_S))
        plant.disturbance_nm = _LOAD_NM * float(np.sin(2 * np.pi * t_s / _LOAD_PERIOD_S))
        controller.change_set_point(wanted)
        torque = run(plant, controller, _CHUNK_S, latest=latest).torque_nm
        if t_s >= _SETTLING_S:
            squares, n = squares + float(((torque - wanted) ** 2).sum()), n + len(torque)
    return float(np.sqrt(squares / n))


# One frame's noise, as of the default estimator on both fingertips of the emulated rig.
_FRAME_NOISE_NM = 0.005
_KICK_NM, _KICK_AT_S, _KICKED_S = -0.03, 15.0, 15.0


def held_loops(seeds: int) -> dict[str, list[tuple[Trace, Trace]]]:
    """Return each loop's step to 0.10 N·m, and what follows a kick, for every seed."""
    scenario = replace(SCENARIOS[0], sensor=replace(EIT, noise_nm=_FRAME_NOISE_NM))
    held: dict[str, list[tuple[Trace, Trace]]] = {}
    for seed in range(seeds):
        gripped, found = _identified_plant(scenario, seed)
        settings = settings_for(found, scenario)
        loops: dict[str, LoopController] = {
            "torque filter": started_controller(gripped, found, settings),
            # Without the noise, the filter has one gain and no test for jumps.
            "constant gain": started_controller(gripped, found, replace(settings, noise_nm=0.0)),
            "latest estimates alone": UncompensatedController(settings),
        }
        for name, loop in loops.items():
            plant = copy.deepcopy(gripped)
            loop.change_set_point(_TARGET_NM)
            before = run(plant, loop, _KICK_AT_S)
            plant.disturbance_nm = _KICK_NM
            held.setdefault(name, []).append((before, run(plant, loop, _KICKED_S)))
    return held


def chart(out: Path, seeds: int = 20) -> list[Path]:
    """Measure, draw and write `loop`: a torque that is held and kicked, with and without the torque filter."""
    from shearloop.tools import drawing

    made = drawing.figure(12.0, 4.4)
    content = {}
    for axes, (name, rows) in zip(made.subplots(1, 3, sharey=True), held_loops(seeds).items(), strict=True):
        settled_nm = [trace.torque_nm[trace.t_s >= trace.t_s[0] + SCENARIOS[0].settled_s] for trace, _ in rows]
        share = float(np.mean(np.abs(np.concatenate(settled_nm) / _TARGET_NM - 1.0) <= BAND))
        back_s = [after.back_after_s(_TARGET_NM) for _, after in rows]
        counted_s = SCENARIOS[0].settled_s, _KICK_AT_S
        content[name] = {"time_in_band": share, "time_in_band_of_s": counted_s, "kick_back_s": back_s}
        for before, after in rows:
            t_s = np.concatenate([before.t_s, after.t_s]) - before.t_s[0]
            torque_nm = np.concatenate([before.torque_nm, after.torque_nm])
            axes.plot(t_s, torque_nm, color=drawing.SHADES[1], lw=0.7, alpha=0.6)
        axes.axhspan(_TARGET_NM * (1.0 - BAND), _TARGET_NM * (1.0 + BAND), color=drawing.SHADES[3], alpha=0.2, lw=0)
        axes.axvline(_KICK_AT_S, color="black", lw=1, ls=":")
        returns = f"back after {np.median(back_s):.1f} s, worst {max(back_s):.1f} s"
        held = f"{share:.1%} in the band from {counted_s[0]:g} s to the kick"
        axes.set_title(f"{name}\n{held}\n{returns}", fontsize=10)
        axes.set_xlabel("time, s")
        axes.grid(alpha=0.25)
    made.axes[0].set_ylabel("true torque, N·m")
    kicked = f"{_TARGET_NM:g} N·m held within ± {BAND:.0%}, kicked by {_KICK_NM:g} N·m at the dotted line"
    made.suptitle(f"{kicked}; {seeds} seeds")
    return drawing.save(made, content, out, "loop")
