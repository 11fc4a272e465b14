"""A daemon as it runs, how it ends that was to end with its experiment, and what one does after a crash."""

import asyncio
import itertools
import os
import pty
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
import zmq
import zmq.asyncio

from shearloop.daemon.configured_experiment import ConfiguredExperiment
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.messaging.messages import decode
from shearloop.errors import UserError
from shearloop.estimation import Session
from tests.emulator_process import own_address
from tests.fixtures.daemons import (
    DEADLINE_S,
    ask,
    bound_handlers,
    collector,
    deadline,
    emulated_kit,
    of_now,
    played_at,
    recording,
    robot_at,
    running_daemon,
    shearloop,
)


def next_message(socket: "zmq.Socket[bytes]") -> dict[str, Any]:
    _, payload = socket.recv_multipart()
    return decode(payload)


@pytest.mark.long
async def test_every_frame_at_100_times_speed_becomes_an_estimate_in_order(shared, config, tmp_path, subscriber):
    play = shared / "recordings" / "streams" / "2024-12-03_16-09" / "device1.mat"
    async with shearloop("run", str(config(right=played_at(100)))) as daemon:
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
    # Far longer than it takes: the machine may be busy with other tests.
    assert time.monotonic() - begun < 5


@pytest.mark.usefixtures("default_signals")
async def test_the_daemon_and_its_emulators_stop_cleanly_and_say_so(config, tmp_path, subscriber):
    link = tmp_path / "eit-right"
    emulator = {"device": "eit-kit", "arguments": ["--link", str(link), "--recording", str(recording(tmp_path, 20)[0])]}
    async with shearloop("run", str(config(emulators=[emulator])), "--show") as daemon:
        messages = subscriber(f"ipc://{tmp_path}/publish", "")
        while "channels" not in (content := await asyncio.to_thread(next_message, messages)):
            continue
        assert content["channels"].shape == (896,)
        await stop_and_time(daemon, signal.SIGINT)
        while (content := await asyncio.to_thread(next_message, messages)).get("finished") is None:
            continue
        assert (content["source"], content["finished"], content["summary"]) == ("daemon", True, "")
        log = (await daemon.stderr.read()).decode()
        assert "warning" not in log, "the emulated devices were awaited"
        assert not link.is_symlink(), "the emulator has taken its port away"


async def test_tare_status_and_stop_commands(config, tmp_path):
    async with running_daemon(config(right=played_at(20))) as daemon:
        estimates = collector(daemon, "eit.estimate")
        async with emulated_kit(tmp_path, 60):
            while not (await estimates.get())["valid"]:
                continue
            # The played tool may be twisted at this moment.
            assert await ask(daemon, "tare", confirmed=True) == {"ok": True, "taring": ["right"]}
            while "taking the idle frame, 1 of 10" not in (await estimates.get())["reason"]:
                continue
            reply = await ask(daemon, "tare", source="left")
            assert reply == {"ok": False, "reason": "there is no sensor 'left' to tare; there are right"}
            status = await ask(daemon, "status")
            assert status["tasks"]["right"]["connected"]
            assert status["tasks"]["commands"]["errors"] == {"tare refused": 1}
        assert (await ask(daemon, "stop", **of_now()))["ok"]
        await daemon.ending.wait()


async def test_a_heatmap_is_computed_only_with_a_subscriber(config, tmp_path, subscriber):
    async with running_daemon(config(right=played_at(20))) as daemon:
        estimates, heatmaps = collector(daemon, "eit.estimate"), collector(daemon, "eit.heatmap")
        async with emulated_kit(tmp_path, 60):
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
def robotless(ur_rtde, config, tmp_path) -> Path:  # noqa: ARG001 - it skips
    """Write a configuration with an experiment, and with a robot that is not there."""
    robot_at(own_address(7), tmp_path)
    rig = {
        "robot": "ur.yaml",
        "gripper": {"model": "2F-140", "socket": {"host": own_address(7)}},
        "load_cell": {"device": {"path": "load"}},
    }
    experiment = str(Path("config/experiments/loosen.yaml").resolve())
    return config(**rig, experiment=experiment, emulated=True, autostart=True)


async def test_stop_cancels_a_waiting_experiment_and_keeps_the_daemon(robotless):
    async with running_daemon(robotless) as daemon:
        health = collector(daemon, "health")
        while not (await health.get())["tasks"]["experiment"]["alive"]:
            continue
        reply = await ask(daemon, "stop", spare_daemon=True)
        assert reply["stopped"] == "the start of loosen.yaml"
        assert (await ask(daemon, "stop", spare_daemon=True))["stopped"] == ""
        refused = await ask(daemon, "start")
        assert "Send `shearloop command unlock` before the next start." in refused["reason"]


