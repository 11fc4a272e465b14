"""The daemon's latency, losses, processor time, memory, and time until it is ready.

    python -m benchmarks.daemon_speed --bank run/paper.bank --rig run --out run/daemon_speed.json

Each figure is measured on a daemon in its own process, through a pseudo-terminal and a subscriber's socket. Latency
counts from before the last byte is written until the subscriber has the estimate. `--rig` is the folder
`run` of `shearloop demo --prepare`, with the default estimator's recording and calibrations, and the rig's bank.
Needs the extra `bench`.
"""

import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zmq

from benchmarks import common
from shearloop.daemon.messaging.messages import decode
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.boards import format_line
from shearloop.tools.recordings.frames import read_recording

REPEATS = 5
# Timed frames of a latency, at the board's rate.
FRAMES = 80
FLOOD_HZ, FLOOD_FRAMES = 500.0, 2400
RATED_S = 30.0
# Before processor time counts: until everything is connected.
SETTLING_S = 10.0


def receive(subscriber: "zmq.Socket[bytes]") -> tuple[int, dict[str, Any]]:
    """Return the arrival time of the next message in ns, and its content."""
    _, payload = subscriber.recv_multipart()
    return time.monotonic_ns(), decode(payload)


def cpu_s(process: psutil.Process) -> float:
    """Return the processor time of a process."""
    times = process.cpu_times()
    return float(times.user + times.system)


def recorded_lines(rig: Path, side: str, n: int) -> list[bytes]:
    """Return n lines of one board from the emulated rig's recording: idle ones, then a gripped tool being twisted."""
    recorded = read_recording(rig / "rig-25mm.mcap").sides[side].lines[common.FIRST_FRAME :]
    return list(islice(cycle([format_line(values) for values in recorded]), n))


def by_bank(bank: Path, matching: str) -> dict[str, Any]:
    """Return the configuration of one fingertip that is matched in a bank."""
    return {"fingertips": {"right": {"bank": str(bank), "matching": matching}}}


def by_default(rig: Path, sides: Sequence[str]) -> dict[str, Any]:
    """Return the configuration of fingertips with the default estimator, and of the combined one for several."""
    fingertips = {
        side: {"calibration": str(rig / f"rig-{side}.cal"), "estimator": "motion_regression"} for side in sides
    }
    combined = {COMBINED: {"calibration": str(rig / "rig.cal")}} if len(sides) > 1 else {}
    return {"fingertips": fingertips, **combined}


