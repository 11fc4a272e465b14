"""The robot's own process, `python -m shearloop.drivers.ur.worker`: commands on stdin, states and replies on stdout.

It goes through 125 cycles a second, and tells the state of each.

It may hang or crash in ur-rtde at any time and holds nothing worth saving. Before every stretch that may hang it sets
an alarm that the kernel answers by ending it, whatever holds the interpreter lock; the robot's watchdog then ends the
motion. When stdin ends the daemon is gone: it stops the arm and goes too.
"""

import contextlib
import os
import select
import signal
import sys
import time
import traceback
from typing import TYPE_CHECKING, NoReturn

from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.messages import (
    RECOVERY_HANG_S,
    Command,
    CommandReply,
    Configure,
    Disconnect,
    Failed,
    FailureKind,
    Heartbeat,
    Message,
    MoveLinear,
    RobotPhase,
    RtdeSample,
    Stop,
    WristSpeed,
)
from shearloop.drivers.ur.probe import ProbeError, probe
from shearloop.drivers.ur.settings import UrSettings
from shearloop.drivers.ur.wire import Decoder, encode

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

EXIT_DONE, EXIT_FAILED = 0, 3
COMMANDS = Command.__args__
# Motion that the daemon leaves behind is braked in this time; the robot's watchdog ends what is not.
FAREWELL_S = 1.0
# States that a slow daemon does not fetch are dropped, as the latest counts; replies wait, within this bound.
MOST_UNSENT = 1 << 16


class Pipe:
    """The two ends to the daemon, neither of which ever blocks."""

    def __init__(self, stdin: int, stdout: int) -> None:
        """Take over both descriptors."""
        self._in, self._out = stdin, stdout
        self._decoder = Decoder()
        self._unsent = b""
        self.open = True
        os.set_blocking(stdin, False)
        os.set_blocking(stdout, False)

    def wait(self, timeout_s: float) -> bool:
        """Wait for input, and return whether there is any."""
        return bool(select.select([self._in], [], [], timeout_s)[0])

    def receive(self) -> list[tuple[int, Message]]:
        """Return the messages that have arrived; `open` is False once the daemon is gone."""
        try:
            data = os.read(self._in, 1 << 16)
        except BlockingIOError:
            return []
        self.open = self.open and bool(data)
        return self._decoder.feed(data)

    def send(self, message: Message, number: int = 0) -> None:
        """Send a message that must arrive."""
        self._unsent += encode(message, number)
        self._flush()
        if len(self._unsent) > MOST_UNSENT:
            self.open = False

    def send_latest(self, message: Message) -> None:
        """Send a message unless others are still waiting."""
        self._flush()
        if not self._unsent:
            self.send(message)

    def _flush(self) -> None:
        try:
            while self._unsent:
                self._unsent = self._unsent[os.write(self._out, self._unsent) :]
        except BlockingIOError:
            return
        except BrokenPipeError:
            self._unsent = b""
            self.open = False