@pytest.mark.long
async def test_a_crashed_estimator_restarts_and_is_reported(config, tmp_path, monkeypatch):
    estimate, frames = Session.estimate, itertools.count()

    def fragile(self: Session, frame: Any) -> Any:
        if next(frames) == 3:
            raise RuntimeError("a bug")
        return estimate(self, frame)

    monkeypatch.setattr(Session, "estimate", fragile)
    async with running_daemon(config(right=played_at(4))) as daemon:
        estimates = collector(daemon, "eit.estimate")
        # The task starts again within the time of a frame at this pace.
        async with emulated_kit(tmp_path, 40, "--speed", "4"):
            seen = [(await estimates.get())["frame"] for _ in range(8)]
    assert seen == [0, 1, 2, 4, 5, 6, 7, 8], "frames continue after the one that killed it"
    record = daemon.supervisor.records["right"]
    assert (record.restarts, record.last_error) == (1, "RuntimeError: a bug")


async def test_the_daemon_survives_a_closed_log(config, tmp_path):
    address = f"ipc://{tmp_path}/commands"
    reader, writer = os.pipe()
    async with shearloop("run", str(config()), stderr=writer) as daemon:
        os.close(writer)
        assert await asyncio.to_thread(os.read, reader, 1), "it runs, and says so"
        os.close(reader)
        # The log has a line for a refused tare.
        for command, given, carried_out in (("status", {}, True), ("tare", {}, False), ("stop", of_now(), True)):
            reply = await asyncio.to_thread(send_command, address, {"command": command, **given}, DEADLINE_S)
            assert reply["ok"] is carried_out
        assert await daemon.wait() == 0


@pytest.mark.long
async def test_a_stopped_terminal_delays_no_estimate(config, tmp_path, subscriber):
    terminal, its_end = pty.openpty()
    async with shearloop("run", str(config(right=played_at(100))), "--show", stdout=its_end, stderr=its_end) as daemon:
        frames = subscriber(f"ipc://{tmp_path}/publish", "eit.estimate")
        health = subscriber(f"ipc://{tmp_path}/publish", "health")
        assert await asyncio.to_thread(next_message, health), "the subscription has arrived"
        async with emulated_kit(tmp_path, 300, "--once", "--speed", "100"):
            # A line for each would be 30 kB, of which the terminal takes 4 unread.
            received = await asyncio.to_thread(lambda: [next_message(frames) for _ in range(300)])
        assert [message["frame"] for message in received] == list(range(300))
        await stop_and_time(daemon, signal.SIGTERM)
    os.close(terminal)
    os.close(its_end)


async def test_a_load_cell_works_without_a_robot(config, tmp_path):
    link = str(tmp_path / "load-cell")
    # Lines of torques, of which no calibration is needed.
    async with running_daemon(config(load_cell={"device": {"path": "load-cell"}})) as daemon:
        torques = collector(daemon, "load.torque")
        async with shearloop(
            *("emulate", "hx711", "--paper-sketch", "--torque-nm", "0.08", "--speed", "20", "--link", link),
            stdin=asyncio.subprocess.PIPE,
        ):
            assert (await torques.get())["torque_nm"] == pytest.approx(0.08, abs=0.005)
            while not (await torques.get())["valid"]:
                continue
            refused = await ask(daemon, "tare", source="load_cell")
            assert re.match(r"load_cell measures \+0\.0[78]\d N·m, which would become the zero; ", refused["reason"])
            absent = await ask(daemon, "tare", source="right", confirmed=True)
            assert absent["reason"] == "not connected: right; connect it, then send the tare again"
            reply = await ask(daemon, "tare", confirmed=True)
            assert (reply["taring"], reply["not_connected"]) == (["load_cell"], ["right"])
            while abs((await torques.get())["torque_nm"]) > 0.005:
                continue
            assert (await ask(daemon, "status"))["tasks"]["load_cell"]["alive"]


Write = Callable[..., Path]
LEFT_TO_OPERATOR = "it starts by `shearloop command start` only"


@pytest.fixture
def waiting_config(ur_rtde, config, tmp_path) -> Path:  # noqa: ARG001 - it skips
    """Write a configuration whose experiment waits for a robot that there is none of."""
    robot_at(own_address(6), tmp_path)
    steps = {"name": "test", "torque_source": "wrench", "steps": [{"do": "wait", "wait_s": 1}]}
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(steps))
    return config(robot="ur.yaml", experiment="experiment.yaml", emulated=True, autostart=True, stop_when_done=True)


