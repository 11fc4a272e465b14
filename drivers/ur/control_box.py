"""The robot's control box without ur-rtde: probe, mode, dashboard commands, RTDE samples with their age, deadlines.

RTDE: UR's RTDE guide, protocol 2. Dashboard: UR's "Dashboard Server e-Series" page, one line each way. ur-rtde does not
check the answer to its protocol request and waits without a limit for a silent peer, so that this module asks first.
"""

import math
import os
import re
import select
import socket
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

from shearloop.drivers.defaults import DASHBOARD_PORT, EMULATED_ANSWER, EMULATED_SERIAL_NUMBER, RTDE_PORT, SCRIPT_PORT
from shearloop.drivers.errors import DriverError, ProtocolError, system_reason
from shearloop.drivers.ur.messages import RUNTIME_PLAYING, RobotLostError, RtdeOutputs, silent_sentence
from shearloop.drivers.ur.script import LOWER, NO_MOTION_TICKS, UPPER, ScriptRegisters
from shearloop.drivers.ur.settings import GENERATIONS, UrSettings

# The services behind the ports, as PolyScope's menu names them.
SERVICES: Final = {RTDE_PORT: "RTDE", SCRIPT_PORT: "Real-Time Client", DASHBOARD_PORT: "Dashboard Server"}
# From this version on an e-Series opens only the enabled interfaces.
FIRST_WITH_SERVICES: Final = (5, 10)
SERVICES_MENU: Final = "Settings → Security → Services"
REMOTE_CURE: Final = (
    "switch it to remote control, top right on the teach pendant (enable that first under Settings → System → Remote "
    "Control)"
)
# The dashboard's answer to a request that it carries out (UR's page "Dashboard Server e-Series").
_CARRIED_OUT: Final = {
    "unlock protective stop": "Protective stop releasing",
    "power on": "Powering on",
    "brake release": "Brake releasing",
    "stop": "Stopped",
    "close popup": "closing popup",
    "close safety popup": "closing safety popup",
}
# Without these the arm does not get ready.
_INDISPENSABLE: Final = ("unlock protective stop", "power on", "brake release")
# The dashboard's request for the robot's serial number.
SERIAL_NUMBER: Final = "get serial number"
SCRIPT_READY: Final = 1
HEADER: Final = struct.Struct(">HB")
_PROTOCOL, _CONTROLLER_VERSION, _OUTPUTS, _INPUTS, _START, _DATA = b"VvOISU"
# By major version: the oldest controllers with all that ur-rtde uses, and the newest that ur-rtde 1.6 is tested on.
OLDEST: Final = {3: (3, 10), 5: (5, 4)}
NEWEST_TESTED: Final = {3: (3, 15, 8), 5: (5, 17, 3)}
_OTHER_PACKAGES = 20
# A peer that acknowledges nothing for this time is gone.
_PEER_GONE_S = 3
_LONGEST_LINE = 1024
# The outputs and their types, in the order of a sample's fields; the script's registers come last.
_TYPES: Final = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "target_speed_fraction": "DOUBLE",
    "speed_scaling": "DOUBLE",
}
# Outputs that controllers have from PolyScope 3.12 and 5.5.1 on.
_TOOL_TYPES: Final = {"payload": "DOUBLE", "payload_cog": "VECTOR3D", "tcp_offset": "VECTOR6D"}
# The same outputs, after the header and the recipe's number.
_VALUES: Final = struct.Struct(">d30d2iI2d2id")
_TOOL_VALUES: Final = struct.Struct(">d3d6d")
_PACKAGE_BYTES: Final = HEADER.size + 1 + _VALUES.size
_PACKAGE_SIZES: Final = (_PACKAGE_BYTES, _PACKAGE_BYTES + _TOOL_VALUES.size)
_NO_TOOL: Final = (math.nan,) * 10
# An input package: the header, the recipe's number and one value.
_DEADLINE: Final = struct.Struct(">HBBi")
# One second of samples.
_READ_BYTES = 1 << 15
# The smallest clock offset may rise by this share of the time. Clocks drift by up to 500 ppm, and a simulator's may be
# slow by some thousandths on a busy computer. A delay of 0.1 s is forgotten after 10 s.
_OFFSET_RISE = 1e-2


