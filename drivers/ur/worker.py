"""The worker, `python -m shearloop.drivers.ur.worker`: commands on stdin, states and replies on stdout.

It runs 125 cycles a second and sends the state of each. ur-rtde may hang or crash at any time, so that the worker
holds nothing worth saving. Before each stretch that may hang it sets an alarm, and the kernel ends it in time; the
script on the robot then stops the arm. When stdin ends the daemon is gone: the worker stops the arm and exits.
"""

import contextlib
import math
import os
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, NoReturn

from shearloop.drivers.ur import messages
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.control_box import check_generation, check_ports, probe_controller, untested
from shearloop.drivers.ur.dashboard import REMOTE_CURE, SERIAL_NUMBER, ask_dashboard, serial_number_in
from shearloop.drivers.ur.fitness import why_unfit
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.primary_port import PrimaryPort
from shearloop.drivers.ur.receiver import RtdeReceiver
from shearloop.drivers.ur.rtde import free_registers, registers_in_use
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

EXIT_DONE, EXIT_FAILED = 0, 3
# On exit, the time to brake a motion; the robot's watchdog ends what remains.
BRAKE_S = 1.0
# The bound on unsent replies. States that a slow daemon does not read are dropped.
MAX_UNSENT = 1 << 16


class Pipe:
    """Both directions of the pipe to the daemon; neither ever blocks."""

    def __init__(self, stdin: int, stdout: int) -> None:
        self._in, self._out = stdin, stdout
        self._decoder = messages.MessageDecoder()
        # Received together with a message that was taken by itself.
        self._received: list[tuple[int, messages.Message]] = []
        # Of the messages sent last.
        self.unsent = b""
        self.open = True
        os.set_blocking(stdin, False)
        os.set_blocking(stdout, False)

    def wait(self, timeout_s: float) -> bool:
        """Wait for input and return whether there is any."""
        return bool(select.select([self._in], [], [], timeout_s)[0])

    def receive(self) -> list[tuple[int, messages.Message]]:
        """Return the messages that have arrived; `open` is False once the daemon is gone."""
        received, self._received = self._received, []
        try:
            data = os.read(self._in, 1 << 16)
        except BlockingIOError:
            return received
        self.open = self.open and bool(data)
        return received + self._decoder.feed(data)

    def keep(self, received: list[tuple[int, messages.Message]]) -> None:
        """Return these messages from the next `receive`, before all others."""
        self._received = received + self._received

    def send(self, message: messages.Message, number: int = 0) -> None:
        """Send a message that must arrive."""
        self.unsent += messages.encode(message, number)
        self._flush()
        if len(self.unsent) > MAX_UNSENT:
            self.open = False

    def send_latest(self, message: messages.Message) -> None:
        """Send a message, or drop it while earlier ones are unsent."""
        self._flush()
        if not self.unsent:
            self.send(message)

    def _flush(self) -> None:
        try:
            while self.unsent:
                self.unsent = self.unsent[os.write(self._out, self.unsent) :]
        except BlockingIOError:
            return
        except BrokenPipeError:
            self.unsent = b""
            self.open = False