def main() -> NoReturn:
    """Run until told to go, until the daemon is gone, or until the controller is."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    # Ctrl-C at the terminal and its end reach the daemon too, as does a service manager's; it then says when to stop.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # What the client prints must not get between the messages.
    stdout = os.dup(1)
    os.dup2(2, 1)
    pipe = Pipe(0, stdout)
    try:
        configured = _configuration(pipe)
        if configured is None:
            _leave(EXIT_DONE)
        _fly(pipe, configured, _connect(pipe, configured.settings))
    except Exception:  # noqa: BLE001 - told, and the end of the process all the same
        traceback.print_exc()
        _leave(EXIT_FAILED)


def _configuration(pipe: Pipe) -> Configure | None:
    while pipe.open:
        pipe.wait(60.0)
        for _, message in pipe.receive():
            if isinstance(message, Configure):
                return message
    return None


def _connect(pipe: Pipe, settings: UrSettings) -> "UrArm":
    _alarm(settings.connect_timeout_s)
    pipe.send(RobotPhase("loading ur-rtde"))
    try:
        from shearloop.drivers.ur.arm import UrArm
    except ImportError:
        _fail(pipe, "not-installed", sentences.NOT_INSTALLED)
    pipe.send(RobotPhase("greeting the controller"))
    try:
        version = probe(settings.host, settings.connect_timeout_s / 3)
    except ProbeError as error:
        _fail(pipe, error.kind, str(error))
    pipe.send(RobotPhase("connecting"))
    try:
        return UrArm(settings, version)
    except ProbeError as error:
        _fail(pipe, error.kind, str(error))
    except RuntimeError as error:
        _fail(pipe, *_explain(settings.host, str(error)))


def _explain(host: str, text: str) -> tuple[FailureKind, str]:
    if "already in use" in text:
        return "registers-in-use", sentences.registers_in_use(host)
    if "remote control" in text:
        return "local-control", sentences.local_control(host)
    return "unreachable", sentences.refused_by_client(host, text)


def _fly(pipe: Pipe, configured: Configure, arm: "UrArm") -> NoReturn:
    settings = configured.settings
    pilot = CommandHandler(settings, arm, time.monotonic_ns(), takes_over=configured.takes_over)
    period_s, due_s, cycle = 1.0 / settings.rate_hz, time.monotonic(), 0
    leaving_s = 0.0
    while True:
        _alarm(settings.hang_timeout_s)
        reading = arm.read()
        if not reading.connected or reading.age_ns > 3 * settings.state_timeout_s * 1e9:
            _fail(pipe, "lost", sentences.unfit(reading, settings.host, settings.state_timeout_s))
        if _obey(pipe, pilot, reading):
            leaving_s = time.monotonic() + FAREWELL_S
        if not pipe.open and not leaving_s:
            pilot.request(0, Disconnect(), reading, time.monotonic_ns())
            leaving_s = time.monotonic() + FAREWELL_S
        if pilot.recovering:
            # The daemon learns beforehand that this cycle may take long.
            pipe.send_latest(pilot.state(reading, cycle))
            _alarm(RECOVERY_HANG_S)
        decided = pilot.tick(reading, time.monotonic_ns())
        if decided is not None:
            pipe.send(decided[1], decided[0])
        if not pilot.puzzled():
            pipe.send_latest(pilot.state(reading, cycle))
        if leaving_s and (pilot.at_rest or time.monotonic() > leaving_s):
            _end_program(settings, pilot, arm)
            _leave(EXIT_DONE)
        # A late cycle begins at once, and is not caught up with.
        due_s, cycle = max(due_s + period_s, time.monotonic()), cycle + 1
        while (left_s := due_s - time.monotonic()) > 0:
            if leaving_s or not pipe.open:
                time.sleep(left_s)
            # A command is carried out when it comes: waiting for the next cycle would be a delay in the loop.
            elif pipe.wait(left_s) and _obey(pipe, pilot, arm.read()):
                leaving_s = time.monotonic() + FAREWELL_S


def _end_program(settings: UrSettings, pilot: CommandHandler, arm: "UrArm") -> None:
    """Leave no program of ours behind: none that a late upload has started, and none that waits to be resumed.

    What is somebody else's plays on: only the operator stops it, with `unlock`.
    """
    _alarm(settings.hang_timeout_s)
    reading = arm.read()
    if reading.program_running:
        if pilot.may_be_ours(time.monotonic_ns()):
            arm.end_program()
    elif pilot.left_paused(reading):
        _alarm(FAREWELL_S + settings.hang_timeout_s)
        arm.stop_program()


def _obey(pipe: Pipe, pilot: CommandHandler, reading: RtdeSample) -> bool:
    """Carry out what the daemon has sent; return whether it says to go."""
    goes = False
    for number, command in _newest(pipe, pilot):
        reply = pilot.request(number, command, reading, time.monotonic_ns())
        if reply is not None:
            pipe.send(reply, number)
        goes = goes or isinstance(command, Disconnect)
    return goes


def _newest(pipe: Pipe, pilot: CommandHandler) -> list[tuple[int, Command]]:
    """Return the commands to carry out in this cycle: of motions only the latest, the others answered as overtaken."""
    commands: list[tuple[int, Command]] = []
    for number, message in pipe.receive():
        pilot.heard(time.monotonic_ns())
        if isinstance(message, COMMANDS):
            commands.append((number, message))
        elif not isinstance(message, Heartbeat):
            raise TypeError(f"the daemon sent a {type(message).__name__}, which is no command")
    motions = [n for n, (_, command) in enumerate(commands) if isinstance(command, WristSpeed | MoveLinear | Stop)]
    # A stop is never overtaken: what comes after it finds the arm stopping.
    overtaken = [n for n in motions[:-1] if not isinstance(commands[n][1], Stop)]
    for index in overtaken:
        pipe.send(CommandReply(refused="A newer command came before this one could be sent."), commands[index][0])
    return [entry for index, entry in enumerate(commands) if index not in overtaken]


def _alarm(seconds: float) -> None:
    signal.setitimer(signal.ITIMER_REAL, seconds)


def _fail(pipe: Pipe, kind: FailureKind, sentence: str) -> NoReturn:
    pipe.send(Failed(kind, sentence))
    _leave(EXIT_FAILED)


def _leave(status: int) -> NoReturn:
    # Not through the interpreter's end: the client's destructors hang and abort, and the kernel closes sockets as well.
    with contextlib.suppress(OSError):
        sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
