"""How lean the daemon is: latency, losses, processor time, memory, and the time until it is ready.

    python -m benchmarks.daemon_speed --bank run/paper.bank --out run/daemon_speed.json [--rig-bank run/demo.bank]
        [--rig run]

Each figure is measured on a daemon in a process of its own, through a pseudo-terminal and a subscriber's socket.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq

from benchmarks.daemon_parts import (
    Board,
    configuration,
    cpu_of_threads_s,
    cpu_s,
    daemon,
    lines,
    memory_mb,
    received,
    spread,
    subscription,
    tree,
)
from benchmarks.fused_latency import fused_latency
from shearloop.bank.eit.bank_file import Bank
from shearloop.daemon.messaging.request import request
from shearloop.drivers.eit_kit import FRAME_PERIOD_S

REPEATS = 5
# Between frames whose latency is measured: long enough for the daemon to be idle again.
PAUSE_S = 0.03
FLOOD_HZ = 500.0
# Before processor time is measured: until everything is connected, and until an experiment has gripped its tool.
SETTLING_S, GRIPPING_S = 10.0, 15.0
TWISTS = {
    "name": "twists",
    "drive": "load_cell",
    "limits": {"torque_nm": 0.3, "angle_rad": 0.5},
    "steps": [
        {"do": "release", "timeout_s": 15},
        {"do": "tare", "timeout_s": 30},
        {"do": "approach", "along_tool_m": 0.03, "timeout_s": 15},
        {"do": "grip", "width_mm": 5, "force_n": 60, "timeout_s": 15},
        {"do": "twist", "angles_rad": [0.15, 0.0], "speed_rad_per_s": 0.2, "hold_s": 2, "repeats": 1000},
    ],
}


def latency(bank: Path, matching: str, n_frames: int, pause_s: float, *, in_packets: bool = True) -> dict[str, Any]:
    """Return the milliseconds from the last byte of a frame to its estimate at a subscriber.

    A line comes `in_packets` as from a USB port, or in one burst, as no port brings it.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        board = Board(folder / "right")
        config = configuration(folder, bank, ["right"], matching=matching, frame_period_s=pause_s)
        with daemon(config, folder) as (_, ready_s), subscription(folder, "eit.estimate") as estimates:
            board.wait_for_start()
            sent: list[int] = []
            taken, own = [], []
            for line in lines(Bank.open(bank), n_frames + 10):
                time.sleep(pause_s)
                sent.append(board.send_in_packets(line) if in_packets else board.send(line))
                arrived, content = received(estimates)
                if content["k"] is not None:
                    taken.append((arrived - sent[content["frame"]]) / 1e6)
                    own.append(content["latency_s"] * 1e3)
        board.close()
    p50, p99 = np.percentile(taken, [50, 99])
    return {"p50_ms": p50, "p99_ms": p99, "own_p50_ms": float(np.median(own)), "n": len(taken), "ready_s": ready_s}