@dataclass(frozen=True, slots=True)
class ControllerInfo:
    """A controller's mode. `remote` is None if the controller has no remote mode (CB series)."""

    version: str
    serial_number: str
    robot_mode: str
    safety_mode: str
    remote: bool | None
    # Those that the daemon would use; None where other clients write both halves.
    registers: ScriptRegisters | None


def probe_controller(host: str, timeout_s: float) -> str:
    """Return the controller's version, as 5.17.3.0, after agreeing on protocol 2.

    Raises:
        RobotLostError: it is not there, stays silent, refuses the protocol, or its version is not supported.
    """
    with _connected(host, RTDE_PORT, timeout_s, "greeting it") as connection:
        answer = _request(connection, _CONTROLLER_VERSION)
        numbers = struct.unpack(">4I", answer[:16])
        accepted = _agree_on_protocol(connection)
    version = ".".join(map(str, numbers))
    if numbers[0] not in OLDEST or numbers < OLDEST[numbers[0]]:
        raise RobotLostError(
            "version",
            f"The UR controller at {host} has PolyScope {version}, which cannot be driven; install PolyScope 3.10 "
            "(CB3) or 5.4 (e-Series), or a newer 3.x or 5.x, and restart the daemon.",
        )
    if not accepted:
        raise RobotLostError(
            "protocol",
            f"The UR controller at {host} refuses version 2 of the RTDE protocol. Restart the controller; the daemon "
            "tries again.",
        )
    return version


def check_generation(settings: UrSettings, version: str) -> None:
    """Raise RobotLostError where a controller of this version is not of the generation in the settings."""
    major = int(version.split(".", maxsplit=1)[0])
    if major != settings.facts.major:
        found = next((key for key, facts in GENERATIONS.items() if facts.major == major), "unknown")
        raise RobotLostError(
            "version",
            f"The UR controller at {settings.host} has PolyScope {version}, and the robot's settings are for "
            f"{settings.facts.name}: write `generation: {found}` into them, check their limits of force and torque, "
            "and restart the daemon.",
        )


def untested_sentence(version: str) -> str:
    """Return a warning about a version (5.17.3.0) that is newer than those tested, or an empty string."""
    numbers = tuple(map(int, version.split(".")))[:3]
    newest = NEWEST_TESTED[numbers[0]]
    if numbers <= newest:
        return ""
    tested = ".".join(map(str, newest))
    return f"PolyScope {version} is newer than {tested}, the newest that ur-rtde 1.6 is tested on: move slowly first."


def query_controller(host: str, timeout_s: float) -> ControllerInfo:
    """Return a controller's mode without changing anything; DriverError where it is absent or silent."""
    version = probe_controller(host, timeout_s)
    requests = ("robotmode", "safetymode", "is in remote control", SERIAL_NUMBER)
    robot_mode, safety_mode, remote, serial_number = ask_dashboard(host, timeout_s, requests)
    return ControllerInfo(
        version,
        serial_number_in(serial_number),
        robot_mode.removeprefix("Robotmode: "),
        safety_mode.removeprefix("Safetymode: "),
        {"true": True, "false": False}.get(remote.lower()),
        free_registers(host, timeout_s),
    )


def free_registers(host: str, timeout_s: float) -> ScriptRegisters | None:
    """Return the half of the input registers that no other client writes, the upper one first; None for neither."""
    for registers in (UPPER, LOWER):
        # A register belongs to a connection: closing it gives the register back.
        with _connected(host, RTDE_PORT, timeout_s, "asking for its registers") as connection:
            _agree_on_protocol(connection)
            if b"IN_USE" not in _request(connection, _INPUTS, ",".join(registers.inputs).encode()):
                return registers
    return None


def serial_number_in(answer: str) -> str:
    """Return the serial number in an answer to `SERIAL_NUMBER`; empty where the request is unknown."""
    if answer == EMULATED_ANSWER:
        return EMULATED_SERIAL_NUMBER
    return answer if answer.isdigit() else ""


def ask_dashboard(host: str, timeout_s: float, requests: tuple[str, ...]) -> list[str]:
    """Return the dashboard server's answers; DriverError where it is absent or silent."""
    answers = []
    activity = f"asking its dashboard server (port {DASHBOARD_PORT})"
    with _connected(host, DASHBOARD_PORT, timeout_s, activity) as connection, connection.makefile("rb") as lines:
        lines.readline(_LONGEST_LINE)  # the banner
        for request in requests:
            connection.sendall(f"{request}\n".encode())
            answer = lines.readline(_LONGEST_LINE)
            if not answer:
                raise DriverError(f"The dashboard server at {host} closed the connection at `{request}`.")
            answers.append(answer.decode(errors="replace").strip())
    return answers


