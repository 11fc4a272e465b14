"""The paper's two sweeps on the emulated rig, many times faster than real time, and the data set that they yield.

    python -m benchmarks.sweeps --bank run/demo.bank --out DIR [--speed 30]

The experiments are the shipped ones with their times divided by the speed; rig, drivers and daemon are the real ones.
Gel, fingers and boards are played that many times as fast, controller and loop stay in real time, so that what the
loop's own delay costs is paid in full: judged is the whole sweep's duration against the one that its steps plan.
DIR/torque_slices and DIR/diameter_slices are what `shearloop reproduce DIR` takes. Writes DIR/sweeps.json too.
"""

import argparse
import asyncio
import json
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq.asyncio

from benchmarks.rig_configuration import write_configuration
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.step_runner import expected_s
from shearloop.daemon.recording.matlab_slices import SliceRecorder
from shearloop.drivers.eit_format import FRAME_PERIOD_S

EXPERIMENTS = Path("config/experiments")
DIAMETERS_MM = (10, 20, 30, 40)
# What is asked of the arm, which is played ARM_SPEED times as fast: up to ur-rtde's own bounds, and no faster in all
# than a late command may be on a busy computer (3 rad/s).
ARM_SPEED = 3.0
SPEED_RAD_PER_S, ACCELERATION_RAD_PER_S2 = 1.0, 39.0
BANDWIDTH_PER_S = 22.0
# How late a message may be on a busy computer, in real time, before a sensor counts as silent.
FRESHNESS_S = 1.0
READY_S, DEADLINE_S = 60.0, 1200.0


def faster(path: Path, speed: float) -> dict[str, Any]:
    """Return a shipped experiment with every time in it divided by the speed."""
    content: dict[str, Any] = yaml.safe_load(path.read_text())
    for step in content["steps"]:
        for key in ("hold_s", "wait_s"):
            if key in step:
                step[key] /= speed
        if step["do"] == "twist":
            step["speed_rad_per_s"] = SPEED_RAD_PER_S
    return content


def planned_s(path: Path) -> float:
    """Return how long an experiment takes at its own pace, going by its steps alone."""
    return sum(expected_s(step) for step in load_yaml_model(path, ExperimentFile).steps)


def configuration(args: argparse.Namespace, folder: Path) -> Path:
    """Write the configuration of a rig that is `speed` times as fast, and return its path."""
    limits: dict[str, Any] = yaml.safe_load(Path("config/ur.yaml").read_text())["limits"]
    limits["wrist_speed_rad_per_s"] = {"inner": SPEED_RAD_PER_S, "hard": 1.5 * SPEED_RAD_PER_S}
    limits["wrist_acceleration_rad_per_s2"] = {"inner": ACCELERATION_RAD_PER_S2, "hard": 40.0}
    return write_configuration(
        folder,
        args.bank,
        # What is calibrated on a sweep cannot need its calibration: the load cell drives, and limits.
        None,
        args.host,
        robot={"rate_hz": args.rate_hz, "limits": limits},
        fingertip={"frame_period_s": FRAME_PERIOD_S / args.speed},
        load_cell={"rate_hz": 10.9 * args.speed},
        loop={
            "freshness_s": FRESHNESS_S,
            "angle_bandwidth_per_s": args.bandwidth_per_s,
            "wrist_speed_rad_per_s": SPEED_RAD_PER_S,
            "wrist_acceleration_rad_per_s2": ACCELERATION_RAD_PER_S2,
        },
    )


