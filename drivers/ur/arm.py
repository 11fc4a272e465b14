"""ur-rtde behind a port of our own. The only module that imports it, and only the child process imports this module.

The client is not thread-safe and blocks for up to 301 s, its constructors hold the interpreter lock and some never
return, and it crashes its process when RTDE is lost: hence a process for it alone, with an alarm set before each call.
"""

import ctypes
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import dashboard_client
import rtde_control
import script_client

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.connections import connections_to
from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, WristSpeed
from shearloop.drivers.ur.probe import RTDE_PORT
from shearloop.drivers.ur.ready import Ready
from shearloop.drivers.ur.receiver import Receiver
from shearloop.drivers.ur.sample_age import SampleAge
from shearloop.drivers.ur.script import in_a_file, watched
from shearloop.drivers.ur.settings import UrSettings

# A thread of the client asks its socket for data, sleeps for 0.1 ms, and asks again: 5 % of a core. Woken up to so much
# later it takes two samples at a time. What is sent over and over (a wrist speed, a sign of life) does not wait for it.
# What is done once (beginning or stopping a straight move, ending the turning of a wrist at rest, zeroing the wrench,
# setting the watchdog) waits until it has seen that done, and what comes next until it has seen the robot ready again
# (see `shearloop.drivers.ur.ready`): each so much longer at most, and a robot that hears nothing meanwhile has
# patience for six.
_LONGEST_POLL_SLACK_NS, _SLACKS_IN_PATIENCE = 16_000_000, 6
_PR_SET_TIMERSLACK = 29


class DashboardRefusedError(DriverError):
    """The dashboard server did not do what it was asked."""


