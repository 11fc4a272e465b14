"""The whole procedure on the emulated rig with scripted answers, and each seeded fault on its own line.

Its limits are a real rig's, so that it needs a quiet computer; `make test` does not select it. Run it alone:
`.venv/bin/pytest tests/tools/commission/procedure_trial.py`.
"""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from benchmarks.stop_times import write_random_bank
from shearloop.daemon.commissioning import commissioning_of
from shearloop.daemon.config import load_daemon_config
from shearloop.drivers.ur.control_box import ask_dashboard
from shearloop.tools.commission.context import Counts
from shearloop.tools.commission.operator import DeclinedError, Operator
from shearloop.tools.commission.procedure import STAGES, commission, real_settings
from tests.emulator_process import own_address
from tests.running import DEADLINE_S

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("ur_rtde")]

SPEED = 5
COUNTS = Counts(
    listen_s=3.0,
    uploads_after_s=(0.0, 1.0),
    clock_s=2.0,
    rest_s=2.0,
    turns=4,
    stops=1,
    speeds_rad_per_s=(0.2,),
    exchanges=20,
    starts=2,
    frames=8,
    twists=4,
)
GAUGES_MM, OBJECTS_MM = (10, 30, 50, 70, 90), (8, 60, 25, 40)
# Of the emulated gel and lever in series.
SPRING_NM_PER_RAD = 1.0 / (1.0 / 0.8 + 1.0 / 20.0)


class EmulatedLab:
    """The emulated rig and its operator: each question has its action and its answer."""

    def __init__(self, folder: Path) -> None:
        write_random_bank(folder / "rig.bank")
        self.host = own_address(6)
        options = ["--paper-sketch", "--unlock-wait-s", "0.5", "--power-on-s", "0.2", "--rate-hz", "250"]
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-m", "shearloop", "emulate", "rig", "--bank", str(folder / "rig.bank")),
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
        robot = yaml.safe_load(Path("config/demo_ur.yaml").read_text())
        (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": self.host}))
        self.config = folder / "rig.yaml"
        content = {
            "load_cell": {"device": {"path": "load-cell"}, "rate_hz": 10.9 * SPEED},
            "fingertips": {
                "right": {"device": {"path": "eit-right"}, "bank": "rig.bank", "frame_period_s": 0.5412 / SPEED}
            },
            "robot": "ur.yaml",
            "gripper": {"socket": {"host": self.host}},
        }
        self.config.write_text(yaml.safe_dump(content))
        self.said: list[str] = []
        self.declined = ""
        # By a part of the question.
        self._answers: dict[str, Callable[[str], str]] = {
            "Your name": lambda _: "Ada",
            "checksum": lambda _: "A1B2",
            "Hold gauge": lambda question: self._hold(GAUGES_MM[_number(question)]),
            "Hold object": lambda question: self._hold(OBJECTS_MM[_number(question)], "done"),
            "everything out": lambda _: self._do("object none"),
            "pendant to 50%": lambda _: self._do("slider 0.5"),
            "slider back": lambda _: self._do("slider 1"),
            "Now press the emergency": lambda _: self._do("emergency-stop"),
            "release the emergency": lambda _: self._do("release"),
            "Now press the stop of the program": lambda _: self._stop_program(),
            "Now pull": lambda _: self._do("silence robot 1.2"),
            "mass in kg": lambda _: self._do("hang 1", "1"),
            "Take the mass": lambda _: self._do("hang 0"),
            "known torque and let": lambda _: self._do("weigh 0.1", "0.1"),
            "Take the known torque": lambda _: self._do("weigh 0"),
            "known stiffness": lambda _: self._hold(20, str(SPRING_NM_PER_RAD)),
            "Which way": lambda _: "counterclockwise",
        }

    @property
    def operator(self) -> Operator:
        return Operator(self._answer, self.said.append)

    def _answer(self, question: str) -> str:
        if self.declined and self.declined in question:
            return "no"
        for part, answer in self._answers.items():
            if part in question:
                return answer(question)
        return "move" if "MOTION" in question else "done"

    def order(self, command: str) -> None:
        """Send the rig a command, and wait until it was carried out."""
        with self._changed:
            self._obeyed.clear()
            self.process.stdin.write(f"{command}\n".encode())
            self.process.stdin.flush()
            assert self._changed.wait_for(lambda: command in self._obeyed, DEADLINE_S)

    def _do(self, command: str, answer: str = "done") -> str:
        self.order(command)
        return answer

    def _hold(self, width_mm: float, answer: str = "") -> str:
        self.order(f"object {width_mm}")
        return answer or str(width_mm)

    def _stop_program(self) -> str:
        ask_dashboard(self.host, 5.0, ("stop",))
        return "done"

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


def _number(question: str) -> int:
    """Return the index in `gauge 2 of 5`."""
    return int(question.split(" of ", maxsplit=1)[0].rsplit(maxsplit=1)[-1]) - 1


@pytest.fixture
def lab(tmp_path) -> Iterator[EmulatedLab]:
    lab = EmulatedLab(tmp_path)
    try:
        yield lab
    finally:
        lab.close()


def run(lab: EmulatedLab, only: str = ""):
    config = load_daemon_config(lab.config)
    out = lab.config.with_name("report.yaml")
    return commission(config, lab.config, out, lab.operator, COUNTS, only)


def failed(report) -> list[str]:
    return [line.what for stage in report.stages for line in stage.lines if line.verdict == "failed"]


def test_the_whole_procedure_runs_unattended_and_its_report_supplies_what_it_measured(lab):
    lab.declined = "wrist 3 turns 4 times"
    with pytest.raises(DeclinedError, match="is kept"):
        run(lab)
    lab.declined = ""
    report, page = run(lab)
    assert failed(report) == []
    assert [stage.stage for stage in report.stages] == list(STAGES)
    assert sum("Listening" in line for line in lab.said) == 1, "a stage that passed is not run again"
    assert "Ada" in page.read_text()
    content = yaml.safe_load(lab.config.read_text())
    lab.config.write_text(yaml.safe_dump({**content, "commissioned": "report.yaml"}))
    config = load_daemon_config(lab.config)
    found = commissioning_of(config, real_settings(config))
    assert found.counts
    assert len(found.supplied.widths) == len(GAUGES_MM)
    assert 0 < found.supplied.actuation_s <= found.settings.reaction_s
    assert found.cap.wrist_speed_rad_per_s == 0.2, "one stop of each layer raises no speed"


FAULTS = [
    ("protect-ends", "4", "safety mode after stops at 0.2 rad/s"),
    ("slow-braking 0.5", "4", "time to rest at 0.2 rad/s"),
    ("velocity-noise 0.003", "3", "velocity noise at rest"),
    ("bias 8", "5", "force at rest"),
    ("float-clock", "1", "script's clock"),
    ("gripper slow 32", "2", "exchange with the gripper, p99"),
    ("block-scripts", "1", "uploads after 0, 1 s"),
    ("slider 0.5", "0", "speed slider"),
    ("registers-in-use", "0", "registers"),
    ("right zero-channel", "6", "dead channels of right"),
    ("flip load", "7", "sign of the load cell"),
]


@pytest.mark.parametrize(("fault", "stage", "line"), FAULTS)
def test_each_seeded_fault_turns_its_own_line_red(lab, fault, stage, line):
    lab.order(fault)
    report, _ = run(lab, stage)
    assert failed(report) == [line]
