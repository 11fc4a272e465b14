"""A copy of the tree in which the tests here run the README's commands.

Its `.venv` is the one that runs the tests. The demo is faster here: boards, fingers and gel run several times as
fast, the bank is coarser and the holds are shorter. Addresses are its own.
"""

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.bank.build import build_bank
from shearloop.emulators.emulated_rig import SIDES
from shearloop.studies.emulated_calibration import SEED, calibrate, record
from shearloop.tools.bank_config import load_bank_plan
from tests.emulator_process import own_address
from tests.fixtures.daemons import DEADLINE_S

REPOSITORY = Path(__file__).parents[3]
PROGRAM = ".venv/bin/shearloop"
SPEED = 6
# Of the held torque, in seconds; the README's demo holds for half a minute.
HOLD_S = 2
# At each angle of `identify`, for frames of the rated pace.
IDENTIFY_HOLD_S = 2.5
# As in tests/emulator_process.py: two runs of the tests at once need two addresses.
HOST = own_address(0)
# The emulated controller works at half its rate, and its steps of power take less than a real one's.
PACE = ("--rate-hz", "250", "--unlock-wait-s", "0.2", "--power-on-s", "0.1")


def readme_commands() -> list[str]:
    """Return the command lines of the README's section, in order."""
    readme = Path("README.md").read_text()
    section = readme.partition("## Record, replay, calibrate")[2].partition("\n## ")[0]
    found = re.findall(rf"^    ({re.escape(PROGRAM)} .*)$", section, re.MULTILINE)
    names = [command.split()[1] for command in found]
    assert names == ["run", "run", "recording", "calibrate", "evaluate"]
    return found


class Tree:
    """A fresh tree with `config` and `.venv`, as far as the README's commands need it."""

    def __init__(self, root: Path) -> None:
        self.root, self.log = root, root / "log"
        shutil.copytree(REPOSITORY / "config", root / "config")
        (root / ".venv").symlink_to(sys.prefix)
        own = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": str(root), "PYTHONPATH": str(REPOSITORY / "src")}
        self.environment = {**own, "OPENBLAS_NUM_THREADS": "1"}

    def change(self, name: str, change: Callable[[Any], None]) -> None:
        """Change a configuration file of the tree."""
        path = self.root / "config" / name
        content = yaml.safe_load(path.read_text())
        change(content)
        path.write_text(yaml.safe_dump(content))

    def shell(self, command: str) -> "subprocess.CompletedProcess[str]":
        """Run a command line as it is typed, to its end."""
        line = ["/bin/sh", "-c", command]
        done = subprocess.run(line, cwd=self.root, env=self.environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done

    @contextmanager
    def started(self, command: str) -> Iterator["subprocess.Popen[str]"]:
        """Run a command that goes on by itself; what still runs at the end is ended as by Ctrl-C."""
        streams: Any = {"stdout": subprocess.PIPE, "stderr": self.log.open("a")}
        with (
            streams["stderr"],
            subprocess.Popen(command.split(), cwd=self.root, env=self.environment, text=True, **streams) as process,
        ):
            try:
                yield process
            finally:
                process.send_signal(signal.SIGINT)
                process.communicate(timeout=DEADLINE_S)


@pytest.fixture
def tree(tmp_path) -> Iterator[Tree]:
    """A tree whose demo is quick, and at addresses of its own."""
    tree = Tree(tmp_path)

    def demo(content: Any) -> None:
        content["publish"], content["commands"] = f"ipc://{tmp_path}/publish", f"ipc://{tmp_path}/commands"
        for fingertip in content["fingertips"].values():
            fingertip["frame_period_s"] = 0.5412 / SPEED
        content["combined"]["creep"]["time_s"] /= SPEED
        content["load_cell"]["rate_hz"] = 10.9 * SPEED
        # Two and a half periods of such a load cell are less than a busy computer may be late.
        content["loop"]["stale_after_s"] = 0.5
        content["gripper"]["socket"]["host"] = HOST
        (rig,) = content["emulators"]
        rig["arguments"] += ["--host", HOST, "--speed", str(SPEED), *PACE]
        (kick,) = rig["events"]
        kick["held_for_s"] = HOLD_S / 2

    def experiment(content: Any) -> None:
        for step in content["steps"]:
            if step["do"] == "identify":
                step["hold_s"] = IDENTIFY_HOLD_S / SPEED
            if step["do"] == "hold_torque":
                step |= {"hold_s": HOLD_S, "ramp_nm_per_s": 0.1}

    tree.change("demo.yaml", demo)
    tree.change("demo_ur.yaml", lambda content: content.update(host=HOST))
    tree.change("experiments/hold_torque.yaml", experiment)
    tree.change("banks/demo.yaml", lambda content: [content[axis].update(count=32) for axis in ("k", "sigma")])
    yield tree
    # Shown where the test has failed.
    if tree.log.exists():
        print(tree.log.read_text())


@pytest.fixture
def prepared_tree(tree) -> Tree:
    """The tree with what the demo makes, of one cylinder where the demo records five."""
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    data = tree.root / "run"
    data.mkdir()
    build_bank(*load_bank_plan(tree.root / "config" / "banks" / "demo.yaml"), data / "demo.bank", jobs=1)
    recordings = list(record(data / "demo.bank", SEED, (20.0,)))
    for name, sides in {"rig": tuple(SIDES), **{f"rig-{side}": (side,) for side in SIDES}}.items():
        calibrate(recordings, sides).save(data / f"{name}.cal")
    return tree