def command_dashboard(host: str, timeout_s: float, requests: tuple[str, ...]) -> str:
    """Have the dashboard server carry out requests; return its refusal of one that can be done without, else nothing.

    Raises DriverError with the controller's own words where it refuses an indispensable one, or any in local control,
    and where it is absent or silent.
    """
    answers = ask_dashboard(host, timeout_s, requests)
    refused = {
        request: answer
        for request, answer in zip(requests, answers, strict=True)
        if answer.lower() != _CARRIED_OUT[request].lower()
    }
    if not refused:
        return ""
    request = next((one for one in refused if one in _INDISPENSABLE), next(iter(refused)))
    said = f"The controller answered “{refused[request]}” to `{request}`"
    (remote,) = ask_dashboard(host, timeout_s, ("is in remote control",))
    if remote.lower() == "false":
        raise DriverError(f"The robot is in local control: {REMOTE_CURE}. {said}.")
    if request in _INDISPENSABLE:
        raise DriverError(f"{said}: look at the teach pendant, then unlock again.")
    return said


def probe_ports(host: str, timeout_s: float) -> dict[int, str]:
    """Return why each of the controller's ports cannot be reached; empty texts for those that are open."""
    found: dict[int, str] = {}
    for port in SERVICES:
        try:
            with socket.create_connection((host, port), timeout_s):
                found[port] = ""
        except TimeoutError:
            # No controller answers; each further port would take as long.
            return {**dict.fromkeys(SERVICES, "no answer"), **found}
        except OSError as error:
            found[port] = system_reason(error)
    return found


def check_ports(host: str, timeout_s: float) -> None:
    """Raise RobotLostError, with the menu, where a controller is there and does not serve every port that is needed."""
    found = probe_ports(host, timeout_s)
    closed = [port for port, reason in found.items() if reason]
    if closed and len(closed) < len(found):
        raise RobotLostError("unreachable", closed_ports_sentence(host, closed, _known_version(host, timeout_s)))


def closed_ports_sentence(host: str, closed: Sequence[int], version: tuple[int, ...]) -> str:
    """Return which ports are closed at a controller of this version, empty if unknown, and where to open them."""
    names = " and ".join(f"{port} ({SERVICES[port]})" for port in closed)
    refuses = f"The controller at {host} does not serve {'port' if len(closed) == 1 else 'the ports'} {names}"
    enable = f"enable {' and '.join(SERVICES[port] for port in closed)} under {SERVICES_MENU}"
    if not version:
        older = "a CB3 or an older version always serves them: look for a firewall"
        return f"{refuses}; on an e-Series from PolyScope 5.10 on, {enable} ({older})."
    if version >= FIRST_WITH_SERVICES:
        return f"{refuses}; {enable}."
    series = "a CB3" if version[0] == 3 else f"PolyScope {'.'.join(map(str, version))}"
    return f"{refuses}; {series} has no menu for them: wait until it has started, and look for a firewall between."


def _known_version(host: str, timeout_s: float) -> tuple[int, ...]:
    """Return the major and minor version from the dashboard server or RTDE; empty if neither reports it."""
    with suppress(DriverError):
        (answer,) = ask_dashboard(host, timeout_s, ("PolyscopeVersion",))
        if found := re.search(r"(\d+)\.(\d+)", answer):
            return int(found[1]), int(found[2])
    with suppress(DriverError):
        major, minor, *_ = probe_controller(host, timeout_s).split(".")
        return int(major), int(minor)
    return ()


@contextmanager
def explain_failure(host: str, timeout_s: float, activity: str) -> Iterator[None]:
    """Turn a failed or unanswered exchange with the controller into a RobotLostError."""
    try:
        yield
    except TimeoutError as error:
        raise RobotLostError("silent", silent_sentence(host, timeout_s, activity)) from error
    except (OSError, struct.error) as error:
        reason = system_reason(error) if isinstance(error, OSError) else "it does not answer as one"
        raise RobotLostError(
            "unreachable",
            f"No UR controller at {host}: {reason}. Check that it is switched on and that this computer is in its "
            f"network (Settings → System → Network at the teach pendant){_all_refused_hint(error)}.",
        ) from error


