"""How smooth the live view's page is in headless Chromium: `python -m benchmarks.view_redraw --out FILE`.

Publishes a whole rig's messages at their rates, with heatmaps of 100 × 100, opens the page through `shearloop view`,
and takes the times of the chart's redraws: as fast as this computer is, and slowed down four and eight times, as
tablets are. Needs Debian's chromium and the extra `dev`.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from shearloop.daemon.clock import Clock
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import (
    EitEstimate,
    EitHeatmap,
    Health,
    LoadTorque,
    LoopState,
    Message,
    RobotStateMessage,
)
from shearloop.daemon.messaging.publisher import Publisher

CHROMIUM_ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)
SIZES = {"screen": (1366, 800), "tablet": (1024, 768)}
SLOWED = (1, 4, 8)
# The chart's canvas is cleared once a redraw.
_COUNT_REDRAWS = """
window.redrawn = [];
const cleared = CanvasRenderingContext2D.prototype.clearRect;
CanvasRenderingContext2D.prototype.clearRect = function (...box) {
  if (this.canvas.closest('#torque-chart')) window.redrawn.push(performance.now());
  return cleared.apply(this, box);
};
"""


def rig_messages(t_ns: int, turn: int) -> Iterator[Message]:
    """Yield what a rig says in the turn-th of 25 turns a second, each topic at its rate."""
    swing = float(np.sin(turn / 40.0))
    torque_nm = 0.1 * swing
    yield RobotStateMessage(
        source="robot",
        t_mono_ns=t_ns,
        joints_rad=(0.0,) * 6,
        tcp_pose=(0.0,) * 6,
        wrench=(0.0,) * 6,
        wrist_rad=swing,
        wrist_speed_rad_per_s=0.0,
        wrist_torque_nm=-torque_nm,
        robot_mode=7,
        safety_mode=1,
        speed_scaling=1.0,
        protective_stop=False,
        emergency_stop=False,
        blocked="",
        age_s=0.0,
    )
    if turn % 2 == 0:
        yield LoadTorque(
            source="load_cell", t_mono_ns=t_ns, torque_nm=torque_nm, raw=0.0,
            saturated=False, spike=False, valid=True, reason="",
        )  # fmt: skip
    if turn % 13 == 0:
        yield from _estimate(t_ns, turn, torque_nm)
    if turn % 25 == 0:
        yield from _once_a_second(t_ns, torque_nm)


def _estimate(t_ns: int, turn: int, torque_nm: float) -> Iterator[Message]:
    cells = np.arange(100) / 100
    scores = np.clip(0.9 - (cells[:, None] - 0.5) ** 2 - (cells - 0.5 - torque_nm) ** 2, 0, 1)
    grid = {"k_low": 0.1, "k_high": 4.4, "sigma_low": 0.1, "sigma_high": 4.4}
    yield EitEstimate(
        source="right",
        t_mono_ns=t_ns,
        torque_nm=torque_nm,
        torque_low_nm=torque_nm - 0.02,
        torque_high_nm=torque_nm + 0.02,
        diameter_mm=20.0,
        diameter_low_mm=18.0,
        diameter_high_mm=22.0,
        k=3.6,
        sigma=1.6 + torque_nm,
        score=0.9,
        runner_up=0.89,
        valid=True,
        reason="",
        frame=turn,
        latency_s=0.005,
    )
    yield EitHeatmap(source="right", t_mono_ns=t_ns, scores=scores, model="gaussian_derivative", frame=turn, **grid)


def _once_a_second(t_ns: int, torque_nm: float) -> Iterator[Message]:
    yield LoopState(
        source="loop",
        t_mono_ns=t_ns,
        step_name="twist",
        hold=1,
        slices="",
        tool_mm=None,
        stiffness_nm_per_rad=0.75,
        delay_s=0.5,
        noise_nm=0.01,
        phase="running",
        experiment="bench",
        step=1,
        steps=1,
        activity="swinging",
        progress=0.5,
        remaining_s=10.0,
        torque_source="right",
        torque_nm=torque_nm,
        set_point_nm=0.1,
        ramp_nm=torque_nm,
        expected_nm=torque_nm,
        speed_command_rad_per_s=0.0,
        speed_sent_rad_per_s=0.0,
        response="note",
        reasons="",
    )
    tasks = {name: {"alive": True, "restarts": 0} for name in ("right", "robot", "loop", "commands", "health")}
    yield Health(source="daemon", t_mono_ns=t_ns, tasks=tasks, loop_lag_s=0.0, memory_mb=100.0, cpu_percent=5.0)


def _publish(address: str, end: threading.Event) -> None:
    with zmq.Context() as context:
        clock = Clock()
        with closing(Publisher(context, address, clock)) as publisher:
            turn, due_s = 0, time.monotonic()
            while not end.wait(max(0.0, due_s - time.monotonic())):
                for message in rig_messages(clock.now_ns(), turn):
                    publisher.publish(message)
                turn, due_s = turn + 1, due_s + 0.04


@contextmanager
def rig_and_viewer(folder: Path) -> Iterator[str]:
    """Publish, serve the page, and yield its address."""
    publish = f"ipc://{folder}/publish"
    end = threading.Event()
    thread = threading.Thread(target=_publish, args=(publish, end))
    thread.start()
    viewer = subprocess.Popen(
        [
            *(
                sys.executable,
                "-m",
                "shearloop",
                "view",
                "--json",
                "--port",
                "0",
                "--token-file",
                str(folder / "token"),
            ),
            *("--connect", publish, "--commands", f"ipc://{folder}/commands"),
        ],
        stdout=subprocess.PIPE,
    )
    try:
        if viewer.stdout is None:
            raise UserError("the viewer has no output")
        yield str(json.loads(viewer.stdout.readline())["url"])
    finally:
        viewer.terminate()
        viewer.communicate()
        end.set()
        thread.join()


def figures(redrawn_ms: list[float], busy_s: float, passed_s: float, told: str) -> dict[str, float]:
    """Return the rate, the spread of the intervals, and how busy the page's thread was."""
    intervals = [after - before for before, after in pairwise(redrawn_ms)]
    return {
        "redraws_per_s": (len(redrawn_ms) - 1) / (redrawn_ms[-1] - redrawn_ms[0]) * 1000,
        "interval_median_ms": statistics.median(intervals),
        "interval_99_ms": statistics.quantiles(intervals, n=100)[98],
        "script_ms_per_redraw": float(told.partition(",")[2].split(maxsplit=1)[0]),
        "thread_busy_percent": 100.0 * busy_s / passed_s,
    }


