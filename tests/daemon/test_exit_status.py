"""How a daemon ends that was to end with its experiment, and what one does that is started again after a crash."""

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from shearloop.daemon.configured_experiment import ConfiguredExperiment, CrashMarker
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.errors import UserError
from tests.daemon.conftest import deadline, robot_at, running_daemon, shearloop
from tests.emulator_process import own_address

Write = Callable[..., Path]
LEFT_TO_OPERATOR = "it starts by `shearloop command start` only"


@pytest.fixture
def waiting_config(ur_rtde, config, tmp_path) -> Path:  # noqa: ARG001 - it skips
    """Write a configuration whose experiment waits for a robot that there is none of."""
    robot_at(own_address(6), tmp_path)
    steps = {"name": "test", "torque_source": "wrench", "steps": [{"do": "wait", "wait_s": 1}]}
    (tmp_path / "experiment.yaml").write_text(yaml.safe_dump(steps))
    return config(robot="ur.yaml", experiment="experiment.yaml", stop_when_done=True)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 3), (signal.SIGHUP, 0)])
async def test_an_unfinished_experiment_sets_the_exit_status(number, status, waiting_config):
    async with shearloop("run", str(waiting_config)) as daemon:
        while b"waiting to start" not in (line := await daemon.stderr.readline()):
            assert line, "the daemon ended before its experiment waited to start"
        daemon.send_signal(number)
        assert await daemon.wait() == status


async def done_experiment() -> SimpleNamespace:
    return SimpleNamespace(phase=ExperimentPhase.DONE, stop_reason="")


RUNNER = SimpleNamespace(experiment_ended=done_experiment)


async def test_no_experiment_starts_automatically_after_a_crash(waiting_config, tmp_path, monkeypatch, log):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    crashed = CrashMarker()
    assert not crashed.left_behind
    crashed.set()
    async with running_daemon(waiting_config) as daemon:
        await log.says(LEFT_TO_OPERATOR)
    assert not daemon.finished
    assert any("crashed after it had started an experiment" in one for one in log.said)
    assert not CrashMarker().left_behind, "this one ended in good order"


@pytest.mark.parametrize(("own", "finished"), [(True, True), (False, False)])
async def test_a_manual_start_cancels_the_waiting_experiment(own, finished, waiting_config, tmp_path, log):
    """Neither by the same one again, nor by the configured one after another."""
    ready, begun = asyncio.Event(), []

    async def start(path: Path) -> str | None:
        if not ready.is_set():
            return "the gripper is not ready"
        begun.append(path)
        return None

    async with running_daemon(waiting_config) as daemon:
        daemon._rig.start = start
        daemon._rig.runner.experiment_ended = done_experiment
        await log.says("waiting to start")
        ready.set()
        path = tmp_path / ("experiment.yaml" if own else "another.yaml")
        await daemon.commands.handlers()["start"]({"experiment": path})
        if not own:
            await log.says(LEFT_TO_OPERATOR)
            daemon.stop()
        await daemon._end.wait()
    assert begun == [path]
    assert daemon.finished is finished


@pytest.mark.parametrize("crashed", [False, True], ids=["called off", "after a crash"])
async def test_a_manually_started_experiment_is_followed_to_its_end(crashed, tmp_path, monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    if crashed:
        CrashMarker().set()
    path = tmp_path / "experiment.yaml"

    async def not_yet(_path: Path) -> str | None:
        experiment.call_off()
        return "the gripper is not ready"

    experiment = ConfiguredExperiment(path, SimpleNamespace(start=not_yet, runner=RUNNER))
    async with deadline("the experiment was not seen to its end"), asyncio.TaskGroup() as group:
        await experiment.run()
        assert not experiment.has_begun.is_set()
        running = group.create_task(experiment.wait_for_end())
        experiment.on_begun(tmp_path / "another.yaml")
        await asyncio.sleep(0)
        assert not running.done()
        experiment.on_begun(path)
    assert experiment.done


@pytest.mark.parametrize("by", ["stop", "another"])
async def test_a_cancelled_experiment_stays_cancelled_after_a_crash_of_its_task(by, tmp_path):
    """An experiment file may be spoilt when it is to begin, and mended after somebody has said stop."""
    begun = []

    async def begin(path: Path) -> str | None:
        if begun:
            return None
        begun.append(path)
        raise UserError("the file is none")

    experiment = ConfiguredExperiment(tmp_path / "experiment.yaml", SimpleNamespace(start=begin, runner=RUNNER))
    with pytest.raises(UserError):
        await experiment.run()
    if by == "stop":
        assert experiment.call_off() == experiment.path
    else:
        experiment.on_begun(tmp_path / "another.yaml")
    await experiment.run()
    assert not experiment.has_begun.is_set()


def test_no_crash_marker_without_a_service_manager(monkeypatch):
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    mark = CrashMarker()
    mark.set()
    mark.clear()
    assert not CrashMarker().left_behind


def test_a_failing_crash_marker_is_reported(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "nowhere"))
    CrashMarker().set()
    assert "cannot write the crash marker" in capsys.readouterr().out
