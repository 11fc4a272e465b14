"""A new user's way with a rig: described, rehearsed, commissioned on emulated devices, and limits raised by the report.

The procedure takes simulated time. `tests/cli/test_rehearsal.py` runs an experiment with raised limits in real time.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import yaml

from shearloop.cli.rehearsal import rehearsal, sentences_of_run
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.experiment_files import check_experiment
from shearloop.daemon.motion_cap import CAPPED_NM, CAPPED_RAD_PER_S
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.rig import open_settings
from shearloop.errors import UserError
from shearloop.tools.commission.operator import Operator
from shearloop.tools.commission.procedure import STAGES, commission
from tests.tools.commission.simulated_rig import SimulatedRig
from tests.tools.commission.test_procedure import COUNTS, failed, write_rig

pytestmark = pytest.mark.usefixtures("ur_rtde")

# Few of everything but stops: five of each layer raise a speed.
FEW = replace(
    COUNTS,
    listen_s=1.0,
    uploads_after_s=(0.0,),
    clock_s=1.0,
    rest_s=1.0,
    turns=1,
    stops=5,
    speeds_rad_per_s=(0.5,),
    exchanges=5,
    starts=1,
    frames=6,
    twists=2,
)
SPRING_NM_PER_RAD = 5.0
FAST = {
    "name": "fast",
    "torque_source": "wrench",
    "tool_mm": 20,
    "limits": {"torque_nm": 0.35, "angle_rad": 1.5},
    "steps": [
        {"do": "tare"},
        {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.4, "hold_s": 0.5, "timeout_s": 30},
    ],
}


@dataclass
class Person:
    """Answers each question by what is on the screen, and has nothing else to go by."""

    play: Callable[[str], None]
    said: list[str] = field(default_factory=list)

    @property
    def operator(self) -> Operator:
        return Operator(self.answer, self.said.append, self.play, allows=True)

    def answer(self, question: str) -> str:
        if question == "Your name:":
            return "Ada"
        if "as stiff as you type" in question:
            return str(SPRING_NM_PER_RAD)
        if named := re.search(r"Type `(\w+)`|for instance ([\d.]+)|the pendant shows (\w+)", question):
            return next(filter(None, named.groups()))
        turned = re.search(r"turned from (\S+) to (\S+) rad; with a growing angle it turns counterclockwise", question)
        assert turned, f"nothing on the screen answers: {question}"
        return "counterclockwise" if float(turned[2]) > float(turned[1]) else "clockwise"


@pytest.fixture
def described(tmp_path) -> Path:
    """A rig of real devices and an experiment, as a new user describes them."""
    # Real deadlines stop the wrist sooner, and a fingertip without estimates takes no time to match: both end the test
    # sooner.
    path = write_rig(tmp_path, "192.168.1.10", experiment="fast.yaml", emulated_deadlines="real")
    content = yaml.safe_load(path.read_text())
    content["load_cell"]["device"] = {"serial_number": "75834312"}
    content["fingertips"]["right"] |= {"device": {"serial_number": "85734323"}, "calibration": None}
    path.write_text(yaml.safe_dump(content))
    (tmp_path / "fast.yaml").write_text(yaml.safe_dump(FAST))
    return path


@pytest.fixture
def rehearsed(described) -> Iterator[Callable[[], DaemonConfig]]:
    """Return what plays the described rig, as its file is at that moment."""

    with ExitStack() as played:
        yield lambda: played.enter_context(rehearsal(load_daemon_config(described), described)).config


def refusal(config: DaemonConfig) -> str:
    """Return why a daemon with this configuration refuses its experiment, as it does when it starts."""
    try:
        check_experiment(config, {}, commissioning_of(config, open_settings(config)))
    except UserError as error:
        return str(error)
    return ""


# A person takes some time for a stop, and the wrist has reached its speed by then.
BY_HAND, HAND_S = ("robot emergency-stop", "robot stop", "robot silence 1.2"), 0.05


def commissioned_to(out: Path, config: DaemonConfig, path: Path) -> list[str]:
    """Commission simulated devices into a report; return the lines that failed."""
    rig = SimulatedRig(config, path.parent)

    def play(command: str) -> None:
        if command in BY_HAND:
            rig.clock.sleep(HAND_S)
        rig.order(command)

    person = Person(play)
    rig.order("object none")
    report, page = commission(config, path, out, person.operator, FEW, (), rig)
    assert [stage.stage for stage in report.stages] == list(STAGES)
    assert "EMULATED" in person.said[0]
    assert "EMULATED" in out.read_text()
    assert "EMULATED" in page.read_text()
    return failed(report)


def test_a_new_user_rehearses_commissions_and_raises_the_limits_of_the_rehearsal_alone(described, rehearsed):
    first = rehearsed()
    assert "speed_rad_per_s 0.4 rad/s: write 0.2 or less" in refusal(first)
    capped = next(sentences_of_run(first))
    assert "`shearloop commission CONFIG --out FILE --emulate`" in capped

    assert commissioned_to(described.with_name("emulated.yaml"), first, described) == []

    described.write_text(described.read_text() + "commissioned: emulated.yaml\n")
    second, real = rehearsed(), load_daemon_config(described)
    found = commissioning_of(second, open_settings(second))
    assert found.cap.wrist_speed_rad_per_s == 0.5
    assert found.cap.torque_nm > 0.35
    assert found.settings.limits.wrist_speed_rad_per_s.inner == 0.5
    assert "of emulated devices covers no more" in next(sentences_of_run(second))
    assert refusal(second) == ""

    of_real = commissioning_of(real, open_settings(real))
    assert (of_real.cap.wrist_speed_rad_per_s, of_real.cap.torque_nm) == (CAPPED_RAD_PER_S, CAPPED_NM)
    assert "emulated.yaml is of emulated devices, and raises nothing on real ones" in refusal(real)