class UrArm:
    """One connection to a controller for reading, one for control; the dashboard when needed."""

    def __init__(self, settings: UrSettings, version: str) -> None:
        """Connect without starting a program, so that a robot in a protective stop can be connected to as well.

        `version` is the controller's, as 5.17.3.0.

        Raises:
            RuntimeError: whatever ur-rtde says.
            ProbeError: the controller does not send its state.
        """
        self._settings = settings
        major, minor = map(int, version.split(".")[:2])
        # Not connected: it is asked for the text alone.
        self._script = watched(script_client.ScriptClient("", major, minor).getScript(), settings.watchdog_hz)
        if not self._script:
            sys.stderr.write(
                "The control script of this ur-rtde has another form: a command alone arms its watchdog.\n"
            )
        self._receiver = Receiver(settings.host, settings.rate_hz, settings.connect_timeout_s / 3)
        kind, ours = rtde_control.RTDEControlInterface, connections_to(RTDE_PORT)
        patience_ns = 1e9 / settings.watchdog_hz
        with _woken_late(min(_LONGEST_POLL_SLACK_NS, int(patience_ns / _SLACKS_IN_PATIENCE))):
            self._control = kind(settings.host, settings.rate_hz, int(kind.FLAG_NO_WAIT))
        self._its_connections = connections_to(RTDE_PORT) - ours
        self._takes_scripts = True
        # Whether a straight move may be under way: one was begun, and the wrist has not been turned since.
        self._may_move_linearly = False
        self._age = SampleAge()
        self._ready = Ready(self._receiver, 1.0 / settings.watchdog_hz)

    def read(self) -> RtdeSample:
        """Return the controller's latest sample and its age."""
        sample = self._receiver.latest()
        now_ns = time.monotonic_ns()
        return RtdeSample(
            sample.timestamp_s,
            sample.q_rad,
            sample.qd_rad_per_s,
            sample.tcp_pose,
            sample.wrench,
            sample.robot_mode,
            sample.safety_mode,
            sample.runtime_state,
            sample.speed_scaling,
            now_ns,
            self._age.age_ns(sample.timestamp_s, now_ns),
            self._connected,
            # Two calls that wrap an object: not in each cycle in which the answer is known.
            self._may_move_linearly and self._control.getAsyncOperationProgressEx().isAsyncOperationRunning(),
        )

    @property
    def _connected(self) -> bool:
        theirs = self._takes_scripts and self._control.isConnected()
        return self._receiver.connected and theirs and all(one.lasts for one in self._its_connections)

    def wrist(self, command: WristSpeed) -> bool:
        """Turn wrist 3, the other joints held; of an arm that is on no straight move."""
        self._may_move_linearly = False
        speeds = [0.0, 0.0, 0.0, 0.0, 0.0, command.rad_per_s]
        return self._ready.wait() and bool(self._control.speedJ(speeds, command.acceleration_rad_per_s2, 0.0))

    def end_speed(self, deceleration_rad_per_s2: float) -> bool:
        """End the script's speed thread; blocks until the arm rests, so only for an arm that does."""
        return self._once(self._control.speedStop, deceleration_rad_per_s2)

    def move(self, command: MoveLinear) -> bool:
        """Begin a linear move; `RtdeSample.moving_linearly` tells its end."""
        self._may_move_linearly = True
        speed, acceleration = command.speed_m_per_s, command.acceleration_m_per_s2
        return self._once(self._control.moveL, [*command.pose], speed, acceleration, asynchronous=True)

    def stop_move(self, deceleration_rad_per_s2: float) -> bool:
        """Begin to end a linear move."""
        # The client does not say whether the stop was taken; whether the program takes what comes after it, it does.
        self._once(self._control.stopJ, deceleration_rad_per_s2, asynchronous=True)
        return self.kick()

    def kick(self) -> bool:
        """Tell the robot's watchdog that we live."""
        return self._ready.wait() and bool(self._control.kickWatchdog())

    def clear_command(self) -> bool:
        """See that the register which holds the last command moves nothing any more, while no program runs.

        The client has no call for it, but clears the register before it says that it cannot send. False: it does not
        know yet that no program runs, and would wait for that to be ready.
        """
        if self._control.isProgramRunning():
            return False
        self._control.kickWatchdog()
        return True

    def zero_wrench(self) -> bool:
        """Take the present wrench as zero."""
        return self._once(self._control.zeroFtSensor)

    def upload(self) -> bool:
        """Send the control script; the program then starts by itself, and ends when it hears nothing."""
        try:
            if self._script:
                with in_a_file(self._script) as path:
                    # Sends it, too.
                    self._control.setCustomScriptFile(path)
            else:
                self._control.reuploadScript()
        except RuntimeError as error:
            # The controller has closed the connection for scripts, or restarts: ur-rtde does not open it again.
            sys.stderr.write(f"The control script could not be sent: {error}.\n")
            self._takes_scripts = False
        self._ready.called()
        return self._takes_scripts

    def arm_watchdog(self) -> bool:
        """Have the robot end its program when it hears nothing; after every upload, which it shows to have taken."""
        return self._once(self._control.setWatchdog, self._settings.watchdog_hz)

    def end_program(self) -> None:
        """End the control script, unless it is not ready for that: the robot's watchdog ends it then."""
        if self._ready.wait():
            self._control.stopScript()

    def _once(self, call: Callable[..., object], *arguments: object, **options: object) -> bool:
        """Have a command carried out that the script says to be done with."""
        if not self._ready.wait():
            return False
        done = bool(call(*arguments, **options))
        self._ready.called()
        return done

    def unlock(self) -> None:
        """Unlock a protective stop; `DashboardRefusedError` in its first 5 s."""
        self._ask("unlockProtectiveStop")

    def close_popups(self) -> None:
        """Close what the pendant shows."""
        self._ask("closeSafetyPopup", "closePopup")

    def power_on(self) -> None:
        """Begin to switch the arm's power on."""
        self._ask("powerOn")

    def release_brakes(self) -> None:
        """Begin to release the brakes."""
        self._ask("brakeRelease")

    def stop_program(self) -> None:
        """Stop whatever program runs or is paused."""
        self._ask("stop")

    def _ask(self, *requests: str) -> None:
        dashboard = dashboard_client.DashboardClient(self._settings.host)
        try:
            dashboard.connect()
            for request in requests:
                getattr(dashboard, request)()
        except RuntimeError as error:
            raise DashboardRefusedError(str(error)) from error
        finally:
            dashboard.disconnect()


@contextmanager
def _woken_late(slack_ns: int) -> Iterator[None]:
    """Let the kernel wake the threads that are started meanwhile up to so much later than they ask (prctl(2)).

    A thread with real-time priority is woken on time all the same. Where the kernel does not let us, threads are woken
    on time too: that costs processor time and nothing else.
    """
    _set_timer_slack(slack_ns)
    try:
        yield
    finally:
        # Of this thread, the default again.
        _set_timer_slack(0)


def _set_timer_slack(slack_ns: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0) != 0:
        sys.stderr.write(f"The robot's threads are woken more often than needed: {os.strerror(ctypes.get_errno())}.\n")
