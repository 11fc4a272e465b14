"""The loop: how many frames are averaged, against how closely the torque follows; more smoothing costs more delay."""

import copy
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.alternatives import LateCorrection
from benchmarks.closed_loop import Loop, nanoseconds, run
from benchmarks.plant import EIT, Plant, Sensor
from benchmarks.step_response import SOURCES, identified, settings_for, tool_of
from shearloop.daemon.control.controller import TwistController, WristCommand
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.margins import integral_gain
from shearloop.daemon.control.settings import ControllerSettings

WINDOWS = (1, 2, 3, 4, 6, 9)
# All smoothing is left to the window: each mean is believed by this much. The tuned controller beside believes single
# frames by as much as their noise allows.
GAIN = 0.5
LOOPS = ("twist controller", "no delay compensator", "twist controller, gain tuned to the noise")
# A set point that wanders, and a load that comes and goes beside: of the second only what is measured can tell.
_TARGET_NM, _SWING_NM, _SWING_PERIOD_S = 0.10, 0.02, 40.0
_LOAD_NM, _LOAD_PERIOD_S = 0.02, 30.0
_RUN_S, _SETTLING_S, _CHUNK_S, _COMMAND_PERIOD_S = 90.0, 15.0, 0.25, 0.016


@dataclass(frozen=True, slots=True)
class Followed:
    """Of a loop, noise of a frame, and window: the mean's delay, and the RMS of torque − set point in N·m."""

    loop: str
    noise_nm: float
    frames: int
    delay_s: float
    rms_nm: float
    rms_low_nm: float
    rms_high_nm: float


@dataclass(slots=True)
class _Averaged:
    """A loop that gets the mean of the last frames, which belongs to the mean of their times."""

    loop: Loop
    latest: deque[tuple[float, int]]

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> None:
        """Take in a frame's torque."""
        if torque_nm is None:
            return
        self.latest.append((torque_nm, t_mid_ns))
        torques, times = zip(*self.latest, strict=True)
        self.loop.measure(float(np.mean(torques)), round(float(np.mean(times))), t_ns)

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:
        """Return the wrist speed for now."""
        return self.loop.command(t_ns, wrist_angle_rad)


def followed(noises_nm: Sequence[float], seeds: int, windows: Sequence[int] = WINDOWS) -> list[Followed]:
    """Return the tracking errors for every noise of a single frame, loop and window."""
    rms: dict[tuple[str, float, int], list[float]] = {}
    for noise in noises_nm:
        source = replace(SOURCES[0], sensor=replace(EIT, noise_nm=noise))
        for seed in range(seeds):
            rng = np.random.default_rng((31, seed))
            gripped = Plant(tool_of(rng), source.sensor, rng, period_s=_COMMAND_PERIOD_S)
            found = identified(gripped, source)
            for name in LOOPS:
                # The tuned controller does its own averaging.
                for frames in windows if name != LOOPS[2] else (1,):
                    plant, settings = copy.deepcopy(gripped), settings_for(found, source)
                    error = _run(plant, _loop(name, frames, plant, found, settings))
                    rms.setdefault((name, noise, frames), []).append(error)
    return [
        Followed(name, noise, frames, _delay_s(EIT, frames), float(np.median(errors)), min(errors), max(errors))
        for (name, noise, frames), errors in rms.items()
    ]


def _delay_s(sensor: Sensor, frames: int) -> float:
    """Return the time from the middle of what a mean of frames belongs to until it is known."""
    return 0.5 * sensor.window_s + 0.5 * (frames - 1) * sensor.period_s + sensor.transfer_s


def _loop(name: str, frames: int, plant: Plant, found: ToolModel, settings: ControllerSettings) -> _Averaged:
    if name != LOOPS[2]:
        settings = replace(
            settings, kp=GAIN, ki=integral_gain(GAIN), noise_nm=settings.noise_nm / float(np.sqrt(frames)),
            window_s=settings.window_s + (frames - 1) * found.sample_period_s,
            age_limit_s=settings.age_limit_s + frames * found.sample_period_s,
        )  # fmt: skip
    if name == LOOPS[1]:
        late = LateCorrection(
            stiffness_nm_per_rad=settings.stiffness_nm_per_rad, kp=settings.kp, ki=settings.ki,
            wrist_bandwidth_per_s=settings.wrist_bandwidth_per_s, ramp_nm_per_s=settings.ramp_nm_per_s,
            speed_limit_rad_per_s=settings.speed_limit_rad_per_s,
        )  # fmt: skip
        return _Averaged(late, deque(maxlen=frames))
    controller = TwistController(settings)
    torque = found.torque_nm + found.stiffness_nm_per_rad * (plant.angle_rad - found.angle_rad)
    controller.start(nanoseconds(plant.t_s), plant.angle_rad, torque, found.known_measurements)
    return _Averaged(controller, deque(maxlen=frames))


def _run(plant: Plant, averaged: _Averaged) -> float:
    """Return the RMS of true torque − set point, in N·m, once the loop has settled."""
    begun, squares, n = plant.t_s, 0.0, 0
    while plant.t_s - begun < _RUN_S:
        t_s = plant.t_s - begun
        wanted = _TARGET_NM + _SWING_NM * float(np.sin(2 * np.pi * t_s / _SWING_PERIOD_S))
        plant.disturbance_nm = _LOAD_NM * float(np.sin(2 * np.pi * t_s / _LOAD_PERIOD_S))
        if isinstance(averaged.loop, TwistController):
            averaged.loop.set_point(wanted)
        elif isinstance(averaged.loop, LateCorrection):
            averaged.loop.set_point_nm = wanted
        torque = run(plant, averaged, _CHUNK_S).torque_nm
        if t_s >= _SETTLING_S:
            squares, n = squares + float(((torque - wanted) ** 2).sum()), n + len(torque)
    return float(np.sqrt(squares / n))