@contextmanager
def _connected(host: str, port: int, timeout_s: float, activity: str) -> Iterator[socket.socket]:
    """Connect to a port of the controller until the end of the block."""
    with explain_failure(host, timeout_s, activity):
        try:
            connection = socket.create_connection((host, port), timeout_s)
        except ConnectionRefusedError as error:
            closed = [number for number, reason in probe_ports(host, timeout_s).items() if reason]
            if len(closed) == len(SERVICES):
                raise
            # Without asking for the version, which needs the same ports.
            raise RobotLostError("unreachable", closed_ports_sentence(host, closed or [port], ())) from error
        with connection:
            yield connection


def _all_refused_hint(error: Exception) -> str:
    # Something at that address answers, so that it is no matter of the cable.
    if not isinstance(error, ConnectionRefusedError):
        return ""
    return f", and on an e-Series from PolyScope 5.10 on that its services are enabled ({SERVICES_MENU})"


def registers_in_use(host: str) -> RobotLostError:
    """Return the error about input registers that another client writes."""
    return RobotLostError(
        "registers-in-use",
        f"The input registers of the robot at {host} are already in use by another RTDE client, EtherNet/IP or "
        "PROFINET, or a URCap: end the other program, disable the adapter under Installation → Fieldbus, or uninstall "
        "the URCap. A program whose cable was pulled keeps its registers for some minutes.",
    )


def lose_dead_peers(connection: socket.socket) -> None:
    """Send each package at once, and end the connection some seconds after its peer has vanished."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        (socket.TCP_KEEPIDLE, 1),
        (socket.TCP_KEEPINTVL, 1),
        (socket.TCP_KEEPCNT, _PEER_GONE_S),
        (socket.TCP_USER_TIMEOUT, 1000 * _PEER_GONE_S),
    ):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)


def lose_dead_peers_of_ports(ports: Iterable[int] = tuple(SERVICES)) -> None:
    """Call `lose_dead_peers` for all connections of this process to these ports: ur-rtde hides its sockets."""
    for descriptor in os.listdir("/proc/self/fd"):
        # The listing's own descriptor is closed by then, and a socket that waits for clients has no peer.
        with suppress(OSError):
            if not os.readlink(f"/proc/self/fd/{descriptor}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(descriptor))) as connection:
                if connection.family in (socket.AF_INET, socket.AF_INET6) and connection.getpeername()[1] in ports:
                    lose_dead_peers(connection)


def _agree_on_protocol(connection: socket.socket) -> bool:
    """Ask for protocol 2 and return whether the controller accepts it."""
    return _request(connection, _PROTOCOL, b"\x00\x02")[:1] == b"\x01"


def _request(connection: socket.socket, kind: int, payload: bytes = b"") -> bytes:
    """Send an RTDE package and return the next one of its kind; OSError where the next twenty are of other kinds."""
    connection.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
    for _ in range(_OTHER_PACKAGES):
        size, got = HEADER.unpack(_receive_exactly(connection, HEADER.size))
        answer = _receive_exactly(connection, size - HEADER.size)
        if got == kind:
            return answer
    raise OSError("something else than RTDE listens on its port")


def _receive_exactly(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise OSError("the connection was closed")
        data += part
    return data


def register_round_trip(host: str, timeout_s: float, registers: ScriptRegisters, value: int) -> int:
    """Write a value into our register, and return what the controller reports of it; no program may run.

    Raises:
        RobotLostError: the register is in use, or the controller does not answer.
    """
    with _connected(host, RTDE_PORT, timeout_s, "writing a register") as connection:
        _agree_on_protocol(connection)
        name = registers.deadline.encode()
        _request(connection, _OUTPUTS, struct.pack(">d", 125.0) + name)
        answer = _request(connection, _INPUTS, name)
        if b"IN_USE" in answer:
            raise registers_in_use(host)
        _request(connection, _START)
        connection.sendall(_DEADLINE.pack(_DEADLINE.size, _DATA, answer[0], value))
        read = value + 1
        for _ in range(_OTHER_PACKAGES):
            size, kind = HEADER.unpack(_receive_exactly(connection, HEADER.size))
            content = _receive_exactly(connection, size - HEADER.size)
            if kind == _DATA and (read := struct.unpack(">i", content[1:5])[0]) == value:
                break
        # An old deadline must not stay.
        connection.sendall(_DEADLINE.pack(_DEADLINE.size, _DATA, answer[0], NO_MOTION_TICKS))
        return read


class SampleParser:
    """Finds the newest sample in the controller's byte stream. No I/O."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes) -> RtdeOutputs | None:
        """Return the newest sample that `data` completes, or None.

        Raises:
            ProtocolError: a package is invalid, so that the start of the next one is unknown.
        """
        data, starts = self._split(data)
        return _outputs_at(data, starts[-1]) if starts else None

    def feed_all(self, data: bytes) -> list[RtdeOutputs]:
        """Return every sample that `data` completes, oldest first; raises as `feed` does."""
        data, starts = self._split(data)
        return [_outputs_at(data, start) for start in starts]

    def _split(self, data: bytes) -> tuple[bytes, list[int]]:
        """Return all bytes, and where a whole sample begins in them; keep the rest for later."""
        data = self._buffer + data
        start, starts, received = 0, [], len(data)
        while received - start >= HEADER.size:
            size, kind = HEADER.unpack_from(data, start)
            if size < HEADER.size or (kind == _DATA and size not in _PACKAGE_SIZES):
                raise ProtocolError(f"The controller sent a package of kind {kind} with {size} bytes.")
            if received - start < size:
                break
            if kind == _DATA:
                starts.append(start)
            start += size
        self._buffer = data[start:]
        return data, starts