@pytest.mark.long
@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 4), (signal.SIGHUP, 0)])
async def test_an_unfinished_experiment_sets_the_exit_status(number, status, waiting_config):
    async with shearloop("run", str(waiting_config)) as daemon:
        while b"waiting to start" not in (line := await daemon.stderr.readline()):
            assert line, "the daemon ended before its experiment waited to start"
        daemon.send_signal(number)
        assert await daemon.wait() == status


async def done_experiment() -> SimpleNamespace:
    return SimpleNamespace(phase=ExperimentPhase.DONE, stop_reason="")


RUNNER = SimpleNamespace(experiment_ended=done_experiment)


async def test_a_configured_experiment_waits_for_the_operator(waiting_config, log):
    """Whatever connects, and whoever restarts the daemon: only `autostart` starts it without a command."""
    content = {**yaml.safe_load(waiting_config.read_text()), "autostart": False}
    waiting_config.write_text(yaml.safe_dump(content))
    begun: list[Path] = []
    answered = asyncio.Event()

    async def start(path: Path, *_: object, confirmed: bool) -> str | None:  # noqa: ARG001 - autostart confirms
        begun.append(path)
        return None

    async def ended() -> SimpleNamespace:
        # The daemon ends with its experiment, and has to answer before.
        await answered.wait()
        return await done_experiment()

    async with running_daemon(waiting_config) as daemon:
        daemon.rig.start = start
        daemon.rig.runner.experiment_ended = ended
        await log.says(LEFT_TO_OPERATOR)
        health = collector(daemon, "health")
        assert (await health.get())["tasks"]["experiment"]["alive"]
        assert begun == []
        assert (await ask(daemon, "start"))["ok"]
        answered.set()
        await daemon.ending.wait()
    assert [path.name for path in begun] == ["experiment.yaml"]
    assert daemon.finished


@pytest.mark.parametrize(("own", "finished"), [(True, True), (False, False)])
async def test_a_manual_start_cancels_the_waiting_experiment(own, finished, waiting_config, tmp_path, log):
    """Neither by the same one again, nor by the configured one after another."""
    ready, begun = asyncio.Event(), []

    async def start(path: Path, *_: object, confirmed: bool) -> str | None:  # noqa: ARG001 - autostart confirms
        if not ready.is_set():
            return "the gripper is not ready"
        begun.append(path)
        return None

    async with running_daemon(waiting_config) as daemon:
        daemon.rig.start = start
        daemon.rig.runner.experiment_ended = done_experiment
        await log.says("waiting to start")
        ready.set()
        path = tmp_path / ("experiment.yaml" if own else "another.yaml")
        await bound_handlers(daemon.commands)["start"]({"experiment": str(path)})
        if not own:
            await log.says(LEFT_TO_OPERATOR)
            daemon.stop()
        await daemon.ending.wait()
    assert begun == [path]
    assert daemon.finished is finished


@pytest.mark.parametrize("autostart", [False, True])
async def test_a_manually_started_experiment_is_followed_to_its_end(autostart, tmp_path):
    path = tmp_path / "experiment.yaml"

    async def not_yet(_path: Path, *, confirmed: bool) -> str | None:  # noqa: ARG001 - autostart confirms
        experiment.call_off()
        return "the gripper is not ready"

    rig = SimpleNamespace(start=not_yet, runner=RUNNER)
    experiment = ConfiguredExperiment(path, rig, autostart=autostart)
    async with deadline("the experiment was not seen to its end"), asyncio.TaskGroup() as group:
        running = group.create_task(experiment.run())
        await asyncio.sleep(0)
        experiment.on_begun(tmp_path / "another.yaml")
        await asyncio.sleep(0)
        assert not running.done()
        experiment.on_begun(path)
    assert experiment.done


@pytest.mark.parametrize("by", ["stop", "another"])
async def test_a_cancelled_experiment_stays_cancelled_after_a_crash_of_its_task(by, tmp_path):
    """An experiment file may be spoilt when it is to begin, and mended after somebody has said stop."""
    begun = []

    async def begin(path: Path, *, confirmed: bool) -> str | None:
        assert confirmed, "it starts by itself on emulated rigs alone"
        if begun:
            return None
        begun.append(path)
        raise UserError("the file is none")

    rig = SimpleNamespace(start=begin, runner=RUNNER)
    experiment = ConfiguredExperiment(tmp_path / "experiment.yaml", rig, autostart=True)
    with pytest.raises(UserError):
        await experiment.run()
    if by == "stop":
        assert experiment.call_off() == experiment.path
    else:
        experiment.on_begun(tmp_path / "another.yaml")
    async with asyncio.TaskGroup() as group:
        running = group.create_task(experiment.run())
        await asyncio.sleep(0)
        running.cancel()
    assert not experiment.has_begun.is_set()
