"""The README's path from two recordings to a calibration of one's own; the demo only twists here."""

import re
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.cli.newcomer.conftest import PROGRAM, Tree, readme_commands

# On a busy computer the commands take several times as long.
pytestmark = pytest.mark.timeout(240)


def readme_program() -> str:
    """Return the README's program."""
    block = re.search(r"^ {4}import shearloop\n(?:(?: {4}.*)?\n)*", Path("README.md").read_text(), re.MULTILINE)
    assert block
    return textwrap.dedent(block[0])


def only_twists(content: Any) -> None:
    """Let the wrist turn to a few angles in place of the demo's identification and hold."""
    twist = {"do": "twist", "angles_rad": [0.1, 0.2, 0.05], "speed_rad_per_s": 0.4, "hold_s": 0.5}
    steps = [step for step in content["steps"] if step["do"] != "identify"]
    content["steps"] = [twist if step["do"] == "hold_torque" else step for step in steps]


@pytest.mark.real_time
def test_two_recordings_become_a_calibration_of_ones_own(prepared_tree):
    tree, (run, run_again, replay, calibrate, evaluate) = prepared_tree, readme_commands()
    tree.change("experiments/hold_torque.yaml", only_twists)
    recorded(tree, run)
    with ThreadPoolExecutor() as beside:
        # What is done with the first recording needs no second one before `evaluate`.
        second = beside.submit(recorded, tree, run_again)
        check_first_recording(tree, replay)
        assert "Estimator motion_regression, torque from" in tree.shell(calibrate).stdout
        second.result()
    lines = tree.shell(evaluate).stdout.splitlines()
    column = next(line.index(" all ") for line in lines if line.startswith("figure "))
    of_all = {line.split()[0]: line[column:].split()[0] for line in lines if line[column:].strip()}
    assert float(of_all["r"]) > 0.9
    assert float(of_all["rmse_nm"]) < 0.02
    assert float(of_all["valid_fraction"]) > 0.3
    assert (tree.root / "run" / "my.png").read_bytes().startswith(b"\x89PNG")
    (recording,) = (tree.root / "recordings/second").glob("*.mcap")
    example = readme_program().replace("fingertip.cal", "run/my.cal").replace("twists.mcap", str(recording))
    (tree.root / "example.py").write_text(example)
    torques = [line.split()[1] for line in tree.shell(".venv/bin/python example.py").stdout.splitlines()]
    assert len(torques) > 100
    assert any(torque != "None" for torque in torques)


def recorded(tree: Tree, run: str) -> None:
    """Run the README's command that records, to the end of its experiment."""
    logged = tree.shell(run).stderr
    assert "phase=done reason=" in logged, logged


def check_first_recording(tree: Tree, replay: str) -> None:
    """Hold the first recording to have every device, and to be replayed bit for bit."""
    summary = tree.shell(f"{PROGRAM} recording info recordings/first/*.mcap").stdout
    assert re.search(r"ran +hold 0.10 N·m", summary)
    of_devices = {"eit.estimate.combined", "eit.frame.left", "load.torque", "robot.state", "gripper.state"}
    assert {*of_devices, "loop.state"} <= set(summary.split())
    comparison = tree.shell(f"{replay} --publish ipc://{tree.root}/replay").stderr
    same = re.findall(r"(\S+): (\d+) of (\d+) equal the recorded ones, bit for bit", comparison)
    assert [topic for topic, *_ in same] == ["eit.estimate", "eit.frame", "load.torque"]
    assert all(made == recorded and int(made) > 100 for _, made, recorded in same)
