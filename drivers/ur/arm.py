"""The arm through ur-rtde. Only this module calls ur-rtde, and only the worker imports this module.

ur-rtde is not thread-safe. Its calls block for up to 301 s, its constructors hold the interpreter lock, and it crashes
its process when RTDE is lost or it has connected again. So it has a process of its own, with an alarm before each call.
"""

import ctypes
import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from operator import sub
from statistics import fmean

import rtde_control

from shearloop.drivers.ur.dashboard import command_dashboard
from shearloop.drivers.ur.library import why_other_client
from shearloop.drivers.ur.messages import (
    RUNTIME_PLAYING,
    ControllerError,
    MoveLinear,
    RobotLostError,
    RtdeSample,
    WristSpeed,
)
from shearloop.drivers.ur.ports import lose_dead_peers_of_ports
from shearloop.drivers.ur.primary_port import PrimaryPort
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.rtde import has_other_client
from shearloop.drivers.ur.sample_age import SampleAge
from shearloop.drivers.ur.script import NO_MOTION_TICKS, UPPER, ScriptRegisters, control_program
from shearloop.drivers.ur.script_port import ScriptPort
from shearloop.drivers.ur.script_readiness import ScriptReadiness
from shearloop.drivers.ur.settings import Six, UrSettings

# A thread of ur-rtde polls its socket every 0.1 ms, which takes 5 % of a core. With this timer slack it wakes once per
# two samples. One-time commands wait for that thread, so that the slack is at most a sixth of the watchdog's time.
_LONGEST_POLL_SLACK_NS, _SLACKS_PER_WATCHDOG = 16_000_000, 6
_PR_SET_TIMERSLACK = 29
# A CB3 estimates its wrench from motor currents: one sample is off by up to 10 N and 5 N·m, their mean by far less.
_ZERO_OVER_S = 0.5
# Each start of a program with a held tool changes the kept zero by the errors of two means over this time: on a UR5e by
# 0.01 N·m. A longer one would take more of what the gel relaxes meanwhile.
_HELD_OVER_S = 1.0
# The longest time for sending the script.
_UPLOAD_S = 1.0


