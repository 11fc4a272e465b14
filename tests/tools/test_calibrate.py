"""The guided calibrations and the emulators from the command line, each as a process of its own."""

import asyncio
import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from itertools import cycle
from types import SimpleNamespace

import pytest
import yaml

from shearloop.cli.calibrate import load
from shearloop.cli.terminal import Operator
from shearloop.daemon.rig_memory import Remembered, read_memory, write_memory
from shearloop.daemon.robot_files import lock_gripper, memory_path
from shearloop.drivers.calibration_files import load_device_calibration
from shearloop.drivers.connection import SerialPort
from shearloop.drivers.errors import DeviceLostError
from shearloop.drivers.load_cell import LoadCalibration
from shearloop.drivers.load_cell_calibration import Level, fit_levels
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.script import LOWER
from shearloop.emulators.boards import Hx711Board
from shearloop.tools import robot_use
from tests.emulator_process import own_address
from tests.running import running

# Without a robot's controller, which another program on this computer may play at 127.0.0.1.
HOST = own_address(1)

SHEARLOOP = (sys.executable, "-m", "shearloop")
COUNTS_PER_NM = 420e3 / (9.80665 * 0.035)


class Silent(Operator):
    """An operator who presses no key."""

    def __enter__(self) -> "Silent":
        return self


