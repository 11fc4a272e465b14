"""What the wrist does for each wish: a speed in rad/s, 125 times a second. No I/O; times are passed in."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from shearloop.daemon.control.controller import TwistController
from shearloop.daemon.control.excitation import ExciteSettings, StiffnessExcitation
from shearloop.daemon.control.identify import ToolModel
from shearloop.daemon.control.loop_inputs import TorqueSample, TorqueSource
from shearloop.daemon.control.settings import ControllerSettings
from shearloop.daemon.control.step_commands import (
    ConstantVelocity,
    Hold,
    IdentifyStiffness,
    MoveToAngle,
    TrackTorque,
    WristSetpoint,
)
from shearloop.daemon.control.tuning import RequiredMargins, refusal

# Torques that wait for an angle: while the wrist stands they may be many, and the latest say what has become of it.
MOST_HEARD = 64
# A loop that was away for longer than this does not know what it sent last.
LONGEST_STEP_NS = 50_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class WristSettings:
    """Bounds on the wrist's motion, and what the closed loop must have."""

    speed_limit_rad_per_s: float = 0.5
    acceleration_limit_rad_per_s2: float = 2.0
    # How fast the wrist closes in on an angle, per second and per radian that is missing.
    angle_bandwidth_per_s: float = 5.0
    # From sending a speed until the angle shows it: so long what was sent is counted as travelled already.
    actuation_s: float = 0.02
    required: RequiredMargins = field(default_factory=RequiredMargins)


@dataclass(frozen=True, slots=True)
class WristVelocity:
    """The speed that is wanted now, and why it is not another."""

    speed_rad_per_s: float = 0.0
    reasons: tuple[str, ...] = ()


