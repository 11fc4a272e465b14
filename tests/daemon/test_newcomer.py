"""Runs the README's commands in a copy of the tree: demo, recording, live view, replay, calibration, evaluation.

The copy has a `.venv` that runs this checkout. The demo is faster here: boards, fingers and gel run several times as
fast, the bank is coarser and the hold shorter. Addresses are its own. The second run only twists.
"""

import asyncio
import json
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.daemon.conftest import DEADLINE_S
from tests.emulator_process import own_address

REPOSITORY = Path(__file__).parents[2]
PROGRAM = ".venv/bin/shearloop"
SPEED = 6
# Of the held torque, in seconds; the README's demo holds for half a minute.
HOLD_S = 2
# As in tests/emulator_process.py: two runs of the tests at once need two addresses.
HOST = own_address(0)


def readme_commands() -> list[str]:
    """Return the commands of the README's section, in order, without the program."""
    readme = Path("README.md").read_text()
    section = readme.partition("## Record, replay, calibrate")[2].partition("\n## ")[0]
    found = re.findall(rf"^    {re.escape(PROGRAM)} (.*)$", section, re.MULTILINE)
    names = [command.split()[0] for command in found]
    assert names == ["run", "run", "replay", "calibrate", "evaluate"]
    return found


def readme_program() -> str:
    """Return the README's program."""
    block = re.search(r"^ {4}import shearloop\n(?:(?: {4}.*)?\n)*", Path("README.md").read_text(), re.MULTILINE)
    assert block
    return textwrap.dedent(block[0])


class Tree:
    """A fresh tree as `git clone` and an installation leave it, but for the copying of code and libraries."""

    def __init__(self, root: Path) -> None:
        self.root, self.log = root, root / "log"
        shutil.copytree(REPOSITORY / "config", root / "config")
        for name in ("Makefile", "pyproject.toml", "benchmarks", "src"):
            (root / name).symlink_to(REPOSITORY / name)
        binaries = root / ".venv" / "bin"
        binaries.mkdir(parents=True)
        for name, command in (("python", ""), ("shearloop", "-m shearloop")):
            (binaries / name).write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {command} "$@"\n')
            (binaries / name).chmod(0o755)
        (root / ".venv" / ".installed").touch()
        self.environment = {
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "HOME": str(root),
            "PYTHONPATH": f"{root}:{root}/src",
            "OPENBLAS_NUM_THREADS": "1",
        }

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
        with self.log.open("a") as errors:
            process = subprocess.Popen(
                shlex.split(command),
                cwd=self.root,
                env=self.environment,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        try:
            yield process
        finally:
            if process.poll() is None:
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
        # Two and a half periods of such a load cell are what a busy computer may be late.
        content["loop"]["stale_after_s"] = 0.3
        content["gripper"]["socket"]["host"] = HOST
        (rig,) = content["emulators"]
        rig["arguments"] += ["--host", HOST, "--speed", str(SPEED), "--unlock-wait-s", "0.2", "--power-on-s", "0.1"]
        (kick,) = rig["events"]
        kick["held_for_s"] = HOLD_S / 2

    def experiment(content: Any) -> None:
        for step in content["steps"]:
            if step["do"] == "hold_torque":
                step["hold_s"] = HOLD_S

    tree.change("demo.yaml", demo)
    tree.change("demo_ur.yaml", lambda content: content.update(host=HOST))
    tree.change("experiments/hold_torque.yaml", experiment)
    tree.change("banks/demo.yaml", lambda content: [content[axis].update(count=32) for axis in ("k", "sigma")])
    yield tree
    # Shown where the test has failed.
    if tree.log.exists():
        print(tree.log.read_text())


async def seen_on_the_page(address: str, topics: set[str]) -> dict[str, Any]:
    """Return the latest message of each topic, as the page is sent them, the estimate being a valid one."""
    import aiohttp

    latest: dict[str, Any] = {}
    async with asyncio.timeout(2 * DEADLINE_S), aiohttp.ClientSession() as http:
        async with http.get(address) as page:
            assert "<html" in await page.text()
        async with http.ws_connect(f"{address}stream") as stream:
            async for batch in stream:
                for message in batch.json()["messages"]:
                    if message["topic"] != "eit.estimate" or message["content"]["valid"]:
                        latest[message["topic"]] = message["content"]
                if topics <= set(latest):
                    break
    return latest


def only_twists(content: Any) -> None:
    """Let the wrist turn to a few angles in place of the demo's identification and hold."""
    twist = {"do": "twist", "angles_rad": [0.06, 0.12, 0.03], "speed_rad_per_s": 0.4, "hold_s": 0.5}
    steps = [step for step in content["steps"] if step["do"] != "identify"]
    content["steps"] = [twist if step["do"] == "hold_torque" else step for step in steps]


@pytest.mark.real_time
# The commands take a minute and a quarter of an idle computer, and have no other limit.
@pytest.mark.timeout(450)
def test_the_readmes_path_from_the_demo_to_a_calibration_of_ones_own(tree):
    pytest.importorskip("aiohttp", reason="the live view needs the extra `view`")
    pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
    run, run_again, replay, calibrate, evaluate = (f"{PROGRAM} {command}" for command in readme_commands())
    tree.shell(f"{PROGRAM} demo --folder . --prepare")
    view = f"{PROGRAM} view --connect ipc://{tree.root}/publish --commands ipc://{tree.root}/commands --port 0 --json"
    with tree.started(run) as demo, tree.started(view) as viewer:
        address = json.loads(viewer.stdout.readline())["url"]
        wanted = {"eit.estimate", "load.torque", "robot.state", "gripper.state", "loop.state", "health"}
        seen = asyncio.run(seen_on_the_page(address, wanted))
        assert demo.wait() == 0, tree.log.read_text()
    assert seen["loop.state"]["experiment"] == "hold 0.10 N·m"
    tree.change("experiments/hold_torque.yaml", only_twists)
    for ran in (tree.log.read_text(), tree.shell(run_again).stderr):
        assert "phase=done reason=" in ran, ran
    summary = tree.shell(f"{PROGRAM} recording info recordings/first/*.mcap").stdout
    assert re.search(r"ran +hold 0.10 N·m", summary)
    for topic in (
        "eit.estimate.combined",
        "eit.frame.left",
        "load.torque",
        "robot.state",
        "gripper.state",
        "loop.state",
    ):
        assert topic in summary
    comparison = tree.shell(f"{replay} --publish ipc://{tree.root}/replay").stderr
    same = re.findall(r"(\S+): (\d+) of (\d+) equal the recorded ones, bit for bit", comparison)
    assert [topic for topic, *_ in same] == ["eit.estimate", "eit.frame", "load.torque"]
    assert all(made == recorded and int(made) > 100 for _, made, recorded in same)
    assert "Estimator motion_regression, torque from" in tree.shell(calibrate).stdout
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