class Process(contextlib.AbstractContextManager["Process", None]):
    """A command with pipes; the end of its input ends it."""

    def __init__(self, *arguments: str) -> None:
        self._child = subprocess.Popen(
            [*SHEARLOOP, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.said: list[str] = []

    def __exit__(self, *_: object) -> None:
        with self._child:
            self.end()

    def tell(self, line: str) -> None:
        self._child.stdin.write(f"{line}\n")
        self._child.stdin.flush()

    def carry_out(self, line: str) -> None:
        """Tell an emulator something, and wait until it has been done: commands are taken in order."""
        self.tell(line)
        self.tell("?")
        assert "'?'" in self._child.stderr.readline()

    def hear(self, beginning: str | tuple[str, ...], *, on_stderr: bool = False) -> str:
        """Return the next line that begins like this, or like one of these."""
        stream = self._child.stderr if on_stderr else self._child.stdout
        for line in stream:
            self.said.append(line.strip())
            if line.startswith(beginning):
                return line.strip()
        raise AssertionError(
            f"never said {beginning!r}: {self.said}, {self._child.stderr and self._child.stderr.read()}"
        )

    def measure(self, mass_g: int, *, on_stderr: bool = False) -> None:
        """Press Enter, twice at most: on a busy computer the first readings may be from before the mass."""
        self.tell("")
        if self.hear(("  ", "Put"), on_stderr=on_stderr).startswith("Put"):
            self.tell("")
            self.hear(f"  {mass_g} g:", on_stderr=on_stderr)

    def end(self) -> tuple[int, str, str]:
        """Close its input; return its status and what it said that nobody has heard yet.

        `communicate` would not do: it reads the pipes beside the streams, whose buffers may hold lines already.
        What these commands say fits into a pipe, so that none of them waits for a reader.
        """
        self._child.stdin.close()
        status = self._child.wait(timeout=30)
        return status, self._child.stdout.read(), self._child.stderr.read()


@pytest.mark.long
@pytest.mark.parametrize("script", [False, True], ids=["for a person", "for a script"])
def test_the_load_cell_is_calibrated_step_by_step_and_a_step_can_be_refused(tmp_path, script):
    link, out = tmp_path / "load", tmp_path / "load.yaml"
    with Process("emulate", "hx711", "--link", str(link), "--speed", "20") as board:
        board.hear(str(link))
        arguments = ("--port", str(link), "--mass-g", "100", "--mass-g", "200", "--out", str(out))
        with Process("calibrate", "load", *arguments, *["--json"] * script) as calibrate:
            calibrate.hear("Take every load off", on_stderr=script)
            calibrate.tell("")
            calibrate.hear("  0 g:", on_stderr=script)
            # The mass was forgotten: the step is refused and asked for again.
            calibrate.hear("Put 100 g on", on_stderr=script)
            calibrate.tell("")
            calibrate.hear("Put 100 g on", on_stderr=script)
            board.carry_out("mass 100")
            calibrate.measure(100, on_stderr=script)
            calibrate.hear("Put 200 g on", on_stderr=script)
            board.carry_out("mass 200")
            calibrate.measure(200, on_stderr=script)
            status, said, refused = calibrate.end()
        board.tell("nonsense")
        assert "there is no fault 'nonsense'" in board.end()[2]
    assert status == 0
    assert "Refused: The reading did not change with 100 g" in "\n".join([*calibrate.said, refused])
    calibration = load_device_calibration(out, LoadCalibration)
    if script:
        result = json.loads(said)
        assert result["path"] == str(out)
        assert [level["mass_g"] for level in result["levels"]] == [0, 100, 200]
        assert result["calibration"] == calibration.model_dump(mode="json")
    else:
        assert f"Written to {out}." in said
    assert calibration.nm_per_count * COUNTS_PER_NM == pytest.approx(1.0, rel=2e-3)
    assert calibration.torque_nm(81_250) == pytest.approx(0.0, abs=2e-4)


@pytest.mark.parametrize(
    ("lines", "parts"),
    [
        ((b"0,091\r\n",), ("'0,091'", "decimal comma", "firmware/hx711_torque")),
        ((b"0.1234, " * 1024 + b"\n",), ("An EIT-kit sends such lines", "shearloop ports")),
        ((b"0.1",), ("'0.10.10.1", "without a line end")),
        ((b"",), ("HX711 has power",)),
    ],
)
async def test_the_load_cells_calibration_gives_up_with_what_came(tmp_path, monkeypatch, lines, parts):
    monkeypatch.setattr(load, "GIVE_UP_S", 0.3)
    board = Hx711Board(cycle(lines), period_s=0.03, link=tmp_path / "load")
    async with running(board.run()):
        await board.port.appearances.get()
        with SerialPort(str(tmp_path / "load")) as port, pytest.raises(DeviceLostError) as gave_up:
            await load.measure(port, [100.0], Silent())
    assert "within 0.3 s" in str(gave_up.value)
    assert all(part in str(gave_up.value) for part in parts), gave_up.value


@pytest.mark.parametrize("way", ["socket", "modbus"])
def test_the_gripper_is_calibrated_on_objects_by_either_way(tmp_path, way):
    out, link = tmp_path / "gripper.yaml", tmp_path / "gripper"
    arguments = ("--port", "0", "--bind", HOST) if way == "socket" else ("--link", str(link))
    with Process("emulate", f"gripper-{way}", "--speed", "20", *arguments) as gripper:
        where = gripper.hear(f"{HOST}:" if way == "socket" else str(link))
        host, _, port = where.partition(":")
        reach = ("--host", host, "--socket-port", port) if way == "socket" else ("--port", where)
        diameters = ("--model", "2F-140", "--diameter-mm", "10", "--diameter-mm", "40")
        # One of the two ways as a script would: what is asked of the operator is then on stderr.
        script = way == "modbus"
        with Process("calibrate", "gripper", *reach, *diameters, "--out", str(out), *["--json"] * script) as calibrate:
            calibrate.hear("The fingers will open", on_stderr=script)
            calibrate.tell("")
            calibrate.hear("Hold the object of 10 mm", on_stderr=script)
            calibrate.tell("")
            if script:
                calibrate.hear("Refused: the fingers closed without meeting anything", on_stderr=True)
            calibrate.hear("Hold the object of 10 mm", on_stderr=script)
            for diameter in (10, 40):
                gripper.carry_out(f"object {diameter}")
                calibrate.tell("")
                calibrate.hear(f"  {diameter} mm:", on_stderr=script)
            status, said, refused = calibrate.end()
    assert status == 0
    if script:
        assert [gauge["diameter_mm"] for gauge in json.loads(said)["gauges"]] == [10, 40]
    else:
        assert "without meeting anything" in refused
    found = load_device_calibration(out, WidthCalibration)
    # Two positions, each rounded to a count: the true gripper goes from 3 to 230 counts over 140 mm.
    assert found.width_mm(3) == pytest.approx(140, abs=5)
    assert found.width_mm(230) == pytest.approx(0, abs=1)


@pytest.mark.long
def test_a_gripper_of_a_daemon_is_refused_and_what_it_may_hold_is_said_before_it_opens(tmp_path):
    write_memory(memory_path(HOST), Remembered(force_n=60.0, running="loosen"))
    with Process("emulate", "gripper-socket", "--port", "0", "--bind", HOST) as gripper:
        host, _, port = gripper.hear(f"{HOST}:").partition(":")
        reach = ("--host", host, "--socket-port", port, "--model", "2F-140")
        given = (*reach, "--diameter-mm", "10", "--diameter-mm", "40")
        calibration = ("calibrate", "gripper", *given, "--out", str(tmp_path / "gripper.yaml"))
        with lock_gripper(f"::ffff:{HOST}", int(port)), Process(*calibration) as calibrate:
            status, _, refused = calibrate.end()
        assert status != 0
        assert f"the gripper at {host}:{port} is driven by another program of this computer" in refused
        with Process(*calibration) as calibrate:
            assert "'loosen' was under way. Look at the rig" in calibrate.hear(
                "From the last program: the daemon ended"
            )
            calibrate.tell("")
            calibrate.hear("From the last program: a tool may be held, gripped with at most 60 N. Look at")
            calibrate.tell("")
            calibrate.hear("The fingers will open")
            calibrate.end()
    assert read_memory(memory_path(HOST)).running == "loosen", "the arm waits for its own acknowledgement"


def test_a_gripper_on_a_robot_that_another_program_commands_is_not_calibrated(tmp_path, mistake, monkeypatch):
    """It may be a daemon of another user or computer, which has no lock here, and hold a tool."""
    info = ControllerInfo("5.17.3.0", "1", "RUNNING", "NORMAL", remote=True, registers=LOWER)
    monkeypatch.setattr(robot_use, "query_controller", lambda *_: info)
    monkeypatch.setattr(robot_use, "read_outputs", lambda *_: SimpleNamespace(runtime_state=2))
    objects = ("--model", "2F-140", "--diameter-mm", "10", "--diameter-mm", "40")
    given = ("--host", "127.0.0.9", *objects, "--out", tmp_path / "gripper.yaml")
    said = mistake("calibrate", "gripper", *given)
    assert "those from 24 on are in use" in said
    assert "A program is on the robot that was not started from here (playing)" in said


COMMISSIONING = """
import sys
from shearloop.daemon.process import raise_ending_signals
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.tools.commission.fingers import ConnectedGripper, close_fingers

client = SocketClient(sys.argv[1], int(sys.argv[2]))
with raise_ending_signals(), ConnectedGripper(RobotiqGripper(client, WidthCalibration.nominal())) as gripper:
    gripper.activate(operator_confirmed=True)
    close_fingers(gripper)
"""


async def halted_mm(host: str, port: int, interrupt: Callable[[], None]) -> tuple[float, float]:
    """Interrupt while the fingers close; return their width at once after that, and many readings later."""
    gripper = RobotiqGripper(SocketClient(host, port), WidthCalibration.nominal(), poll_s=0.01)
    await gripper.connect()
    try:
        # An activation opens them first.
        while (await gripper.read()).width_mm < 135.0:
            continue
        while (await gripper.read()).width_mm > 125.0:
            continue
        await asyncio.to_thread(interrupt)
        first = await gripper.read()
        for _ in range(50):
            last = await gripper.read()
        return first.width_mm, last.width_mm
    finally:
        await gripper.close()


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM])
@pytest.mark.parametrize("program", ["calibrate", "commission"])
def test_fingers_that_close_are_halted_by_the_end_of_the_program(program, number, tmp_path):
    """They would go on by themselves, onto a hand that reaches for what stopped."""
    with Process("emulate", "gripper-socket", "--port", "0", "--bind", HOST, "--speed", "3") as emulated:
        host, _, port = emulated.hear(f"{HOST}:").partition(":")
        diameters = ("--diameter-mm", "10", "--diameter-mm", "40")
        given = ("--model", "2F-140", *diameters, "--out", str(tmp_path / "gripper.yaml"))
        command = [*SHEARLOOP, "calibrate", "gripper", "--host", host, "--socket-port", port, *given]
        if program == "commission":
            command = [sys.executable, "-c", COMMISSIONING, host, port]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:

            def interrupt() -> None:
                child.send_signal(number)
                child.communicate(timeout=30)

            if program == "calibrate":
                # The fingers may open and close; then they close onto the object.
                child.stdin.write(b"\n\n")
                child.stdin.flush()
            first_mm, last_mm = asyncio.run(halted_mm(host, int(port), interrupt))
    assert child.returncode != 0
    assert last_mm == first_mm > 20.0


