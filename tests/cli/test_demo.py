"""The demo before it builds anything, and what ends with it."""

import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from shearloop.cli import demo
from shearloop.daemon.config import DaemonConfig
from shearloop.errors import UserError

CONFIG = DaemonConfig(load_cell={"device": {"path": "load"}})


def test_a_taken_port_is_named_before_anything_is_built(monkeypatch):
    monkeypatch.setattr(demo, "refuse_second_daemon", lambda *_: None)
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        config = CONFIG.model_copy(update={"publish": f"tcp://127.0.0.1:{port}", "commands": "ipc:///tmp/nobody"})
        with pytest.raises(UserError, match=f"127.0.0.1:{port} is taken by another program"):
            demo.check_ports(config, None)
    demo.check_ports(config, None)


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
