"""The wrist's controller: turns each set point into a speed, 125 times a second. No I/O; time is an argument."""

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import TypeAlias

from shearloop.daemon.control.experiment import ConstantVelocity, Hold, MoveToAngle, TrackTorque, WristSetPoint
from shearloop.daemon.control.experiment_schema import IdentifyStep
from shearloop.daemon.control.identification import ExciteSettings, StiffnessExcitation, ToolModel
from shearloop.daemon.control.margins import JudgedGain, gain_for_noise, integral_gain, judged_gain
from shearloop.daemon.control.torque_controller import (
    LONGEST_STEP_NS,
    ControllerReason,
    ControllerSettings,
    TorqueController,
    WristCommand,
    WristLimit,
)
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSample, TorqueSource

# Begins a computation that would make the loop late, and returns its future.
Compute: TypeAlias = Callable[[Callable[[], JudgedGain]], "Future[JudgedGain]"]

# Torques that wait for the next wrist angle.
MAX_PENDING = 64
# The largest drift of the torque at a fixed angle that counts as creep.
CREEP_LIMIT_NM_PER_S = 0.005
# Either way from the wrist angle of the closed loop's start.
TRAVEL_LIMIT_RAD = 3.2
# Innovations are clipped to three times the noise, and never below this.
MIN_INNOVATION_LIMIT_NM = 0.01


def at_once(job: Callable[[], JudgedGain]) -> "Future[JudgedGain]":
    """Do a computation within this call, as where time is simulated."""
    done: Future[JudgedGain] = Future()
    done.set_result(job())
    return done