def main(
    adapted: Callable[[UrSettings], UrSettings] | None = None, receiver: type[RtdeReceiver] = RtdeReceiver
) -> NoReturn:
    """Run until disconnected, or until the daemon or the controller is gone.

    `adapted` returns the settings to drive with, where these are not the daemon's; `receiver` is the connection for
    samples and deadlines.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    # The daemon receives the terminal's and the service manager's signals too, and decides when to stop.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Keep ur-rtde's prints out of the messages.
    stdout = os.dup(1)
    os.dup2(2, 1)
    pipe = Pipe(0, stdout)
    try:
        settings = receive_settings(pipe)
        if settings is None:
            _exit(EXIT_DONE)
        if adapted is not None:
            settings = adapted(settings)
        control(pipe, settings, connect(pipe, settings, receiver))
    except RobotLostError as error:
        pipe.send(messages.Failed(error.kind, str(error)))
        _exit(EXIT_FAILED)
    except Exception:  # noqa: BLE001 - printed, and the process exits all the same
        traceback.print_exc()
        _exit(EXIT_FAILED)


def receive_settings(pipe: Pipe) -> UrSettings | None:
    """Return the settings that the daemon sends first, None if it is gone."""
    while pipe.open:
        pipe.wait(60.0)
        received = pipe.receive()
        for number, (_, message) in enumerate(received, 1):
            if isinstance(message, UrSettings):
                # What the gripper holds comes right behind, before this process could start.
                pipe.keep(received[number:])
                return message
    return None


def connect(pipe: Pipe, settings: UrSettings, receiver: type[RtdeReceiver] = RtdeReceiver) -> "UrArm":
    """Return the arm behind its connected clients; raises RobotLostError."""
    _set_alarm(settings.connect_timeout_s)
    pipe.send(messages.WorkerPhase("loading ur-rtde"))
    from shearloop.drivers.ur.arm import UrArm

    host = settings.host
    try:
        pipe.send(messages.WorkerPhase("greeting the controller"))
        check_ports(host, settings.connect_timeout_s / 8)
        version = probe_controller(host, settings.connect_timeout_s / 4)
        check_generation(settings, version)
        # To a silent dashboard, ur-rtde says "Operation canceled".
        (answer,) = ask_dashboard(host, settings.connect_timeout_s / 4, (SERIAL_NUMBER,))
        controller = version, serial_number_in(answer)
        primary = PrimaryPort(host, settings.connect_timeout_s / 8)
        registers = free_registers(host, settings.connect_timeout_s / 8, version)
        if registers is None:
            raise registers_in_use(host)
        hints = (untested(version), primary.missing)
        warning = " ".join(hint.sentence for hint in hints if hint is not None)
        pipe.send(messages.WorkerPhase("connecting", warning, controller))
        return UrArm(settings, registers, primary, receiver)
    except RuntimeError as error:
        text = str(error)
        if "already in use" in text:
            raise registers_in_use(host) from error
        if "remote control" in text:
            raise RobotLostError("local-control", f"The robot at {host} is in local control: {REMOTE_CURE}.") from error
        raise RobotLostError(
            "unreachable", f"The connection to the robot at {host} failed: ur-rtde says “{text.strip()}”."
        ) from error


def control(pipe: Pipe, settings: UrSettings, arm: "UrArm") -> NoReturn:
    """Run cycles until disconnected; raises RobotLostError."""
    handler = CommandHandler(settings, arm, time.monotonic_ns())
    period_s, due_s, cycle = 1.0 / settings.rate_hz, time.monotonic(), 0
    leave_s = math.inf
    while True:
        _set_alarm(settings.hang_timeout_s)
        sample = arm.read()
        for error in arm.take_errors():
            pipe.send(error)
        if not sample.connected or sample.age_ns > 3 * settings.state_timeout_s * 1e9:
            raise RobotLostError("lost", why_unfit(sample, settings))
        handler.take(sample)
        handle_commands(pipe, handler)
        if not pipe.open and not handler.leaving:
            handler.request(0, messages.Disconnect(), time.monotonic_ns())
        if handler.leaving:
            leave_s = min(leave_s, time.monotonic() + BRAKE_S)
        if handler.recovering:
            # Announce a cycle that may take long.
            pipe.send_latest(handler.state(cycle))
            _set_alarm(messages.RECOVERY_HANG_S)
        ended = handler.tick(time.monotonic_ns())
        if ended is not None:
            number, reply = ended
            pipe.send(reply, number)
        if not handler.take_rejection():
            pipe.send_latest(handler.state(cycle))
        if (handler.leaving and handler.at_rest) or time.monotonic() > leave_s:
            _set_alarm(BRAKE_S + settings.hang_timeout_s)
            handler.take(arm.read())
            handler.end_program()
            _exit(EXIT_DONE)
        # A late cycle begins at once; missed ones are skipped.
        due_s, cycle = max(due_s + period_s, time.monotonic()), cycle + 1
        while (left_s := due_s - time.monotonic()) > 0:
            if handler.leaving or not pipe.open:
                time.sleep(left_s)
            elif pipe.wait(left_s):
                # Carry a command out on arrival: waiting for the next cycle would delay the loop.
                handler.take(arm.read())
                handle_commands(pipe, handler)


def handle_commands(pipe: Pipe, handler: CommandHandler) -> None:
    """Carry out the daemon's commands."""
    for number, message in pipe.receive():
        if isinstance(message, messages.Held):
            handler.take_held(message)
        elif isinstance(message, messages.Command | messages.Heartbeat):
            reply = handler.request(number, message, time.monotonic_ns())
            if reply is not None:
                pipe.send(reply, number)


def _set_alarm(seconds: float) -> None:
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _exit(status: int) -> NoReturn:
    # Without ur-rtde's destructors, which hang and abort; the kernel closes the sockets.
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