def flood(bank: Path, n_frames: int) -> dict[str, Any]:
    """Return what becomes of frames that come five hundred times a second."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        board = Board(folder / "right")
        config = configuration(folder, bank, ["right"], matching="zero_lag", frame_period_s=1 / FLOOD_HZ)
        played = lines(Bank.open(bank), n_frames)
        with daemon(config, folder) as (pid, _), subscription(folder, "eit.estimate") as estimates:
            board.wait_for_start()
            before = cpu_s(pid)
            begun = time.monotonic()

            def play() -> None:
                for number, line in enumerate(played):
                    time.sleep(max(0.0, begun + number / FLOOD_HZ - time.monotonic()))
                    board.send(line)

            player = threading.Thread(target=play)
            player.start()
            frames = [received(estimates)[1]["frame"] for _ in played]
            took_s = time.monotonic() - begun
            player.join()
            busy = (cpu_s(pid) - before) / took_s
        board.close()
    return {
        "asked_hz": FLOOD_HZ,
        "estimates_hz": n_frames / took_s,
        "lost": n_frames - len(set(frames)),
        "in_order": frames == sorted(frames),
        "cores_busy": busy,
    }


def rated(
    bank: Path,
    rig_bank: Path,
    seconds: float,
    *,
    recording: bool = True,
    gripper: bool = True,
    twisting: bool = False,
) -> dict[str, Any]:
    """Return processor time, of every thread too, and memory with the emulated rig at its rated speeds.

    No experiment runs, or one that is `twisting` a tool to and fro. Memory is told at the beginning and at the end, so
    that one that grows is seen to.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        host = f"127.{os.getpid() >> 14 & 63 | 192}.{os.getpid() >> 7 & 127}.{1 + os.getpid() % 128}"
        robot = yaml.safe_load(Path("config/demo_ur.yaml").read_text())
        (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": host}))
        fingertip = {"bank": str(bank.resolve()), "matching": "all_lags"}
        content = {
            "publish": f"ipc://{folder}/publish",
            "commands": f"ipc://{folder}/commands",
            "fingertips": {side: {"device": {"path": f"eit-{side}"}, **fingertip} for side in ("left", "right")},
            "load_cell": {"device": {"path": "load-cell"}},
            "robot": "ur.yaml",
            **({"gripper": {"socket": {"host": host}}} if gripper else {}),
            **({"recording": {"folder": str(folder / "recordings")}} if recording else {}),
        }
        config = folder / "daemon.yaml"
        config.write_text(yaml.safe_dump(content))
        with subprocess.Popen(
            [
                *(sys.executable, "-m", "shearloop", "emulate", "rig", "--bank", str(rig_bank.resolve())),
                *("--run-dir", str(folder), "--host", host, "--paper-sketch"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as rig:
            if rig.stdout is not None:
                rig.stdout.readline()
            try:
                with daemon(config, folder) as (pid, ready_s), subscription(folder, "health") as health:
                    tasks = _listened(health, SETTLING_S)
                    if twisting:
                        (folder / "twists.yaml").write_text(yaml.safe_dump(TWISTS))
                        _started(f"ipc://{folder}/commands", folder / "twists.yaml")
                        _listened(health, GRIPPING_S)
                    at_first = memory_mb(pid)
                    before = {each: cpu_s(each) for each in tree(pid)}
                    threads_before = {each: cpu_of_threads_s(each) for each in before}
                    begun = time.monotonic()
                    tasks = _listened(health, seconds)
                    took_s = time.monotonic() - begun
                    shares = {each: (cpu_s(each) - cpu) / took_s for each, cpu in before.items()}
                    threads = {
                        "daemon" if each == pid else "robot's process": {
                            name: (cpu - earlier.get(name, 0.0)) / took_s
                            for name, cpu in cpu_of_threads_s(each).items()
                        }
                        for each, earlier in threads_before.items()
                    }
                    memory = {each: memory_mb(each) for each in before}
            finally:
                rig.terminate()
    children = [each for each in shares if each != pid]
    return {
        "ready_s": ready_s,
        "recording": recording,
        "gripper": gripper,
        "twisting": twisting,
        "seconds": took_s,
        "cpu_share_of_one_core": shares[pid],
        "cpu_share_of_the_robots_process": sum(shares[each] for each in children),
        "cpu_shares_of_threads": threads,
        "memory_mb_at_first": at_first,
        "memory_mb": memory[pid],
        "memory_mb_of_the_robots_process": sum(memory[each]["resident"] for each in children),
        "rates_hz": {task: facts.get("rate_hz") for task, facts in tasks.items() if facts.get("rate_hz")},
    }


def _listened(health: "zmq.Socket[bytes]", seconds: float) -> dict[str, Any]:
    """Read health as it comes for so long, and return what it last said of the tasks."""
    until = time.monotonic() + seconds
    tasks: dict[str, Any] = {}
    while not tasks or time.monotonic() < until:
        tasks = received(health)[1]["tasks"]
    return tasks


def _started(commands: str, experiment: Path) -> None:
    """Begin an experiment, with the operator's word for what waits for it."""
    until = time.monotonic() + SETTLING_S
    while not (reply := request(commands, {"command": "start", "experiment": str(experiment)}, SETTLING_S))["ok"]:
        if time.monotonic() > until:
            raise RuntimeError(reply["why"])
        request(commands, {"command": "unlock"}, SETTLING_S)


def shared_bank(bank: Path) -> dict[str, Any]:
    """Return the memory of two daemons on one bank, after each has matched frames from all over it."""
    with tempfile.TemporaryDirectory() as one, tempfile.TemporaryDirectory() as other:
        figures = []
        boards, running = [], []
        try:
            for folder in (Path(one), Path(other)):
                boards.append(Board(folder / "right"))
                context = daemon(configuration(folder, bank, ["right"], frame_period_s=PAUSE_S), folder)
                running.append((context, context.__enter__()[0]))
                boards[-1].wait_for_start()
            for board in boards:
                for line in lines(Bank.open(bank), 60):
                    board.send(line)
            time.sleep(1.0)
            figures = [memory_mb(pid) for _, pid in running]
            mapped = [_mapped_mb(pid, bank) for _, pid in running]
        finally:
            for context, _ in running:
                context.__exit__(None, None, None)
            for board in boards:
                board.close()
    return {"processes": figures, "of_the_bank": mapped}


def _mapped_mb(pid: int, bank: Path) -> dict[str, float]:
    """Return how much of a bank is resident in a process, and how much of that it has for itself."""
    found, inside = {"resident": 0.0, "private": 0.0}, False
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        key, _, value = line.partition(":")
        if " " in key:
            inside = line.endswith(str(bank.resolve()))
        elif inside and key == "Rss":
            found["resident"] += int(value.split()[0]) / 1024
        elif inside and key in ("Private_Clean", "Private_Dirty"):
            found["private"] += int(value.split()[0]) / 1024
    return found


def command_s(*arguments: str) -> float:
    """Return the seconds that a command takes."""
    begun = time.monotonic()
    subprocess.run([sys.executable, "-m", "shearloop", *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - begun


def main() -> None:
    """Measure all and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path, required=True, help="the bank of the fingertips, of 100 × 100 cells")
    parser.add_argument("--rig-bank", type=Path, help="what the emulated rig plays (default: the same)")
    parser.add_argument(
        "--rig", type=Path, help="where benchmarks.rig_twists left rig-25mm.mcap and rig*.cal, for `fused`"
    )
    parser.add_argument("--frames", type=int, default=300, help="frames whose latency is measured")
    parser.add_argument("--rated-s", type=float, default=30.0, help="seconds at rated speeds")
    parser.add_argument("--only", nargs="+", choices=("help", "latency", "flood", "rated", "shared"))
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    found: dict[str, Any] = {"load_average": os.getloadavg()[0], "cores": os.cpu_count()}
    wanted = args.only or ("help", "latency", "flood", "rated", "shared")
    if "help" in wanted:
        found["help_s"] = spread([command_s("--help") for _ in range(REPEATS)])
    if "latency" in wanted:
        found["latency"] = {
            each: {
                "in_packets": latency(args.bank, each, args.frames, PAUSE_S),
                "in_packets_at_the_boards_rate": latency(args.bank, each, args.frames // 3, FRAME_PERIOD_S),
                "in_a_burst": latency(args.bank, each, args.frames, PAUSE_S, in_packets=False),
            }
            for each in ("zero_lag", "all_lags")
        }
        if args.rig is None:
            print("latency of `fused`: left out, for no --rig was given", file=sys.stderr)
        else:
            found["latency"]["fused"] = {
                name: {
                    "in_packets": fused_latency(args.rig, sides, args.frames, PAUSE_S),
                    "in_packets_at_the_boards_rate": fused_latency(args.rig, sides, args.frames // 3, FRAME_PERIOD_S),
                }
                for name, sides in (("one", ("right",)), ("two", ("right", "left")))
            }
    if "flood" in wanted:
        found["flood"] = flood(args.bank, 10 * args.frames)
    if "rated" in wanted:
        rig_bank = args.rig_bank or args.bank
        found["rated"] = rated(args.bank, rig_bank, args.rated_s)
        found["rated_without_gripper"] = rated(args.bank, rig_bank, args.rated_s, gripper=False)
        found["rated_without_recording"] = rated(args.bank, rig_bank, args.rated_s, recording=False)
        found["rated_twisting"] = rated(args.bank, rig_bank, args.rated_s, twisting=True)
    if "shared" in wanted:
        found["shared"] = shared_bank(args.bank)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