@contextlib.contextmanager
def played(config: dict[str, Any], period_s: float) -> Iterator[tuple[dict[str, common.PlayedBoard], int, Any]]:
    """Run a daemon on boards that the benchmark plays; yield them, its process id, and estimates."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        boards = {side: common.PlayedBoard(folder / side) for side in config["fingertips"]}
        for board in boards.values():
            opened.callback(board.close)
        fingertips = {
            side: {**fingertip, "device": {"path": str(folder / side)}, "frame_period_s": period_s}
            for side, fingertip in config["fingertips"].items()
        }
        path = common.write_config(folder, **{**config, **common.PLAYED, "fingertips": fingertips})
        daemon, _ = opened.enter_context(common.running_daemon(path))
        estimates = opened.enter_context(common.subscription(folder, "eit.estimate"))
        for board in boards.values():
            board.wait_for_start()
        yield boards, daemon.pid, estimates


def latency(config: dict[str, Any], rig: Path) -> dict[str, dict[str, float]]:
    """Return by source the milliseconds from a frame's last byte to its estimate.

    The combined estimate counts from the last byte of the later frame. The first frames, until the default estimator is
    valid, are not timed. Raises zmq.Again if an estimate does not come.
    """
    sides = list(config["fingertips"])
    n_frames = common.FIRST_VALID_FRAME + FRAMES
    lines = {side: recorded_lines(rig, side, n_frames) for side in sides}
    last_sources = {sides[-1], COMBINED} if len(sides) > 1 else {sides[-1]}
    taken: dict[str, list[float]] = {source: [] for source in (*sides, *last_sources)}
    latest = dict.fromkeys(taken, -1)
    with played(config, FRAME_PERIOD_S) as (boards, _, estimates):
        for number in range(n_frames):
            time.sleep(0.5 * FRAME_PERIOD_S)
            for side, board in boards.items():
                # Two boards do not keep step.
                time.sleep(0.5 * FRAME_PERIOD_S / len(sides))
                sent_ns = board.send_in_packets(lines[side][number])
                awaited = set(last_sources) if side == sides[-1] else {side}
                while awaited:
                    arrived_ns, estimate = receive(estimates)
                    source = estimate["source"]
                    if source in awaited and estimate["frame"] > latest[source]:
                        awaited.remove(source)
                        latest[source] = estimate["frame"]
                        if number >= common.FIRST_VALID_FRAME and (estimate["valid"] or estimate["k"] is not None):
                            taken[source].append((arrived_ns - sent_ns) / 1e6)
    return {
        source: {"p50_ms": float(np.percentile(found, 50)), "p99_ms": float(np.percentile(found, 99)), "n": len(found)}
        for source, found in taken.items()
    }


def flood(config: dict[str, Any], rig: Path) -> dict[str, Any]:
    """Return the losses and the load at five hundred frames a second."""
    lines = recorded_lines(rig, "right", FLOOD_FRAMES)
    with played(config, 1 / FLOOD_HZ) as (boards, pid, estimates):
        process = psutil.Process(pid)
        before, begun = cpu_s(process), time.monotonic()

        def play() -> None:
            for number, line in enumerate(lines):
                time.sleep(max(0.0, begun + number / FLOOD_HZ - time.monotonic()))
                boards["right"].send(line)

        player = threading.Thread(target=play)
        player.start()
        frames = [receive(estimates)[1]["frame"] for _ in lines]
        took_s = time.monotonic() - begun
        player.join()
        busy = (cpu_s(process) - before) / took_s
    return {
        "estimates_hz": FLOOD_FRAMES / took_s,
        "lost": FLOOD_FRAMES - len(set(frames)),
        "in_order": frames == sorted(frames),
        "cores_busy": busy,
    }


def rated(bank: Path, rig_bank: Path) -> dict[str, float]:
    """Return processor time and memory with the whole emulated rig at its rated speeds, recording."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        fingertip = {"bank": str(bank), "matching": "all_lags"}
        config = common.write_rig_config(
            folder,
            "config/demo_ur.yaml",
            fingertips={side: {"device": {"path": f"eit-{side}"}, **fingertip} for side in ("left", "right")},
            load_cell={"device": {"path": "load-cell"}},
            recording={"folder": str(folder / "recordings")},
        )
        opened.enter_context(common.emulated_rig(folder, rig_bank, "--paper-sketch"))
        daemon, ready_s = opened.enter_context(common.running_daemon(config))
        health = opened.enter_context(common.subscription(folder, "health"))
        _listen(health, SETTLING_S)
        own = psutil.Process(daemon.pid)
        before, begun = {each: cpu_s(each) for each in (own, *own.children(recursive=True))}, time.monotonic()
        _listen(health, RATED_S)
        took_s = time.monotonic() - begun
        shares = {each: (cpu_s(each) - cpu) / took_s for each, cpu in before.items()}
        memory = {each: each.memory_info().rss / 2**20 for each in before}
    return {
        "ready_s": ready_s,
        "core_share_of_daemon": shares[own],
        "core_share_of_robot_worker": sum(shares.values()) - shares[own],
        "memory_mb_of_daemon": memory[own],
        "memory_mb_of_robot_worker": sum(memory.values()) - memory[own],
    }


def _listen(health: "zmq.Socket[bytes]", seconds: float) -> None:
    """Read health messages for a time, as a client does."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        receive(health)


def command_s(*arguments: str, repeats: int = 1) -> float:
    """Return the median seconds of a shearloop command."""
    taken = []
    for _ in range(repeats):
        begun = time.monotonic()
        subprocess.run([sys.executable, "-m", "shearloop", *arguments], check=True, stdout=subprocess.DEVNULL)
        taken.append(time.monotonic() - begun)
    return float(np.median(taken))


def measure(bank: Path, rig: Path) -> dict[str, Any]:
    """Return all figures."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        built = ("bank", "build", "--config", "config/banks/paper.yaml", "--out", f"{folder}/paper.bank")
        found["build_10000_cells_s"] = command_s(*built)
    found["help_s"] = command_s("--help", repeats=REPEATS)
    configs = {
        "zero_lag": by_bank(bank, "zero_lag"),
        "all_lags": by_bank(bank, "all_lags"),
        "default_one_fingertip": by_default(rig, ("right",)),
        "default_both": by_default(rig, ("right", "left")),
    }
    found["latency"] = {name: latency(config, rig) for name, config in configs.items()}
    found["flood"] = flood(configs["zero_lag"], rig)
    found["rated"] = rated(bank, rig / "demo.bank")
    return found


def main() -> None:
    """Measure and write the figures."""
    parser = common.parser_of(__doc__)
    parser.add_argument("--bank", type=Path, required=True, help="the fingertips' bank, of 100 × 100 cells")
    parser.add_argument("--rig", type=Path, required=True, help="folder with rig-25mm.mcap, rig*.cal and demo.bank")
    args = parser.parse_args()
    print(common.write_figures(args.out, measure(args.bank.resolve(), args.rig.resolve())))


if __name__ == "__main__":
    main()