class Ends:
    """Hears of the beginning and the end of every experiment."""

    def __init__(self) -> None:
        self.last: Mapping[str, Any] = {"phase": "idle"}
        self.held = 0
        self.changes_ns: list[int] = []
        self._ended = asyncio.Event()

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take one message in."""
        if topic == "loop.state":
            self.held += content["phase"] == "held" != self.last["phase"]
            if content["hold"] != self.last.get("hold", 0):
                self.changes_ns.append(content["t_mono_ns"])
            self.last = content
            if content["phase"] in ("done", "stopped"):
                self._ended.set()

    async def wait(self) -> None:
        """Wait for the end of the experiment that was begun last."""
        self._ended.clear()
        await self._ended.wait()


@asynccontextmanager
async def rig(args: argparse.Namespace, folder: Path) -> AsyncIterator[asyncio.StreamWriter]:
    """Play the rig; yields where its commands go."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "shearloop", "emulate", "rig", "--bank", str(args.bank), "--run-dir", str(folder)),
        *("--host", args.host, "--paper-sketch", "--speed", str(args.speed)),
        *("--arm-speed", str(ARM_SPEED)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    if process.stdin is None or process.stdout is None:
        raise RuntimeError("the rig was started without pipes")
    try:
        line = await process.stdout.readline()
        if not line.startswith(b"rig ready"):
            raise RuntimeError(f"the rig did not start: {line!r}")
        yield process.stdin
    finally:
        process.terminate()
        await process.communicate()


async def sweep(daemon: Daemon, ends: Ends, path: Path) -> float:
    """Carry one experiment out, and return how long it took; raises RuntimeError where it did not come to its end."""
    started = asyncio.create_task(ends.wait())
    began_s = time.monotonic()
    while why := await daemon.start_experiment(path):
        if time.monotonic() > began_s + READY_S:
            raise RuntimeError(f"the rig does not become ready: {why}")
        await asyncio.sleep(0.1)
    began_s = time.monotonic()
    async with asyncio.timeout(DEADLINE_S):
        await started
    if ends.last["phase"] != "done":
        raise RuntimeError(f"the sweep was stopped: {ends.last['doing']}")
    return time.monotonic() - began_s


async def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run both sweeps, and return what they took."""
    slices, ends = SliceRecorder(args.out), Ends()
    runs = {"torque sweep": ("torque_sweep.yaml", (20,)), "diameter sweep": ("diameter_sweep.yaml", DIAMETERS_MM)}
    found: dict[str, Any] = {}
    async with rig(args, folder) as commands:
        with zmq.asyncio.Context() as context:
            daemon = Daemon(load_daemon_config(configuration(args, folder)), context)
            daemon.publisher.listen(slices)
            daemon.publisher.listen(ends)
            task = asyncio.create_task(daemon.run())
            try:
                for name, (file, diameters) in runs.items():
                    path = folder / file
                    path.write_text(yaml.safe_dump(faster(EXPERIMENTS / file, args.speed)))
                    took = []
                    for diameter in diameters:
                        commands.write(f"object {diameter}\n".encode())
                        await commands.drain()
                        took.append(await sweep(daemon, ends, path))
                    real_s = planned_s(EXPERIMENTS / file) * len(diameters)
                    found[name] = {
                        "took_s": sum(took),
                        "at_its_own_pace_s": real_s,
                        "times_real_time": real_s / sum(took),
                    }
            finally:
                daemon.stop()
                await task
                slices.close()
    found["slices"] = dict(slices.written)
    found["missed"] = dict(slices.missed)
    found["held"] = ends.held
    spans = np.diff(ends.changes_ns) / 1e9
    found["hold_s_median"], found["turn_back_and_forth_s_median"] = (
        float(np.median(spans[::2])),
        float(np.median(spans[1::2])),
    )
    return found


def main() -> None:
    """Run the sweeps and print how fast they were."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--speed", type=float, default=30.0)
    parser.add_argument("--rate-hz", type=float, default=125.0, help="of the robot's loop")
    parser.add_argument("--bandwidth-per-s", type=float, default=BANDWIDTH_PER_S, help="of the angle loop")
    parser.add_argument("--host", default="127.0.0.61")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = asyncio.run(measure(args, Path(folder)))
    (args.out / "sweeps.json").write_text(json.dumps({"speed": args.speed, **found}, indent=2))
    for name in ("torque sweep", "diameter sweep"):
        figures = found[name]
        print(
            f"{name}: {figures['took_s']:.1f} s for what takes {figures['at_its_own_pace_s']:.0f} s at its own pace, "
            f"{figures['times_real_time']:.1f} times real time"
        )
    print(f"slices {found['slices']}, missed {found['missed']}, held {found['held']} times; now `shearloop reproduce`")


if __name__ == "__main__":
    main()
