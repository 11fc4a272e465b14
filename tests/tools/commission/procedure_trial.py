"""The whole procedure on the emulated rig, in real time and over real ports, with scripted answers.

`test_procedure.py` has it in simulated time, with each seeded fault. This trial takes two minutes, so that `make test`
does not select it: `.venv/bin/pytest tests/tools/commission/procedure_trial.py`.
"""

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from shearloop.daemon.config import load_daemon_config
from shearloop.drivers.ur.dashboard import ask_dashboard
from shearloop.tools.commission.procedure import STAGES, commission
from tests.emulator_process import own_address
from tests.running import DEADLINE_S
from tests.tools.commission.scripted_operator import ScriptedOperator
from tests.tools.commission.simulated_rig import SPEED
from tests.tools.commission.test_procedure import COUNTS, failed, write_rig

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("ur_rtde"), pytest.mark.timeout(600)]


class EmulatedLab:
    """The emulated rig in a process of its own, and its operator."""

    def __init__(self, folder: Path) -> None:
        self.host = own_address(6)
        self.config = write_rig(folder, self.host, emulated=True)
        options = ["--paper-sketch", "--unlock-wait-s", "0.5", "--power-on-s", "0.2", "--rate-hz", "250"]
        self.process = subprocess.Popen(
            [
                *(
                    sys.executable,
                    "-m",
                    "shearloop",
                    "emulate",
                    "rig",
                    "--fingertip",
                    "right",
                    str(folder / "rig.bank"),
                ),
                *("--run-dir", str(folder), "--host", self.host, "--speed", str(SPEED), *options),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self.process.stdout.readline().startswith(b"rig ready")
        self._obeyed: list[str] = []
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.operator = ScriptedOperator(self.order, lambda: ask_dashboard(self.host, DEADLINE_S, ("stop",)))

    def order(self, command: str) -> None:
        """Send the rig a command, and wait until it was carried out."""
        with self._changed:
            self._obeyed.clear()
            self.process.stdin.write(f"{command}\n".encode())
            self.process.stdin.flush()
            assert self._changed.wait_for(lambda: command in self._obeyed, DEADLINE_S)

    def run(self, only: str = ""):
        config, out = load_daemon_config(self.config), self.config.with_name("report.yaml")
        return commission(config, self.config, out, self.operator.operator, COUNTS, only)

    def _read(self) -> None:
        for line in self.process.stdout:
            event = json.loads(line) if line.startswith(b"{") else {}
            if event.get("event") == "obeyed":
                with self._changed:
                    self._obeyed.append(event["detail"])
                    self._changed.notify_all()

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(10)
        self._reader.join()
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def lab(tmp_path) -> Iterator[EmulatedLab]:
    lab = EmulatedLab(tmp_path)
    try:
        yield lab
    finally:
        lab.close()


def test_the_whole_procedure_runs_unattended_on_an_emulated_rig(lab):
    report, page = lab.run()
    assert failed(report) == []
    assert [stage.stage for stage in report.stages] == list(STAGES)
    assert report.rig.emulated
    assert "EMULATED" in page.read_text()
    assert "EMULATED" in lab.operator.said[0]