class WristController:
    """Carries out one wish at a time; a wish that changes is begun anew from where the wrist is."""

    def __init__(
        self,
        source: TorqueSource,
        settings: WristSettings,
        tune: Callable[[ToolModel, TorqueSource, TrackTorque, float], ControllerSettings],
    ) -> None:
        """Take the driving torque's source, bounds, and what makes controller settings from an identified tool."""
        self.source = source
        self.identified: ToolModel | None = None
        self.controller: TwistController | None = None
        self._settings = settings
        self._tune = tune
        self._tracked: TrackTorque | None = None
        self._held = False
        # A torque that is newer than the latest angle waits for the next one: it is compared with the angle it had.
        self._heard: deque[TorqueSample] = deque(maxlen=MOST_HEARD)
        self._measuring: StiffnessExcitation | None = None
        # Speeds sent in the last `actuation_s`, each with when it was taken over and for how long it held.
        self._under_way: deque[tuple[int, float, float]] = deque()
        self._sent_rad_per_s = 0.0
        self._turned_ns = 0

    @property
    def expected_nm(self) -> float | None:
        """Return the torque that the controller expects at the wrist's angle, while it drives."""
        return self.controller.state.torque_nm if self.controller is not None and self._tracked is not None else None

    def hear(self, torque: TorqueSample) -> None:
        """Pass the driving torque on to whatever listens."""
        if torque.source != self.source.name:
            return
        if self._measuring is not None:
            self._measuring.measure(torque.torque_nm, torque.t_mid_ns, torque.t_ns)
        if self.controller is not None:
            self._heard.append(torque)

    def sent(self, speed_rad_per_s: float) -> None:
        """Tell what was really sent, after all clipping."""
        self._sent_rad_per_s = speed_rad_per_s
        if self.controller is not None:
            self.controller.sent(speed_rad_per_s)
        if self._measuring is not None:
            self._measuring.sent(speed_rad_per_s)

    def turn(self, wish: WristSetpoint, t_ns: int, wrist_rad: float, origin_rad: float) -> WristVelocity:
        """Return the speed for a wish; angles in wishes count from origin_rad."""
        if not isinstance(wish, TrackTorque):
            # A loop that is not driven sees no angles; the next one starts from what is then measured.
            self._tracked = self.controller = None
        elif self._held and self.controller is not None:
            self.controller.resume()
        self._held = False
        match wish:
            case Hold():
                return WristVelocity()
            case MoveToAngle(angle_rad, speed_rad_per_s):
                return self._towards(origin_rad + angle_rad - wrist_rad - self._on_the_way_rad(t_ns), speed_rad_per_s)
            case ConstantVelocity(speed_rad_per_s):
                return self._bounded(speed_rad_per_s)
            case TrackTorque():
                return self._follow(wish, t_ns, wrist_rad)

    def refuses(self, wish: TrackTorque, torque_limit_nm: float) -> str | None:
        """Return why a set point cannot be tracked with what is known of the tool, or None."""
        if self.identified is None:
            return "the tool has not been identified; put an `identify` step before the first `hold_torque`"
        settings = self._tune(self.identified, self.source, wish, torque_limit_nm)
        return refusal(settings, self.identified, self._settings.required)

    def begin_tracking(self, wish: TrackTorque, t_ns: int, wrist_rad: float, torque_limit_nm: float) -> None:
        """Close the loop on a set point; `refuses` has been asked before."""
        if self.identified is None:
            raise ValueError("a loop is closed on an identified tool")
        found = self.identified
        if self.controller is None:
            self.controller = TwistController(self._tune(found, self.source, wish, torque_limit_nm))
            here_nm = found.torque_nm + found.stiffness_nm_per_rad * (wrist_rad - found.angle_rad)
            self.controller.start(t_ns, wrist_rad, here_nm, found.known_measurements)
        self.controller.set_point(wish.torque_nm)
        self._tracked = wish

    @property
    def tracks(self) -> TrackTorque | None:
        """Return the set point that is being tracked."""
        return self._tracked

    def begin_measuring(self, action: IdentifyStiffness, torque_limit_nm: float) -> None:
        """Shake the tool to learn its stiffness."""
        self.forget()
        self._measuring = StiffnessExcitation(
            ExciteSettings(
                amplitude_rad=action.amplitude_rad,
                sample_period_s=self.source.period_s,
                window_s=self.source.window_s,
                torque_limit_nm=torque_limit_nm,
                speed_rad_per_s=self._settings.speed_limit_rad_per_s,
                acceleration_rad_per_s2=self._settings.acceleration_limit_rad_per_s2,
            )
        )

    def measure(self, t_ns: int, wrist_rad: float) -> tuple[WristVelocity, str | None]:
        """Return the speed of the identification, and "" when it has ended well, or why it has ended badly."""
        step = self._measuring
        if step is None:
            return WristVelocity(), "it was never begun"
        turn = self._bounded(step.command(t_ns, wrist_rad))
        if not step.done:
            return turn, None
        self.identified, self._measuring = step.result, None
        return WristVelocity(), step.failure or ""

    def hold(self) -> WristVelocity:
        """Stand still for now; the next `turn` goes on without a jump."""
        if self.controller is not None and not self._held:
            self.controller.hold()
        self._held = True
        return WristVelocity()

    def forget(self) -> None:
        """Forget the tool: it was let go, or another zero was taken."""
        self.identified = self.controller = self._tracked = self._measuring = None

    def _follow(self, wish: TrackTorque, t_ns: int, wrist_rad: float) -> WristVelocity:
        if self.controller is None or self._tracked != wish:
            return WristVelocity(reasons=("the loop has not been closed",))
        command = self.controller.command(t_ns, wrist_rad)
        for torque in self._heard:
            torque_nm = torque.nearest_to(self.controller.state.torque_nm)
            self.controller.measure(torque_nm, torque.t_mid_ns, torque.t_ns)
        self._heard.clear()
        return WristVelocity(self._bounded(command.speed_rad_per_s).speed_rad_per_s, tuple(map(str, command.reasons)))

    def _on_the_way_rad(self, t_ns: int) -> float:
        """Return how far the wrist will have turned by what was sent and does not show in its angle yet."""
        passed_ns = t_ns - self._turned_ns
        self._turned_ns = t_ns
        if 0 < passed_ns <= LONGEST_STEP_NS:
            self._under_way.append((t_ns, self._sent_rad_per_s, passed_ns / 1e9))
        since_ns = t_ns - self._settings.actuation_s * 1e9
        while self._under_way and self._under_way[0][0] <= since_ns:
            self._under_way.popleft()
        return sum(speed * held_s for _, speed, held_s in self._under_way)

    def _towards(self, missing_rad: float, speed_rad_per_s: float) -> WristVelocity:
        bandwidth_per_s = self._settings.angle_bandwidth_per_s
        speed = math.copysign(min(abs(bandwidth_per_s * missing_rad), speed_rad_per_s), missing_rad)
        return self._bounded(speed)

    def _bounded(self, speed_rad_per_s: float) -> WristVelocity:
        if not math.isfinite(speed_rad_per_s):
            return WristVelocity(0.0, ("no speed follows from what is not a number",))
        limit = self._settings.speed_limit_rad_per_s
        bounded = max(-limit, min(limit, speed_rad_per_s))
        if bounded == speed_rad_per_s:
            return WristVelocity(bounded)
        return WristVelocity(bounded, (f"the wrist turns no faster than {limit:g} rad/s",))