@pytest.mark.long
def test_a_gripper_of_another_model_is_measured_where_its_counts_begin_and_bow(tmp_path):
    diameters, out = (8, 25, 45, 75), tmp_path / "gripper.yaml"
    emulated = ("--model", "2F-85", "--open-counts", "13", "--bow-mm", "2.5", "--port", "0", "--speed", "20")
    with Process("emulate", "gripper-socket", "--bind", HOST, *emulated) as gripper:
        host, _, port = gripper.hear(f"{HOST}:").partition(":")
        given = [word for diameter in diameters for word in ("--diameter-mm", str(diameter))]
        reach = ("--host", host, "--socket-port", port, "--model", "2F-85")
        with Process("calibrate", "gripper", *reach, *given, "--out", str(out)) as calibrate:
            calibrate.hear("The fingers will open")
            calibrate.tell("")
            for diameter in diameters:
                calibrate.hear(f"Hold the object of {diameter} mm")
                gripper.carry_out(f"object {diameter}")
                calibrate.tell("")
                calibrate.hear(f"  {diameter} mm:")
            status, _, _ = calibrate.end()
    found = load_device_calibration(out, WidthCalibration)
    assert (status, found.model) == (0, "2F-85")
    assert found.open_counts == pytest.approx(13, abs=3)
    assert found.bow_mm == pytest.approx(2.5, abs=0.5)
    assert found.width_std_mm < 0.6


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("load --port /dev/none --mass-g 100 --out load.yaml", "no serial port /dev/none"),
        ("load --port /dev/none --mass-g -1 --out load.yaml", "mass in grams"),
        ("load --port /dev/none --mass-g 1 --out no/load.yaml", "there is no folder no"),
        ("load --port /dev/none --mass-g 1 --lever-arm-mm 0 --out l.yaml", "--lever-arm-mm 0"),
        (
            "load --port /dev/none --mass-g 1 --lever-arm-mm 0.035 --out l.yaml",
            "0.035 is not a number from 1 to 1000 mm",
        ),
        (
            "gripper --model 2F-140 --port /dev/none --diameter-mm 0.02 --out g.yaml",
            "0.02 is not a number from 1 to 140 mm",
        ),
        ("gripper --model 2F-140 --port /dev/none --diameter-mm 20 --out g.yaml", "two different"),
        ("gripper --model 2F-140 --port /dev/none --diameter-mm 2 --diameter-mm 4 --out g.yaml", "/dev/none"),
    ],
)
def test_a_mistake_ends_in_one_sentence(arguments, said, tmp_path, mistake, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = mistake("calibrate", *arguments.split())
    assert said in message
    assert message.count("\n") == 1


def test_the_end_of_the_input_ends_the_calibration_with_a_sentence(tmp_path):
    link = tmp_path / "load"
    with Process("emulate", "hx711", "--link", str(link), "--speed", "20") as board:
        board.hear(str(link))
        arguments = f"calibrate load --port {link} --mass-g 100 --out {tmp_path / 'l.yaml'}".split()
        # From a file, which no event loop can wait for.
        answers = tmp_path / "answers"
        answers.write_text("\n")
        with answers.open() as stdin:
            done = subprocess.run(
                [*SHEARLOOP, *arguments], stdin=stdin, capture_output=True, text=True, timeout=30, check=False
            )
    assert done.returncode == 2
    assert "the input ended before all was measured" in done.stderr
    assert not (tmp_path / "l.yaml").exists()


def test_a_gripper_socket_fails_on_request():
    with Process("emulate", "gripper-socket", "--port", "0", "--bind", HOST, "--speed", "10") as gripper:
        host, _, port = gripper.hear(f"{HOST}:").partition(":")
        with socket.create_connection((host, int(port)), timeout=10) as client:
            client.sendall(b"GET FLT\n")
            assert client.recv(64) == b"FLT 00\n"
            gripper.tell("fault 14")
            gripper.tell("what")
            gripper.tell("unplug 0.01")
            # The connection breaks, and the address is listened on again.
            with contextlib.suppress(ConnectionResetError):
                while client.recv(64):
                    pass
        assert gripper.hear(f"{HOST}:") == f"{host}:{port}"
        with socket.create_connection((host, int(port)), timeout=10) as client:
            client.sendall(b"GET FLT\n")
            assert client.recv(64) == b"FLT 14\n"
        assert "'what' is no command" in gripper.end()[2]


def test_what_hands_have_measured_is_shown_where_the_disk_is_full(tmp_path, monkeypatch, mistake):
    levels = [Level(0.0, 8000.0, 1.0, 50), Level(100.0, 58000.0, 1.0, 50)]

    async def measured(*_: object) -> list[Level]:
        return levels

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(load, "measure", measured)
    monkeypatch.setattr("shearloop.drivers.connection.find_port", lambda **_: "port")
    monkeypatch.setattr("shearloop.drivers.connection.SerialPort", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr("os.fsync", full)
    out = tmp_path / "load.yaml"
    said = mistake("calibrate", "load", "--port", "/dev/none", "--mass-g", "100", "--out", out)
    cause, shown = said.split(" yourself:\n")
    assert f"{out}: the calibration cannot be written: No space left on device; choose another path" in cause
    assert LoadCalibration(**yaml.safe_load(shown)) == fit_levels(levels, 0.035).calibration