def _outputs_at(data: bytes, start: int) -> RtdeOutputs:
    """Return the sample in the package that begins at `start`."""
    (size, _), start = HEADER.unpack_from(data, start), start + HEADER.size + 1
    v = _VALUES.unpack_from(data, start)
    tool = _NO_TOOL if size == _PACKAGE_BYTES else _TOOL_VALUES.unpack_from(data, start + _VALUES.size)
    motion = v[0], v[1:7], v[7:13], v[13:19], v[19:25], v[25:31]
    modes, scalings, script = (v[31], v[32], v[33]), (v[34], v[35]), (v[36], v[37], v[38])
    return RtdeOutputs(*motion, *modes, *scalings, *script, tool[0], tool[1:4], tool[4:])


class RtdeReceiver:
    """A connection for the controller's samples and our register; `connected` is False once it has ended.

    Samples wait in the kernel until `latest` takes the newest one. ur-rtde's interface polls its socket instead, which
    takes a third of the worker's processor time at rest.
    """

    def __init__(
        self, host: str, rate_hz: float, timeout_s: float, registers: ScriptRegisters = UPPER, *, writes: bool = True
    ) -> None:
        """Connect and wait for the first sample. One that only observes leaves our register to others.

        Raises:
            RobotLostError: the controller is absent or silent, does not send the outputs, or our register is in use.
        """
        self._host, self._writes = host, writes
        self._registers = registers
        self._recipe = 0
        self._parser = SampleParser()
        self.connected = True
        with explain_failure(host, timeout_s, "asking for its state"):
            self.connection = socket.create_connection((host, RTDE_PORT), timeout=timeout_s)
            lose_dead_peers(self.connection)
            try:
                self._sample = self._first_sample(rate_hz)
            except BaseException:
                self.close()
                raise
        self.connection.setblocking(False)

    def close(self) -> None:
        """Close the connection."""
        self.connected = False
        self.connection.close()

    def _first_sample(self, rate_hz: float) -> RtdeOutputs:
        _agree_on_protocol(self.connection)
        registers = self._registers
        known = _TYPES | {registers.state: "INT32", registers.clock: "INT32", registers.step: "DOUBLE"}
        for outputs in (known | _TOOL_TYPES, known):
            answer = _request(self.connection, _OUTPUTS, struct.pack(">d", rate_hz) + ",".join(outputs).encode())
            types = answer[1:].decode(errors="replace")
            if types == ",".join(outputs.values()):
                break
        else:
            raise OSError(f"its outputs are of the types {types}")
        if self._writes:
            answer = _request(self.connection, _INPUTS, self._registers.deadline.encode())
            if b"IN_USE" in answer:
                raise registers_in_use(self._host)
            self._recipe = answer[0]
        if _request(self.connection, _START) != b"\x01":
            raise OSError("it does not send its state")
        while self.connected:
            sample = self._receive()
            if sample is not None:
                return sample
        raise OSError("it closed the connection for its states")

    def latest(self) -> RtdeOutputs:
        """Return the newest sample received, without waiting."""
        if self.connected:
            self._sample = self._receive() or self._sample
        return self._sample

    def write_deadline(self, script_ticks: int) -> None:
        """Write when the motion has to end, by the script's clock."""
        try:
            self.connection.send(_DEADLINE.pack(_DEADLINE.size, _DATA, self._recipe, script_ticks))
        except OSError:
            # Also where the socket is full: the controller has read nothing for long.
            self.connected = False

    def wait(self, seconds: float) -> bool:
        """Wait for data, at most this long, and return whether there is any."""
        return self.connected and bool(select.select([self.connection], [], [], max(0.0, seconds))[0])

    def receive_all(self) -> list[RtdeOutputs]:
        """Return every sample received since the last call, oldest first, without waiting."""
        samples: list[RtdeOutputs] = []
        if self.connected:
            self._receive(samples)
        return samples

    def _receive(self, every: list[RtdeOutputs] | None = None) -> RtdeOutputs | None:
        """Return the newest sample received, if any; `every` gets all."""
        newest, more = None, True
        while more:
            try:
                data = self.connection.recv(_READ_BYTES)
                if every is None:
                    newest = self._parser.feed(data) or newest
                else:
                    every += self._parser.feed_all(data)
            except BlockingIOError:
                break
            except (OSError, ProtocolError) as error:
                if isinstance(error, TimeoutError) and self.connection.gettimeout():
                    # Only the first sample has a timeout of ours; a later one is the network's.
                    raise
                data = b""
            self.connected, more = bool(data), len(data) == _READ_BYTES
        return newest