class WristController:
    """Carries out one set point at a time; a new one starts from the present wrist angle."""

    def __init__(self, source: TorqueSource, config: LoopConfig, compute: Compute = at_once) -> None:
        self.source = source
        self._compute = compute
        # The check of the gain for the identified tool.
        self._judged: Future[JudgedGain] | None = None
        self.tool: ToolModel | None = None
        self.controller: TorqueController | None = None
        # The torque set point of the closed loop.
        self.tracked: TrackTorque | None = None
        self._config = config
        self._limit = WristLimit.of(config)
        self._stands_still = False
        # Torques wait for the next angle.
        self._pending: deque[TorqueSample] = deque(maxlen=MAX_PENDING)
        self.excitation: StiffnessExcitation | None = None
        # Speeds sent in the last `actuation_s`: time, speed, duration.
        self._under_way: deque[tuple[int, float, float]] = deque()
        self._sent_rad_per_s = 0.0
        self._turned_ns = 0

    @property
    def ramp_nm(self) -> float | None:
        """The torque that the closed loop asks for at present, on its way to the set point; None without one."""
        return self.controller.ramp_nm if self.controller is not None else None

    def on_torque(self, torque: TorqueSample) -> None:
        """Give a torque to the identification, and to the closed loop with the next angle."""
        if self.excitation is not None:
            self.excitation.measure(torque.torque_nm, torque.t_mid_ns, torque.t_ns)
        if self.controller is not None:
            self._pending.append(torque)

    def sent(self, speed_rad_per_s: float) -> None:
        """Take the speed that the worker accepted last."""
        self._sent_rad_per_s = speed_rad_per_s
        if self.controller is not None:
            self.controller.sent(speed_rad_per_s)
        if self.excitation is not None:
            self.excitation.sent(speed_rad_per_s)

    def turn(self, set_point: WristSetPoint, t_ns: int, wrist_rad: float) -> WristCommand:
        """Return the speed for a set point."""
        if not isinstance(set_point, TrackTorque):
            # An open loop records no angles; the next closed loop starts from the torque measured then.
            self.tracked = self.controller = None
        elif self._stands_still and self.controller is not None:
            self.controller.resume()
        self._stands_still = False
        match set_point:
            case Hold():
                return WristCommand()
            case MoveToAngle(angle_rad, speed_rad_per_s):
                missing_rad = angle_rad - wrist_rad - self._on_the_way_rad(t_ns)
                speed = min(abs(self._config.angle_bandwidth_per_s * missing_rad), speed_rad_per_s)
                return self._clipped(math.copysign(speed, missing_rad))
            case ConstantVelocity(speed_rad_per_s):
                return self._clipped(speed_rad_per_s)
            case TrackTorque():
                if self.controller is None or self.tracked != set_point:
                    return WristCommand(reasons=("the loop has not been closed",))
                command = self.controller.command(t_ns, wrist_rad, self._pending)
                self._pending.clear()
                return command

    def close_loop(self, set_point: TrackTorque, t_ns: int, wrist_rad: float) -> str | None:
        """Track a torque with the identified tool, unless it is tracked already; return None, or why it cannot be.

        Until the check of the gain has ended, the loop stays open and the wrist stands still.
        """
        if self.tracked == set_point:
            return None
        tool = self.tool
        if tool is None:
            return "the tool has not been identified; put an `identify` step before the first `hold_torque`"
        settings = controller_settings(self._config, tool, self.source, set_point)
        if self._judged is None:
            self._judged = self._compute(partial(judged_gain, settings, tool, self._config))
        if not self._judged.done():
            return None
        judged = self._judged.result()
        if judged.refusal:
            return judged.refusal
        settings = replace(settings, kp=judged.kp, ki=judged.ki)
        if self.controller is None:
            here_nm = tool.torque_nm + tool.stiffness_nm_per_rad * (wrist_rad - tool.angle_rad)
            self.controller = TorqueController(settings, t_ns, wrist_rad, here_nm, tool.known_measurements)
        self.controller.change_set_point(set_point.torque_nm, settings)
        self.tracked = set_point
        return None

    def begin_identification(self, action: IdentifyStep, torque_limit_nm: float) -> None:
        """Begin the small twists that identify the tool."""
        self.reset()
        settings = ExciteSettings(
            amplitude_rad=action.amplitude_rad, torque_limit_nm=torque_limit_nm, dwell_s=action.hold_s
        )
        self.excitation = StiffnessExcitation(settings, self.source, self._config)

    def identify(self, excitation: StiffnessExcitation, t_ns: int, wrist_rad: float) -> WristCommand:
        """Return the identification's speed, and take its result once it is done."""
        speed_rad_per_s = excitation.command(t_ns, wrist_rad)
        if not excitation.done:
            return WristCommand(speed_rad_per_s)
        self.tool, self.excitation, self._judged = excitation.result, None, None
        return WristCommand()

    def stand_still(self) -> None:
        """Stand still; the next `turn` continues without a jump."""
        self._stands_still = True

    def reset(self) -> None:
        """Forget the tool, after a new grip or a new zero."""
        self.tool = self.controller = self.tracked = self.excitation = self._judged = None

    def _on_the_way_rad(self, t_ns: int) -> float:
        """Return the turn that was sent and does not show in the angle yet."""
        passed_ns = t_ns - self._turned_ns
        self._turned_ns = t_ns
        # After a longer pause of the loop, the speed sent last is unknown.
        if 0 < passed_ns <= LONGEST_STEP_NS:
            self._under_way.append((t_ns, self._sent_rad_per_s, passed_ns / 1e9))
        since_ns = t_ns - self._config.actuation_s * 1e9
        while self._under_way and self._under_way[0][0] <= since_ns:
            self._under_way.popleft()
        return sum(speed * lasted_s for _, speed, lasted_s in self._under_way)

    def _clipped(self, speed_rad_per_s: float) -> WristCommand:
        if not math.isfinite(speed_rad_per_s):
            return WristCommand(0.0, ("the wanted speed is not a number",))
        clipped = self._limit.clip(speed_rad_per_s)
        reasons = () if clipped == speed_rad_per_s else (ControllerReason.SPEED,)
        return WristCommand(clipped, reasons)


def controller_settings(
    config: LoopConfig, found: ToolModel, source: TorqueSource, set_point: TrackTorque
) -> ControllerSettings:
    """Return the controller's settings for an identified tool."""
    kp = config.kp if config.kp is not None else gain_for_noise(found.noise_nm, config.allowed_noise_nm)
    return ControllerSettings(
        stiffness_nm_per_rad=found.stiffness_nm_per_rad,
        stiffness_std_nm_per_rad=found.stiffness_std,
        sample_period_s=found.sample_period_s,
        window_s=source.window_s,
        lag_s=found.significant_lag_s,
        kp=kp,
        # An integral that grows while friction hides the torque swings the wrist through the whole friction band.
        ki=0.0 if source.has_friction_band else integral_gain(kp),
        wrist_bandwidth_per_s=config.torque_bandwidth_per_s,
        ramp_nm_per_s=set_point.ramp_nm_per_s,
        noise_nm=found.noise_nm,
        deadband_nm=config.deadband_nm,
        innovation_limit_nm=max(3.0 * found.noise_nm, MIN_INNOVATION_LIMIT_NM),
        creep_limit_nm_per_s=CREEP_LIMIT_NM_PER_S,
        offset_limit_nm=config.max_offset_drift_nm,
        wrist_limit=WristLimit.of(config),
        travel_limit_rad=TRAVEL_LIMIT_RAD,
        # As the fault `estimate stale`, so that the wrist does not rest before its reason is reported.
        age_limit_s=source.oldest_s,
        fresh_s=source.fresh_s,
    )