def measure(url: str, folder: Path, seconds: float) -> dict[str, Mapping[str, float]]:
    """Return the figures of each size and slowness, once a minute of data is drawn."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        raise UserError("this bench needs Debian's chromium; `make system-packages` installs it")
    found: dict[str, Mapping[str, float]] = {}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch_persistent_context(
            folder / "profile", executable_path=chromium, headless=True, args=CHROMIUM_ARGUMENTS
        )
        page = browser.pages[0]
        page.add_init_script(_COUNT_REDRAWS)
        page.goto(url)
        page.wait_for_function("() => document.querySelector('#link-state').textContent === '● live'")
        devtools = browser.new_cdp_session(page)
        devtools.send("Performance.enable")

        def busy_s() -> float:
            metrics: list[dict[str, Any]] = devtools.send("Performance.getMetrics")["metrics"]
            return float(next(each["value"] for each in metrics if each["name"] == "TaskDuration"))

        for name, (width, height) in SIZES.items():
            page.set_viewport_size({"width": width, "height": height})
            for slowed in SLOWED:
                devtools.send("Emulation.setCPUThrottlingRate", {"rate": slowed})
                page.wait_for_timeout(1500)
                page.evaluate("window.redrawn = []")
                began_s, busy_before_s = time.monotonic(), busy_s()
                page.wait_for_timeout(1000 * seconds)
                passed_s, busy = time.monotonic() - began_s, busy_s() - busy_before_s
                redrawn = page.evaluate("window.redrawn")
                found[f"{name}, slowed {slowed}×"] = figures(redrawn, busy, passed_s, page.inner_text("#rate"))
        browser.close()
    return found


def main() -> int:
    """Measure, print the table, and write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="for each row (default: %(default)s)")
    parser.add_argument("--warm-up", type=float, default=60.0, help="until the chart is full (default: %(default)s s)")
    parser.add_argument("--out", type=Path, default=Path("run/view_redraw.json"))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, rig_and_viewer(Path(name)) as url:
        time.sleep(args.warm_up)
        found = measure(url, Path(name), args.seconds)
    print(f"{'':<22}{'redraws/s':>10}{'median ms':>11}{'99 % ms':>9}{'script ms':>11}{'busy %':>8}")
    for name, row in found.items():
        print(
            f"{name:<22}{row['redraws_per_s']:>10.1f}{row['interval_median_ms']:>11.1f}{row['interval_99_ms']:>9.1f}"
            f"{row['script_ms_per_redraw']:>11.1f}{row['thread_busy_percent']:>8.0f}"
        )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(found, indent=2, ensure_ascii=False) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
