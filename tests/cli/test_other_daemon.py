"""A second daemon at the addresses of one that runs: it is named before anything is built, started or bound."""

from contextlib import closing
from pathlib import Path
from socket import AF_UNIX, SOCK_DGRAM, socket
from unittest.mock import Mock

import pytest

from shearloop.cli import demo, other_daemon
from shearloop.cli.held_address import held_from_daemons
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.messaging import stop_socket
from shearloop.daemon.messaging.addresses import stop_name
from shearloop.daemon.messaging.messages import encode
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.daemon.messaging.stop_socket import StopSocket
from shearloop.errors import UserError
from tests.fixtures.daemons import DEADLINE_S

RUNNING = {"process": 4711, "folder": "/home/ann/demo", "rig": "demo"}
NAMED = r"process 4711 \(demo\) in /home/ann/demo"


@pytest.fixture(autouse=True)
def no_emulator(monkeypatch):
    """Fail a test that starts an emulator."""
    monkeypatch.setattr("shearloop.cli.emulator_processes.subprocess.Popen", Mock(side_effect=AssertionError))


def answering(monkeypatch, reply):
    monkeypatch.setattr(other_daemon, "send_to_stop_socket", lambda *_: reply)


def test_the_address_in_a_command_can_be_copied(monkeypatch):
    answering(monkeypatch, {"ok": True, "tasks": {}, "daemon": RUNNING})
    with pytest.raises(UserError, match="`shearloop command stop --connect 'ipc:///tmp/my rig/commands'`"):
        other_daemon.refuse_second_daemon("ipc:///tmp/my rig/commands")


def test_a_second_demo_is_refused_by_name(monkeypatch):
    answering(monkeypatch, {"ok": True, "tasks": {}, "daemon": RUNNING})
    first = r"or may hold one, open the fingers first with `shearloop command release --connect"
    with pytest.raises(UserError, match=rf"{NAMED}.*`shearloop command stop --connect.*{first}"):
        demo.check_ports(DaemonConfig(load_cell={"device": {"path": "load"}}), Path("my/config/demo.yaml"))


def test_a_demo_that_is_refused_leaves_no_folder_behind(monkeypatch, tmp_path, mistake):
    answering(monkeypatch, {"ok": True, "tasks": {}, "daemon": RUNNING})
    assert "process 4711 (demo)" in mistake("demo", "--folder", tmp_path / "demo")
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize("emulators", [[], [{"device": "hx711", "arguments": ["--link", "load"]}]])
def test_a_second_run_is_refused_by_name(config, monkeypatch, mistake, emulators):
    answering(monkeypatch, {"ok": True, "tasks": {}, "daemon": RUNNING})
    said = mistake("run", str(config(emulators=emulators)))
    assert "process 4711 (demo) in /home/ann/demo; `shearloop command stop --connect" in said


def test_a_second_rehearsal_is_refused_before_it_says_what_it_plays(config, monkeypatch, mistake):
    answering(monkeypatch, {"ok": True, "tasks": {}, "daemon": RUNNING})
    # `mistake` allows no output.
    assert "process 4711 (demo)" in mistake("run", "--emulate", str(config()))


def test_a_daemon_that_does_not_answer_is_refused_before_emulators_start(config, tmp_path, monkeypatch, mistake):
    monkeypatch.setattr(other_daemon, "STATUS_S", 0.01)
    path = str(config(emulators=[{"device": "hx711", "arguments": ["--link", "load"]}]))
    with closing(StopSocket(f"ipc://{tmp_path}/commands", {}, Refusals())):
        assert "is another daemon running? Stop it, or choose another port" in mistake("run", path)


def test_no_daemon_and_no_second_command_begins_while_a_command_holds_the_address(config, mistake, ran, tmp_path):
    """By any user, at any time: it binds the name of the daemons' stop socket."""
    commands, holder = f"ipc://{tmp_path}/held", "`shearloop commission` (process 7) has the robot: wait for its end"
    path = str(config(commands=commands))
    with held_from_daemons(commands, holder):
        assert holder in mistake("run", path)
        assert holder in ran("command", "stop", "--connect", commands, status=1).err
        with pytest.raises(UserError, match="cannot be bound"):
            StopSocket(commands, {}, Refusals())
        with pytest.raises(UserError, match="process 7"), held_from_daemons(commands, "another"):
            pass
    StopSocket(commands, {}, Refusals()).close()


def test_a_held_address_answers_after_an_empty_datagram_and_beside_a_client_that_does_not_read(tmp_path):
    commands = f"ipc://{tmp_path}/held"
    waiting = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text())
    with held_from_daemons(commands, "process 7 has the robot"), socket(AF_UNIX, SOCK_DGRAM) as client:
        client.settimeout(DEADLINE_S)
        # Without a name, as `socat` sends it.
        client.sendto(b"", stop_name(commands))
        client.bind("")
        for _ in range(waiting + 2):
            client.sendto(encode({"command": "stop"}), stop_name(commands))
        reply = send_to_stop_socket(commands, {"command": "status"}, DEADLINE_S)
        assert (reply["ok"], reply["reason"]) == (False, "process 7 has the robot")


def test_an_address_that_cannot_be_bound_is_not_called_another_programs(monkeypatch, tmp_path):
    monkeypatch.setattr(stop_socket, "stop_name", lambda _: f"{tmp_path}/absent/stop")
    with pytest.raises(UserError) as refused, held_from_daemons("tcp://127.0.0.1:5999", "process 7 has the robot"):
        pass
    assert "cannot be bound (No such file or directory)" in str(refused.value)
    assert "daemon" not in str(refused.value)


def test_a_held_address_answers_for_itself_alone():
    """Another address may have the same port, and its daemon is another one."""
    with held_from_daemons("tcp://127.0.0.1:5999", "process 7 has the robot"):
        assert send_to_stop_socket("tcp://127.0.0.2:5999", {"command": "status"}, DEADLINE_S) is None
