"""The demo before it builds anything, and what ends with it."""

import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from shearloop.cli import demo, init
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.drivers.ur.settings import read_settings
from shearloop.errors import UserError

CONFIG = DaemonConfig(load_cell={"device": {"path": "load"}})


def test_a_taken_port_is_named_before_anything_is_built(monkeypatch):
    monkeypatch.setattr(demo, "refuse_second_daemon", lambda *_: None)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        config = CONFIG.model_copy(update={"publish": f"tcp://127.0.0.1:{port}", "commands": "ipc:///tmp/nobody"})
        with pytest.raises(UserError, match=f"127.0.0.1:{port} is taken by another program") as refused:
            demo.check_ports(config, Path("my rig/config/demo.yaml"))
    prepare = "shearloop demo --prepare --folder 'my rig'"
    assert f"in my rig/config/demo.yaml, which `{prepare}` writes; --port" in str(refused.value)
    demo.check_ports(config, Path("my/config/demo.yaml"))


@pytest.mark.usefixtures("ur_rtde")
def test_a_demo_beside_one_that_has_just_started_is_refused_before_it_builds_anything(tmp_path, monkeypatch, mistake):
    """No daemon of the first one answers yet, and its ports are still free."""
    path = tmp_path / "config" / "demo.yaml"
    init.write_files(path.parent, init.packaged_files())
    address = f"ipc://{tmp_path}/commands"
    text = path.read_text().replace("tcp://127.0.0.1:7761", f"ipc://{tmp_path}/publish")
    path.write_text(text.replace("tcp://127.0.0.1:7762", address))
    monkeypatch.setattr(demo, "running", lambda *_: pytest.fail("it builds"))
    with demo.only_demo(load_daemon_config(path)):
        said = mistake("demo", "--folder", tmp_path, "--port", "0")
    assert f"a demo has just started at {address}" in said
    # Its end gives them back.
    with demo.only_demo(load_daemon_config(path)):
        pass


@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.usefixtures("ur_rtde")
def test_a_demo_beside_another_emulated_robot_plays_its_own_elsewhere(taken, monkeypatch, capsys):
    """`run --emulate` does so too."""
    other = "127.0.0.1"
    monkeypatch.setattr("shearloop.cli.free_ports.is_free", lambda host, _port: not (taken and host == other))
    path = Path("config/demo.yaml")
    with demo.elsewhere(load_daemon_config(path)) as options:
        values = dict(value.split("=", 1) for value in options[1::2])
        moved = load_daemon_config(path, values)
        hosts = {read_settings(moved.robot).host, moved.gripper.socket.host}
    assert hosts == {"127.0.0.2" if taken else other}
    assert bool(options) is taken
    assert not taken or moved.emulators[0].arguments[-2:] == ("--host", "127.0.0.2")
    assert ("this one is played at 127.0.0.2" in capsys.readouterr().out) is taken


def test_what_a_command_runs_ends_with_it_also_after_kill():
    program = (
        "import time\nfrom shearloop.cli.emulator_processes import running\n"
        "with running(['sleep', '600']):\n    print('runs', flush=True)\n    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        assert parent.stdout.readline() == b"runs\n"
        [child] = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
        handle = os.pidfd_open(int(child))
        try:
            parent.send_signal(signal.SIGKILL)
            ended, _, _ = select.select([handle], [], [], 10)
        finally:
            os.close(handle)
    assert ended