class SampleAge:
    """The age of each sample by the controller's clock. No clock here: both times are arguments.

    A sample that is new to us may have waited in a socket. The offset between the two clocks is unknown, but its
    smallest value belongs to the fastest sample; later samples have waited for the difference.
    """

    def __init__(self) -> None:
        self._timestamp_s = math.nan
        self._made_ns = 0
        self._offset_ns = self._seen_ns = 0

    def age_ns(self, timestamp_s: float, now_ns: int) -> int:
        """Return the time in ns since the newest sample was made; 0 for the first.

        A sample without a timestamp, or with an earlier one, is not new. A restarted controller has a new clock, so it
        gets too old, is lost, and is connected again.
        """
        if math.isfinite(timestamp_s) and not timestamp_s <= self._timestamp_s:
            self._update(timestamp_s, now_ns)
        return max(0, now_ns - self._made_ns)

    def _update(self, timestamp_s: float, now_ns: int) -> None:
        stamped_ns = round(timestamp_s * 1e9)
        offset_ns = now_ns - stamped_ns
        if math.isfinite(self._timestamp_s):
            risen_ns = self._offset_ns + round(_OFFSET_RISE * (now_ns - self._seen_ns))
            offset_ns = min(offset_ns, risen_ns)
        self._timestamp_s, self._offset_ns, self._seen_ns = timestamp_s, offset_ns, now_ns
        self._made_ns = stamped_ns + offset_ns


class ScriptReadiness:
    """Waits until the control script is ready for the next command (the first output register).

    ur-rtde waits for that itself at the start of each call: without sleeping, for up to 4 s, also after the program has
    ended. Waiting here first keeps its calls short.
    """

    def __init__(self, samples: RtdeReceiver, timeout_s: float) -> None:
        """Wait for `timeout_s` at most: meanwhile nothing else is sent, and nothing extends a motion."""
        self._samples, self._timeout_s = samples, timeout_s
        # By the controller's clock; only a later sample shows the script after the command.
        self._command_s = -math.inf
        self.waiting = False

    def command_sent(self) -> None:
        """Note that a one-time command was sent, or a program started."""
        self._command_s, self.waiting = self._samples.latest().timestamp_s, True

    def wait(self) -> bool:
        """Return whether the script is ready; False after the timeout or when the program does not play."""
        if not self.waiting:
            return True
        until_s = time.monotonic() + self._timeout_s
        while True:
            sample = self._samples.latest()
            if not self._samples.connected or sample.runtime_state != RUNTIME_PLAYING:
                return False
            if sample.timestamp_s > self._command_s and sample.script_state == SCRIPT_READY:
                self.waiting = False
                return True
            if not self._samples.wait(until_s - time.monotonic()):
                return False