class UrArm:
    """A connection for samples, one for control, and the dashboard when needed."""

    def __init__(
        self,
        settings: UrSettings,
        registers: ScriptRegisters = UPPER,
        primary: PrimaryPort | None = None,
        receiver: type[RtdeReceiver] = RtdeReceiver,
    ) -> None:
        """Connect without starting a program, so that this works in a protective stop.

        `receiver` is the connection for samples and deadlines.

        Raises:
            RuntimeError: ur-rtde failed.
            RobotLostError: the controller does not send its state, or ur-rtde has another version.
        """
        self._settings = settings
        self._registers = registers
        self._primary = primary
        if reason := why_other_client():
            raise RobotLostError("version", f"{reason[0].upper()}{reason[1:]}.")
        self._receiver = receiver(settings.host, settings.rate_hz, settings.connect_timeout_s / 3, registers)
        kind = rtde_control.RTDEControlInterface
        watchdog_ns = 1e9 / settings.watchdog_hz
        # The thread that ur-rtde starts here inherits the slack; 0 gives this one its default again.
        _set_timer_slack(min(_LONGEST_POLL_SLACK_NS, int(watchdog_ns / _SLACKS_PER_WATCHDOG)))
        # Without FLAG_NO_EXT_FT it takes the input of external force sensors, which their URCaps write.
        flags = int(kind.FLAG_NO_WAIT) | int(kind.FLAG_NO_EXT_FT)
        flags |= int(kind.FLAG_UPPER_RANGE_REGISTERS) if registers.first else 0
        self._control = kind(settings.host, settings.rate_hz, flags)
        _set_timer_slack(0)
        lose_dead_peers_of_ports()
        self._script_port = ScriptPort(settings.host, _UPLOAD_S)
        # A straight move was begun, and the wrist has not turned since.
        self._may_move_linearly = False
        self._age = SampleAge()
        # In the base's frame: of a controller that cannot zero its wrench, or that has zeroed it with a load.
        self.wrench_zero: Six = (0.0,) * 6
        # Of the latest samples at rest, as the controller measures them: one is known to its noise only.
        self._recent_wrenches: deque[Six] = deque(maxlen=round(_HELD_OVER_S * settings.rate_hz))
        # When the latest sample that was read was made, by the controller's clock.
        self._measured_s = math.nan
        # The wrench before a program was first sent, where something was held, until that program has its zero.
        self._held: Six | None = None
        # Whether the program that was sent last has answered.
        self._answered = False
        self.script_readiness = ScriptReadiness(self._receiver, settings.command_timeout_s)

    def read(self) -> RtdeSample:
        """Return the controller's latest sample and its age."""
        sample = self._receiver.latest()
        now_ns = time.monotonic_ns()
        # The controller listens to a script's sender only while the sender reads.
        self._script_port.drain()
        if sample.runtime_state == RUNTIME_PLAYING:
            self._script_port.close()
        else:
            # The next program that plays can be another client's.
            self._answered = False
        read = RtdeSample(
            **vars(sample) | {"wrench": _difference(sample.wrench, self.wrench_zero)},
            read_ns=now_ns,
            age_ns=self._age.age_ns(sample.timestamp_s, now_ns),
            connected=self._receiver.connected and self._control.isConnected(),
            moving_linearly=self._may_move_linearly
            and self._control.getAsyncOperationProgressEx().isAsyncOperationRunning(),
            rest_rad_per_s=self._settings.rest_rad_per_s,
        )
        if not read.rests:
            # A motion has a wrench of its own.
            self._recent_wrenches.clear()
        elif sample.timestamp_s != self._measured_s:
            # Commands between two samples read the same one again.
            self._recent_wrenches.append(sample.wrench)
        self._measured_s = sample.timestamp_s
        return read

    def take_errors(self) -> list[ControllerError]:
        """Return the controller's error codes since the last call."""
        return self._primary.read() if self._primary is not None else []

    def wrist(self, command: WristSpeed, left_s: float) -> bool:
        """Turn wrist 3 for `left_s` at most, and hold the other joints; not during a straight move."""
        self._may_move_linearly = False
        self._write_deadline(left_s)
        speeds = [0.0, 0.0, 0.0, 0.0, 0.0, command.rad_per_s]
        return self.script_readiness.wait() and bool(self._control.speedJ(speeds, command.acceleration_rad_per_s2, 0.0))

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        """End the script's speed thread. It blocks until the arm rests, so call it at rest."""
        return self._send_once(self._control.speedStop, deceleration_rad_per_s2)

    def move(self, command: MoveLinear) -> bool:
        """Begin a straight move; `RtdeSample.moving_linearly` shows its end."""
        if not self.script_readiness.wait():
            return False
        self._may_move_linearly = True
        self._write_deadline(self._settings.silence_timeout_s)
        speed, acceleration = command.speed_m_per_s, command.acceleration_m_per_s2
        return self._send_once(self._control.moveL, [*command.pose], speed, acceleration, asynchronous=True)

    def stop_move(self, deceleration_rad_per_s2: float) -> bool:
        """Begin to end a straight move."""
        # ur-rtde does not report whether the stop was accepted; the heartbeat after it does.
        self._send_once(self._control.stopJ, deceleration_rad_per_s2, asynchronous=True)
        return self.send_heartbeat()

    def send_heartbeat(self, left_s: float | None = None) -> bool:
        """Feed the robot's watchdog; a straight move goes on for `left_s` at most."""
        if left_s is not None:
            self._write_deadline(left_s)
        return self.script_readiness.wait() and bool(self._control.kickWatchdog())

    def clear_command(self) -> bool:
        """Clear the register with the last command while no program runs; False: try again later.

        ur-rtde has no such call, but clears the register before it reports that it cannot send. False means that it
        does not know yet that no program runs, and would wait for the program.
        """
        if self._control.isProgramRunning():
            return False
        self._control.kickWatchdog()
        return True

    def zero_wrench(self) -> bool:
        """Make the present wrench zero: in the controller, or in this process where the controller cannot.

        In this process it is the mean of the last samples at rest.
        """
        if not self._settings.facts.zeroes_wrench:
            self.wrench_zero = self._mean_wrench(_ZERO_OVER_S)
            return True
        if not self._send_once(self._control.zeroFtSensor):
            return False
        self.wrench_zero = (0.0,) * 6
        self._recent_wrenches.clear()
        return True

    def upload(self, *, held: bool = False) -> None:
        """Send the control script; the controller starts the program, which ends if it receives nothing.

        An e-Series zeroes its wrench when a program starts. If a tool may load the wrench (`held`), the earlier zero
        is kept, even if the first sent program has started without an answer.

        Raises:
            RobotLostError: the controller does not take the script.
        """
        if not (held and self._settings.facts.zeroes_at_start):
            self._held = None
        elif self._held is None:
            self._held = _difference(self._mean_wrench(_HELD_OVER_S), self.wrench_zero)
        self._answered = False
        self._recent_wrenches.clear()
        # ur-rtde's own script connection is never read, so that the controller soon stops listening to it.
        self._script_port.send(control_program(self._settings, self._registers, self._held))
        self.script_readiness.command_sent()

    def forget_load(self) -> None:
        """Keep no load for a program that has not answered: the tool is gone."""
        self._held = None

    def arm_watchdog(self) -> bool:
        """Return whether the uploaded program answers, and the wrench has its zero; its watchdog is armed then.

        With something held the zero is known once the wrench has been measured for a second of the program.
        """
        if self._answered:
            # Each command that is carried out once takes four of the worker's cycles.
            fed = self.send_heartbeat()
        else:
            fed = self._send_once(self._control.setWatchdog, self._settings.watchdog_hz)
        if not (fed and self._settings.facts.zeroes_at_start):
            return fed
        if not self._answered:
            self._answered = True
            self._recent_wrenches.clear()
            self.wrench_zero = (0.0,) * 6
            if self._held is not None:
                # Until it is known better.
                self.wrench_zero = _difference(self._receiver.latest().wrench, self._held)
        if self._held is None:
            return True
        if not self._is_measured:
            return False
        self.wrench_zero = _difference(self._mean_wrench(_HELD_OVER_S), self._held)
        self._held = None
        return True

    def end_program(self) -> None:
        """End the control script; one that is not ready is left to its watchdog."""
        if self.script_readiness.wait():
            self._control.stopScript()

    def withdraw_deadline(self) -> None:
        """Let no motion go on, also not when a program that is paused now is resumed."""
        self._receiver.write_deadline(NO_MOTION_TICKS)

    def measure_load_anew(self) -> None:
        """Measure the load from now on, before a new program may change the zero."""
        self._recent_wrenches.clear()

    def knows_load(self, *, held: bool) -> bool:
        """Return whether the wrench was measured for long enough at rest that a new program can keep its zero."""
        return not (held and self._settings.facts.zeroes_at_start) or self._held is not None or self._is_measured

    @property
    def _is_measured(self) -> bool:
        return len(self._recent_wrenches) == self._recent_wrenches.maxlen

    def _mean_wrench(self, seconds: float) -> Six:
        """Return the mean of the latest samples at rest as the controller measures them, of one where none is."""
        last = round(seconds * self._settings.rate_hz)
        recent = [*self._recent_wrenches][-last:] or [self._receiver.latest().wrench]
        fx, fy, fz, mx, my, mz = (fmean(component) for component in zip(*recent, strict=True))
        return fx, fy, fz, mx, my, mz

    def _write_deadline(self, left_s: float) -> None:
        # The latest sample is older than now, so that the deadline is never late.
        sample = self._receiver.latest()
        if sample.script_step_s > 0:
            self._receiver.write_deadline(sample.script_ticks + int(left_s / sample.script_step_s))
        else:
            # No program has run yet.
            self.withdraw_deadline()

    def _send_once(self, call: Callable[..., object], *arguments: object, **options: object) -> bool:
        """Send a command that the script carries out once."""
        if not self.script_readiness.wait():
            return False
        done = bool(call(*arguments, **options))
        self.script_readiness.command_sent()
        return done

    def has_other_client(self) -> bool:
        """Return whether another client writes registers that a control program reads, as another daemon does.

        Raises:
            RobotLostError: the controller does not answer.
        """
        return has_other_client(self._settings.host, self._settings.connect_timeout_s / 8, self._registers)

    def ask_dashboard(self, *requests: str) -> str:
        """Have the dashboard carry out requests; return and raise as `command_dashboard` does."""
        return command_dashboard(self._settings.host, 2.5, requests)


def _difference(one: Six, other: Six) -> Six:
    return tuple(map(sub, one, other))


def _set_timer_slack(slack_ns: int) -> None:
    """Set prctl(2)'s timer slack; without the right to, the threads only cost more."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0) != 0:
        sys.stderr.write(f"The robot's threads wake more often than needed: {os.strerror(ctypes.get_errno())}.\n")
