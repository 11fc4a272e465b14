import asyncio
import contextlib
import os
import pty
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zmq
import zmq.asyncio
from scipy.io import savemat

from shearloop.bank.eit.channels import LINE_SLOTS, line_of_channels
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.messaging.messages import decode
from shearloop.drivers.eit_kit import ADC_STEP_V
from tests.daemon.conftest import DEADLINE_S, shearloop
from tests.emulator_process import own_address

Connect = Callable[[str, str], "zmq.Socket[bytes]"]
Write = Callable[..., Path]


def next_message(socket: "zmq.Socket[bytes]") -> dict[str, Any]:
    _, payload = socket.recv_multipart()
    return decode(payload)


def recording(folder: Path, n_frames: int) -> Path:
    random = np.random.default_rng(2)
    idle = random.integers(20, 200, len(LINE_SLOTS))
    steps = idle + random.integers(-1, 2, (n_frames, len(LINE_SLOTS)))
    steps[n_frames // 2 :] += random.integers(-15, 16, len(LINE_SLOTS))
    days = 739_588 + np.arange(n_frames) * 0.5408 / 86_400
    path = folder / "stream.mat"
    savemat(path, {"Right_Data": np.column_stack([days, np.round(line_of_channels(steps * ADC_STEP_V), 4)])})
    return path


async def test_every_frame_at_100_times_speed_becomes_an_estimate_in_order(
    shared: Path, config: Write, tmp_path: Path, subscriber: Connect
) -> None:
    play = shared / "recordings" / "streams" / "2024-12-03_16-09" / "device1.mat"
    async with shearloop("run", str(config())) as daemon:
        estimates = subscriber(f"ipc://{tmp_path}/publish", "eit.estimate")
        health = subscriber(f"ipc://{tmp_path}/publish", "health")
        assert await asyncio.to_thread(next_message, health), "the subscription has arrived"
        link = str(tmp_path / "eit-right")
        async with shearloop(
            *("emulate", "eit-kit", "--recording", str(play), "--once", "--speed", "100", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            received = await asyncio.to_thread(lambda: [next_message(estimates) for _ in range(832)])
        assert [message["frame"] for message in received] == list(range(832))
        assert [message["seq"] for message in received] == list(range(832))
        times = np.array([message["t_mono_ns"] for message in received])
        assert (np.diff(times) > 0).all()
        assert sum(message["valid"] for message in received) > 400
        assert all(message["torque_nm"] is None for message in received if not message["valid"])
        await stop_and_time(daemon, signal.SIGTERM)


async def stop_and_time(daemon: asyncio.subprocess.Process, number: signal.Signals) -> None:
    daemon.send_signal(number)
    begun = time.monotonic()
    assert await daemon.wait() == 0
    # The issue asks for a second; the machine may be busy with other tests.
    assert time.monotonic() - begun < 5


@pytest.mark.usefixtures("hears_of_terminal")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
async def test_the_daemon_and_its_emulators_stop_cleanly_on_a_signal(
    number: signal.Signals, config: Write, tmp_path: Path, subscriber: Connect
) -> None:
    link = tmp_path / "eit-right"
    emulator = {"device": "eit-kit", "arguments": ["--link", str(link), "--recording", str(recording(tmp_path, 20))]}
    async with shearloop("run", str(config(emulators=[emulator])), "--show") as daemon:
        frames = subscriber(f"ipc://{tmp_path}/publish", "eit.frame")
        content = await asyncio.to_thread(next_message, frames)
        assert content["channels"].shape == (896,)
        assert daemon.stderr is not None
        assert b"emulated devices are starting" in await daemon.stderr.readline(), "before what is missed of them"
        await stop_and_time(daemon, number)
        assert not link.is_symlink(), "the emulator has taken its port away"


@contextlib.asynccontextmanager
async def running(path: Path) -> Any:
    """Run a daemon in this process, where its parts can be reached."""
    with zmq.asyncio.Context() as context:
        daemon = Daemon(load_daemon_config(path), context)
        # A daemon that dies ends the test at once.
        async with asyncio.timeout(DEADLINE_S), asyncio.TaskGroup() as group:
            group.create_task(daemon.run())
            try:
                yield daemon
            finally:
                daemon.stop()


def collector(daemon: Daemon, topic: str) -> "asyncio.Queue[dict[str, Any]]":
    queue: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

    def listen(name: str, content: dict[str, Any]) -> None:
        if name == topic:
            queue.put_nowait(content)

    daemon.publisher.add_listener(listen)
    return queue


async def test_tare_status_and_stop_commands(config: Write, tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/commands"
    play = recording(tmp_path, 60)
    link = str(tmp_path / "eit-right")
    async with running(config()) as daemon:
        estimates = collector(daemon, "eit.estimate")
        async with shearloop(
            *("emulate", "eit-kit", "--recording", str(play), "--speed", "20", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            while not (await estimates.get())["valid"]:
                continue
            reply = await asyncio.to_thread(send_command, address, {"command": "tare"}, DEADLINE_S)
            assert reply == {"ok": True, "tared": ["right"]}
            while "taking the homogeneous frame, 1 of 10" not in (await estimates.get())["reason"]:
                continue
            reply = await asyncio.to_thread(send_command, address, {"command": "tare", "source": "left"}, DEADLINE_S)
            assert reply == {"ok": False, "reason": "there is no sensor 'left' to tare; there are right"}
            status = await asyncio.to_thread(send_command, address, {"command": "status"}, DEADLINE_S)
            assert status["tasks"]["right"]["connected"]
            assert status["tasks"]["commands"]["errors"] == {"tare refused": 1}
        assert (await asyncio.to_thread(send_command, address, {"command": "stop"}, DEADLINE_S))["ok"]
        await daemon._stop.wait()


async def test_a_heatmap_is_computed_only_with_a_subscriber(config: Write, tmp_path: Path, subscriber: Connect) -> None:
    play, link = recording(tmp_path, 60), str(tmp_path / "eit-right")
    async with running(config()) as daemon:
        estimates, heatmaps = collector(daemon, "eit.estimate"), collector(daemon, "eit.heatmap")
        async with shearloop(
            *("emulate", "eit-kit", "--recording", str(play), "--speed", "20", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            while not (await estimates.get())["valid"]:
                continue
            estimate = await estimates.get()
            assert heatmaps.empty()
            socket = subscriber(f"ipc://{tmp_path}/publish", "eit.heatmap")
            heatmap = await asyncio.to_thread(next_message, socket)
            # Estimates come before their heatmaps: the last one seen may be the one.
            while estimate["frame"] != heatmap["frame"]:
                estimate = await estimates.get()
        assert heatmap["scores"].shape == (8, 8)
        assert heatmap["scores"].max() == pytest.approx(estimate["score"])
        assert heatmap["model"] == "gaussian_derivative"


@pytest.fixture
def robotless(config: Write, tmp_path: Path) -> Path:
    """Write a configuration with an experiment, and with a robot that is not there."""
    robot = yaml.safe_load(Path("config/ur.yaml").read_text())
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": own_address(7)}))
    rig = {
        "robot": "ur.yaml",
        "gripper": {"socket": {"host": own_address(7)}},
        "load_cell": {"device": {"path": "load"}},
    }
    return config(**rig, experiment=str(Path("config/experiments/loosen.yaml").resolve()))


async def test_stop_cancels_a_waiting_experiment_and_keeps_the_daemon(robotless: Path, tmp_path: Path) -> None:
    async with running(robotless) as daemon:
        health = collector(daemon, "health")
        while not (await health.get())["tasks"]["experiment"]["alive"]:
            continue
        stop = {"command": "stop", "spare_daemon": True}
        reply = await asyncio.to_thread(send_command, f"ipc://{tmp_path}/commands", stop, DEADLINE_S)
        assert reply == {"ok": True, "stopped": "the start of loosen.yaml"}
        while not (await health.get())["tasks"]["experiment"]["done"]:
            continue
        reply = await asyncio.to_thread(send_command, f"ipc://{tmp_path}/commands", stop, DEADLINE_S)
        assert reply == {"ok": True, "stopped": ""}


async def test_a_lost_board_reconnects_and_health_counts_refused_lines(config: Write, tmp_path: Path) -> None:
    link = str(tmp_path / "eit-right")
    faults = ["--fault", "wrong-count@5", "--fault", "garbage@7", "--fault", "unplug:0.3@12"]
    async with running(config()) as daemon:
        frames, health = collector(daemon, "eit.frame"), collector(daemon, "health")
        async with shearloop(
            *("emulate", "eit-kit", "--recording", str(recording(tmp_path, 40)), "--speed", "20", "--link", link),
            *faults,
            stdin=asyncio.subprocess.PIPE,
        ):
            for _ in range(25):
                await frames.get()
            facts = (await health.get())["tasks"]["right"]
            while facts["connections"] < 2 or facts["frames"] < 25:
                facts = (await health.get())["tasks"]["right"]
            assert facts["alive"]
            assert facts["errors"]["wrong_count"] >= 1
            assert sum(facts["errors"].values()) >= 2


async def test_a_crashed_estimator_restarts_and_is_reported(
    config: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from shearloop.daemon.sensing.estimators import LiveEstimator

    estimate = LiveEstimator.estimate
    deaths = iter([True])

    async def fragile(self: LiveEstimator, frame: Any) -> Any:
        if frame.seq == 3 and next(deaths, False):
            raise RuntimeError("a bug")
        return await estimate(self, frame)

    monkeypatch.setattr(LiveEstimator, "estimate", fragile)
    link = str(tmp_path / "eit-right")
    async with running(config()) as daemon:
        estimates = collector(daemon, "eit.estimate")
        async with shearloop(
            *("emulate", "eit-kit", "--recording", str(recording(tmp_path, 40)), "--speed", "20", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            seen = [(await estimates.get())["frame"] for _ in range(8)]
    assert seen[:4] == [0, 1, 2, 4], "frames continue after the one that killed it"
    record = daemon.supervisor.records["right"]
    assert (record.restarts, record.last_error) == (1, "RuntimeError: a bug")


async def test_the_daemon_survives_a_closed_log(config: Write, tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/commands"
    reader, writer = os.pipe()
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "shearloop", "run", str(config()), stderr=writer
    )
    os.close(writer)
    try:
        async with asyncio.timeout(DEADLINE_S):
            assert await asyncio.to_thread(os.read, reader, 1), "it runs, and says so"
            os.close(reader)
            for command in ("status", "tare", "stop"):
                assert (await asyncio.to_thread(send_command, address, {"command": command}, DEADLINE_S))["ok"]
            assert await process.wait() == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_a_stopped_terminal_delays_no_estimate(config: Write, tmp_path: Path, subscriber: Connect) -> None:
    terminal, its_end = pty.openpty()
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "shearloop", "run", str(config()), "--show", stdout=its_end, stderr=its_end
    )
    try:
        frames = subscriber(f"ipc://{tmp_path}/publish", "eit.estimate")
        health = subscriber(f"ipc://{tmp_path}/publish", "health")
        assert await asyncio.to_thread(next_message, health), "the subscription has arrived"
        play = ("--recording", str(recording(tmp_path, 300)), "--once", "--speed", "100")
        async with shearloop(
            *("emulate", "eit-kit", *play, "--link", str(tmp_path / "eit-right")), stdin=asyncio.subprocess.PIPE
        ):
            # A line for each would be 30 kB, of which the terminal takes 4 unread.
            received = await asyncio.to_thread(lambda: [next_message(frames) for _ in range(300)])
        assert [message["frame"] for message in received] == list(range(300))
        assert (await asyncio.to_thread(next_message, health))["tasks"]["shown"]["error"] == ""
        await stop_and_time(process, signal.SIGTERM)
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
        os.close(terminal)
        os.close(its_end)


async def test_a_load_cell_works_without_a_robot(config: Write, tmp_path: Path) -> None:
    link = str(tmp_path / "load-cell")
    # Lines of torques, of which no calibration is needed.
    async with running(config(load_cell={"device": {"path": "load-cell"}})) as daemon:
        torques = collector(daemon, "load.torque")
        async with shearloop(
            *("emulate", "hx711", "--paper-sketch", "--torque-nm", "0.08", "--speed", "20", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            assert (await torques.get())["torque_nm"] == pytest.approx(0.08, abs=0.005)
            address = f"ipc://{tmp_path}/commands"
            reply = await asyncio.to_thread(
                send_command, address, {"command": "tare", "source": "load_cell"}, DEADLINE_S
            )
            assert reply == {"ok": True, "tared": ["load_cell"]}
            while abs((await torques.get())["torque_nm"]) > 0.005:
                continue
            status = await asyncio.to_thread(send_command, address, {"command": "status"}, DEADLINE_S)
            assert status["tasks"]["load_cell"]["alive"]
