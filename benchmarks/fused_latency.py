"""From the last byte of a frame to an estimate by `fused` at a subscriber, for `benchmarks.daemon_speed`.

What is played was recorded of the emulated rig by `python -m benchmarks.rig_twists`, with its calibrations.
"""

import contextlib
import tempfile
import time
from pathlib import Path

import numpy as np
import yaml
import zmq

from benchmarks.daemon_parts import Board, daemon, line_text, received, subscription
from shearloop.daemon.recording.reader import read_recording
from shearloop.daemon.sensing.both import BOTH

RECORDING = "rig-25mm.mcap"
BOTH_CALIBRATION = "rig.cal"
# Some idle frames are left out. Soon after them the tool is gripped, and the 40th frame gives the first valid estimate.
_FIRST, _FIRST_VALID = 12, 39
# An estimate that has not come after this long will not: the two frames came too far apart to make a pair.
_LOST_MS = 1000


def fused_latency(rig: Path, sides: tuple[str, ...], n_frames: int, pause_s: float) -> dict[str, dict[str, float]]:
    """Return by source the milliseconds from a frame's last byte to its estimate, of n_frames with a valid one at most.

    Of two sides both are told, and `both`, from the last byte of the later one. Lines come in packets. Estimates that
    were not valid, and those that did not come, are counted and not timed.
    """
    recorded = read_recording(rig / RECORDING).sides
    lines = {side: [line_text(one) for one in recorded[side].lines[_FIRST : _FIRST_VALID + n_frames]] for side in sides}
    taken: dict[str, list[tuple[float, float]]] = {
        source: [] for source in ((*sides, BOTH) if len(sides) > 1 else sides)
    }
    missed = {source: {"not_valid": 0, "lost": 0} for source in taken}
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        boards = {side: Board(folder / side) for side in sides}
        for board in boards.values():
            opened.callback(board.close)
        config = _configuration(folder, rig.resolve(), sides, pause_s)
        opened.enter_context(daemon(config, folder))
        estimates = opened.enter_context(subscription(folder, "eit.estimate"))
        estimates.setsockopt(zmq.RCVTIMEO, _LOST_MS)
        for board in boards.values():
            board.wait_for_start()
        for number in range(min(map(len, lines.values()))):
            time.sleep(0.5 * pause_s)
            for side, board in boards.items():
                # Two boards do not keep step: a frame comes when the daemon is idle again.
                time.sleep(0.5 * pause_s / len(sides))
                sent_ns = board.send_in_packets(lines[side][number])
                awaited = {side, BOTH} if side == sides[-1] and len(sides) > 1 else {side}
                while awaited:
                    try:
                        arrived_ns, content = received(estimates)
                    except zmq.Again:
                        for source in awaited:
                            missed[source]["lost"] += 1
                        break
                    if content["frame"] == number and content["source"] in awaited:
                        awaited.remove(content["source"])
                        if content["valid"]:
                            took_ms = (arrived_ns - sent_ns) / 1e6, content["latency_s"] * 1e3
                            taken[content["source"]].append(took_ms)
                        else:
                            missed[content["source"]]["not_valid"] += number >= _FIRST_VALID - _FIRST
    return {source: {**_figures(np.array(found)), **missed[source]} for source, found in taken.items()}


def _figures(taken: np.ndarray) -> dict[str, float]:
    if not len(taken):
        raise RuntimeError("no estimate was valid; make the recording and its calibrations anew: benchmarks.rig_twists")
    p50, p99 = np.percentile(taken[:, 0], [50, 99])
    return {"p50_ms": p50, "p99_ms": p99, "own_p50_ms": float(np.median(taken[:, 1])), "n": len(taken)}


def _configuration(folder: Path, rig: Path, sides: tuple[str, ...], period_s: float) -> Path:
    fingertips = {
        side: {
            "device": {"path": str(folder / side)},
            "frame_period_s": period_s,
            "calibration": str(rig / f"rig-{side}.cal"),
            "estimator": "fused",
        }
        for side in sides
    }
    content = {
        "publish": f"ipc://{folder}/publish",
        "commands": f"ipc://{folder}/commands",
        "fingertips": fingertips,
        **({BOTH: {"calibration": str(rig / BOTH_CALIBRATION)}} if len(sides) > 1 else {}),
    }
    path = folder / "daemon.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
