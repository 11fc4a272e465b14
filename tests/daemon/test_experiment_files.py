"""Experiments that a request names: bounded in place, kind, size and time, and read beside the event loop."""

import asyncio
import json
import os
import stat
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from shearloop.cli import command, main
from shearloop.daemon import experiment_files, operator_questions
from shearloop.daemon.commands import Commands
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.control.experiment_schema import MAX_ANGLES_IN_ALL, MAX_STEPS
from shearloop.daemon.control.grip import NO_GRIP, Grip
from shearloop.daemon.control.known_tool import AT_REST
from shearloop.daemon.errors import InvalidExperimentError
from shearloop.daemon.experiment_files import ExperimentFiles
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.messaging.command_server import MAX_CONCURRENT, CommandRefusedError
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.daemon.rig import Rig
from shearloop.daemon.rig_memory import NoMemory
from shearloop.daemon.sensing.sessions import torque_sources
from shearloop.daemon.torques import TorqueSource
from shearloop.errors import UserError
from shearloop.tools.check import read_experiment
from tests.fixtures.daemons import bound_handlers, deadline

SECRET = "host:5432:lab:ada:hunter2"  # noqa: S105 - the content that no reply may have
VALID = {"name": "one", "steps": [{"do": "wait", "wait_s": 1}]}


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def files_in(folder: Path) -> ExperimentFiles:
    """Return the experiments of a folder, for a rig with a fingertip that measures torque."""
    config = DaemonConfig.model_validate({"fingertips": {"right": {"device": {"path": "right"}}}})
    sources = {name: TorqueSource(name=name, period_s=0.5) for name in ("right", "combined")}
    return ExperimentFiles((folder,), config, sources, None, LoadedFiles(()))


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "experiments").mkdir()
    return tmp_path / "experiments"


async def refusal(folder: Path, path: Path) -> str:
    async with deadline("the file was not refused"):
        with pytest.raises(UserError) as refused:
            await files_in(folder).read(path)
    return str(refused.value)


async def test_an_experiment_in_a_folder_or_below_it_is_read_once(folder):
    (folder / "more").mkdir()
    path = write(folder / "more" / "one.yaml", VALID)
    found = await files_in(folder).read(path)
    assert (found.file.name, found.data) == ("one", path.read_bytes())


async def test_the_list_has_the_valid_experiments_of_the_folders_alone(folder):
    (folder / "more").mkdir()
    valid = write(folder / "more" / "one.yaml", VALID)
    write(folder / "rig.yaml", {"publish": "ipc:///tmp/x"})
    write(folder / "wrong.yaml", {"name": "wrong", "steps": [{"do": "wiat"}]})
    write(folder / "broken.yaml", "name: [")
    (folder / "link.yaml").symlink_to(write(folder.parent / "secret.yaml", VALID))
    assert (await files_in(folder).list()).names == {str(valid): "one"}


HOLD = [{"do": "grip"}, {"do": "identify"}, {"do": "hold_torque", "torque_nm": 0.05}]
RIG = {
    "robot": "ur.yaml",
    "load_cell": {"device": {"path": "load"}},
    "fingertips": {"right": {"device": {"path": "eit"}}},
}


@pytest.mark.parametrize(
    ("content", "gripper", "said"),
    [
        ({"torque_source": "combined", "steps": HOLD}, True, "`combined` is not a measured torque"),
        ({"torque_source": "skin", "steps": HOLD}, True, "`skin` is not a measured torque"),
        ({"torque_source": "right", "steps": HOLD}, True, "`right` is a fingertip without a calibration"),
        (
            {"torque_source": "load_cell", "steps": [*HOLD, {"do": "adapt", "fingertip": "right"}]},
            True,
            "no calibration",
        ),
        ({"torque_source": "load_cell", "steps": HOLD}, False, "grip needs a gripper, and none is configured"),
        ({"torque_source": "load_cell", "steps": HOLD}, True, ""),
    ],
)
async def test_the_list_has_only_what_start_accepts_on_this_rig(content, gripper, said, folder):
    path = write(folder / "one.yaml", {"name": "one", **content})
    more = {"gripper": {"model": "2F-85", "socket": {"host": "192.168.1.10"}}} if gripper else {}
    config = load_daemon_config(write(folder.parent / "rig.yaml", {**RIG, **more}))
    files = ExperimentFiles((folder,), config, torque_sources(config, {}, None), None, LoadedFiles(()))
    if not said:
        assert (await files.read(path)).file.name == "one"
    else:
        with pytest.raises(InvalidExperimentError, match=said):
            await files.read(path)
    assert (await files.list()).names == ({} if said else {str(path): "one"})


async def test_the_file_of_a_folder_that_was_probably_meant_is_named(folder):
    path = write(folder / "mine.yaml", VALID)
    write(folder.parent / "secret.yaml", VALID)
    for wrong in (folder.parent / "mine.yaml", folder / "mine2.yaml", folder / "more" / "mine.yaml"):
        assert f"; did you mean {path}?" in await refusal(folder, wrong)
    assert "did you mean" not in await refusal(folder, folder.parent / "secret2.yaml")
    # Nobody learns from the daemon which files there are elsewhere.
    there, absent = [await refusal(folder, folder.parent / name) for name in ("secret.yaml", "absent.yaml")]
    assert there.replace("secret", "absent") == absent


def linked(folder: Path) -> Path:
    (folder / "link.yaml").symlink_to(write(folder.parent / "secret", SECRET))
    return folder / "link.yaml"


@pytest.mark.parametrize(
    "place",
    [
        lambda folder: write(folder.parent / "secret", SECRET),
        lambda folder: folder / ".." / write(folder.parent / "secret", SECRET).name,
        linked,
        lambda _: Path("/etc/shadow"),
        lambda _: Path("/proc/kmsg"),
        lambda _: Path("one.yaml"),
    ],
)
async def test_a_file_elsewhere_is_not_read(place: Callable[[Path], Path], folder, monkeypatch):
    monkeypatch.setattr(experiment_files, "read_file", lambda *_: pytest.fail("it is read"))
    assert "is in none of the folders of experiments" in await refusal(folder, place(folder))


def fifo(folder: Path) -> Path:
    os.mkfifo(folder / "pipe")
    return folder / "pipe"


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (lambda folder: folder / "none.yaml", "No such file"),
        (lambda folder: folder, "it is a folder"),
        (fifo, "it is a device or a pipe"),
        (lambda folder: write(folder / "large.yaml", "#" * 200_000), "it is larger than 32 kB"),
        (lambda folder: folder / ("x" * 300), "File name too long"),
        (lambda folder: folder / "a\0b", "null"),
    ],
)
async def test_what_is_no_small_file_is_refused(place, why, folder):
    assert why in await refusal(folder, place(folder))


@pytest.mark.parametrize("path", ["/dev/zero", "/proc/kmsg", "/proc/self/environ"])
async def test_files_without_an_end_are_refused_also_in_a_configured_folder(path):
    assert path in await refusal(Path("/"), Path(path))


@pytest.mark.parametrize(
    "text", [SECRET, f"name: {SECRET}\n", f"{SECRET!r}: 1\n", f"steps: [{{do: {SECRET!r}}}]", f"\t{SECRET}", "*hunter2"]
)
async def test_a_reply_has_no_content_of_a_file(text, folder, log):
    said = await refusal(folder, write(folder / "one.yaml", text))
    assert said == f"{folder}/one.yaml is not a valid experiment; the daemon's log names each mistake"
    assert log.said == ["the experiment is not valid"]


async def test_the_first_mistake_of_an_experiment_is_told_to_its_sender(folder, log):
    """A page and a program of one's own have no log."""
    text = "name: one\nsteps:\n  - {do: release}\n  - {do: wait, wait_s: -1}\n  - {do: twst}\n"
    said = await refusal(folder, write(folder / "one.yaml", text))
    assert said.startswith(f"{folder}/one.yaml:4: steps[1].wait_s: -1 is too small")
    assert said.endswith("(and 1 more mistake: see the daemon's log)")
    assert log.said == ["the experiment is not valid"]


async def test_the_event_loop_goes_on_while_a_large_file_is_read(folder):
    steps = [{"do": "wait", "wait_s": number % 7 + 0.5} for number in range(MAX_STEPS)]
    files, beats = files_in(folder), 0
    reading = asyncio.create_task(files.read(write(folder / "large.yaml", {**VALID, "steps": steps})))
    while not reading.done():
        await asyncio.sleep(0)
        beats += 1
    assert len(reading.result().file.steps) == MAX_STEPS
    assert beats > 10


class SlowDrive:
    """A drive that is asked for a file and answers only when the test lets it."""

    def __init__(self) -> None:
        self.asked, self.answers = threading.Event(), threading.Event()
        self.read: list[Path] = []
        self._read = experiment_files.read_file

    def read_file(self, path: Path, most_bytes: int) -> bytes:
        self.asked.set()
        self.answers.wait()
        self.read.append(path)
        return self._read(path, most_bytes)


@pytest.fixture
def slow_drive(monkeypatch):
    drive = SlowDrive()
    monkeypatch.setattr(experiment_files, "read_file", drive.read_file)
    yield drive
    drive.answers.set()


async def end_of_reading() -> None:
    """Wait until no thread reads an experiment."""
    for thread in threading.enumerate():
        if thread.name == "experiment":
            await asyncio.to_thread(thread.join)


async def test_a_drive_that_does_not_answer_ends_the_start_and_keeps_one_thread(folder, slow_drive, monkeypatch):
    monkeypatch.setattr(experiment_files, "READ_WITHIN_S", 0.05)
    files, path = files_in(folder), write(folder / "one.yaml", VALID)
    with pytest.raises(UserError, match=r"was not read within 0\.05 s"):
        await files.read(path)
    for _ in range(16):
        with pytest.raises(UserError, match="the file of another request is being read"):
            await files.read(path)
    slow_drive.answers.set()
    async with deadline("the first reading did not end"):
        await end_of_reading()
    monkeypatch.undo()
    assert (await files.read(path)).file.name == "one"


class Runner:
    """Knows why nothing can start, and counts stops; keeps what was started with how many stops before it."""

    def __init__(self, refusal: str | None = None) -> None:
        self.refusal = refusal
        self.unconfirmed_refusal: str | None = None
        self.stop_count = 0
        self.started: list[tuple[str, int]] = []

    def start_refusal(self) -> str | None:
        return self.refusal

    def motion(self) -> str | None:
        return self.refusal

    def stood_s(self) -> float:
        return 0.0

    def refusal_of(self, _file: Any, *, confirmed: bool) -> str | None:
        return None if confirmed else self.unconfirmed_refusal

    async def start(self, file: Any, stops_before: int, _deadline: Deadline, *, confirmed: bool) -> None:
        self.started.append((file.name, stops_before))
        self.confirmed = confirmed


def rig(folder: Path, runner: Runner, instance: str = "a1") -> Rig:
    return Rig(
        SimpleNamespace(
            warm_up_s=0.0,
            runs=1,
            safety=SimpleNamespace(acknowledgements=0),
            operator=SimpleNamespace(
                inputs=SimpleNamespace(gripper=None),
                tool=SimpleNamespace(
                    has_gripper=True, may_hold=lambda: False, activates=False, held=None, unknown_grip="", grip=NO_GRIP
                ),
                known_tool=lambda: AT_REST,
                drop_sentence=lambda _: "",
                why_no_source=lambda _: None,
                why_not_begun=lambda _: None,
            ),
        ),
        runner,
        {},
        files_in(folder),
        None,
        instance,
        NoMemory(),
        SimpleNamespace(),
    )


async def test_a_state_that_cannot_be_kept_refuses_every_start_before_its_question(folder):
    one = rig(folder, Runner())
    assert one.start_refusal() is None
    one.memory = SimpleNamespace(error="the disk is full")
    assert one.start_refusal() == "the disk is full"
    with pytest.raises(CommandRefusedError, match="the disk is full"):
        await answers_of(one)["start"]({"experiment": str(write(folder / "one.yaml", VALID)), "ask": True})


class Noted(NoMemory):
    """Notes the experiments that begin."""

    def __init__(self) -> None:
        self.noted: list[str] = []

    async def begins(self, experiment: str) -> None:
        self.noted.append(experiment)


async def test_a_question_loads_no_module_after_an_upgrade_in_place(folder, monkeypatch):
    one = rig(folder, Runner())
    changed = folder / "module.py"
    changed.write_text("VERSION = 1\n")
    one.experiments.loaded = LoadedFiles([changed])
    changed.write_text("VERSION = 2\n")
    # An import of it fails.
    monkeypatch.setitem(sys.modules, "shearloop.daemon.operator_questions", None)
    with pytest.raises(CommandRefusedError, match=r"module\.py has changed since the daemon began"):
        await answers_of(one)["start"]({"experiment": str(write(folder / "one.yaml", VALID)), "ask": True})


async def test_an_experiment_that_is_refused_is_not_kept_as_the_one_that_runs(folder):
    """A daemon that is killed then would leave a stop of an experiment that had never begun."""
    runner, path = Runner(), write(folder / "one.yaml", VALID)
    one, runner.unconfirmed_refusal = rig(folder, runner), "a tool drops"
    one.memory = memory = Noted()
    assert await one.start(path) == "a tool drops"
    assert (memory.noted, runner.started) == ([], [])
    assert await one.start(path, confirmed=True) is None
    assert memory.noted == ["one"]
    assert len(runner.started) == 1


async def test_no_file_is_read_while_none_can_start(folder, monkeypatch):
    monkeypatch.setattr(experiment_files, "read_file", lambda *_: pytest.fail("it is read"))
    path = write(folder / "one.yaml", VALID)
    assert await rig(folder, Runner("the experiment 'two' is still running")).start(path) is not None


async def test_no_file_is_read_for_a_question_or_the_list_while_something_moves(folder, monkeypatch):
    """A thread that parses holds up the loop, and a loop that is late stops the experiment that runs."""
    path, runner = write(folder / "one.yaml", VALID), Runner()
    idle, subject = rig(folder, Runner()), rig(folder, runner)
    known = await answers_of(subject)["experiments"]({})
    assert [one["name"] for one in known["experiments"]] == ["one"]
    write(folder / "two.yaml", {**VALID, "name": "two"})
    runner.refusal = idle.runner.refusal = "the experiment 'three' is running"
    monkeypatch.setattr(experiment_files, "read_file", lambda *_: pytest.fail("it is read"))
    monkeypatch.setattr(ExperimentFiles, "_stamps", lambda _: pytest.fail("the folders are read"))
    with pytest.raises(CommandRefusedError, match="'three' is running"):
        await answers_of(subject)["start"]({"experiment": str(path), "ask": True})
    # A page that opens meanwhile has the list that was read before.
    assert await answers_of(subject)["experiments"]({}) == known
    # Without one it says why, which is no refusal: a page asks by itself.
    without = await answers_of(idle)["experiments"]({})
    assert without["experiments"] == []
    assert without["unread"] == "the experiment 'three' is running; the folders are read afterwards"


async def test_no_file_is_read_for_a_question_or_the_list_while_another_starts(folder, slow_drive):
    """It begins to move as soon as its own file is read and the arm is enabled."""
    path, subject = write(folder / "one.yaml", VALID), rig(folder, Runner())
    starting = asyncio.create_task(subject.start(path))
    await asyncio.to_thread(slow_drive.asked.wait)
    expected = "one.yaml is being started; wait until it has begun, or stop it"
    for request in ({"experiment": str(path)}, {"experiment": str(path), "ask": True}):
        with pytest.raises(CommandRefusedError, match=expected):
            await answers_of(subject)["start"](request)
    assert expected in (await answers_of(subject)["experiments"]({}))["unread"]
    assert subject.tare_refusal(confirmed=True) == expected
    slow_drive.answers.set()
    assert await starting is None
    assert subject.start_refusal() is None


async def test_a_start_whose_file_comes_too_late_begins_nothing(folder, slow_drive):
    path, runner, now_ns = write(folder / "one.yaml", VALID), Runner(), 0
    subject = rig(folder, runner)
    commands = Commands(subject, None, None, None, asyncio.Event(), None, now_ns=lambda: now_ns)
    request = {"experiment": str(path), "until_ns": 2_000_000_000}
    starting = asyncio.create_task(bound_handlers(commands)["start"](request))
    await asyncio.to_thread(slow_drive.asked.wait)
    now_ns = 3_500_000_000
    slow_drive.answers.set()
    said = (
        r"reading its file took 3\.5 s, and the request had expired 1\.5 s before; copy the file to a local drive, or"
    )
    with pytest.raises(CommandRefusedError, match=said):
        await starting
    assert runner.started == []
    assert (await bound_handlers(commands)["start"]({**request, "until_ns": now_ns}))["run"] == 1
    assert runner.started == [("one", 0)]


async def test_a_start_does_not_wait_for_a_long_list(folder, slow_drive):
    paths = [write(folder / f"{number}.yaml", VALID) for number in range(20)]
    subject = rig(folder, Runner())
    listing = asyncio.create_task(subject.experiments.list(subject.reading_refusal))
    await asyncio.to_thread(slow_drive.asked.wait)
    starting = asyncio.create_task(subject.start(paths[-1]))
    await asyncio.sleep(0)
    slow_drive.answers.set()
    assert await starting is None
    assert "is being started" in (await listing).unread
    assert slow_drive.read == [paths[0], paths[-1]]


async def test_a_file_is_read_for_the_list_only_after_a_change(folder, slow_drive):
    slow_drive.answers.set()
    files, path = files_in(folder), write(folder / "one.yaml", VALID)
    wrong = write(folder / "wrong.yaml", "name: [")
    for _ in range(3):
        assert (await files.list()).names == {str(path): "one"}
    assert slow_drive.read == [path, wrong]
    write(path, {**VALID, "name": "another"})
    assert (await files.list()).names == {str(path): "another"}
    path.unlink()
    assert (await files.list()).names == {}
    assert slow_drive.read == [path, wrong, path]


async def test_a_file_that_becomes_readable_is_listed(folder, monkeypatch):
    """Its content and its time stay. The rights do not hold for root, who may run the tests."""
    read = experiment_files.read_file

    def read_if_allowed(path: Path, limit: int) -> bytes:
        if not path.stat().st_mode & stat.S_IRUSR:
            raise PermissionError
        return read(path, limit)

    monkeypatch.setattr(experiment_files, "read_file", read_if_allowed)
    files, path = files_in(folder), write(folder / "one.yaml", VALID)
    path.chmod(0)
    assert (await files.list()).names == {}
    path.chmod(0o644)
    assert (await files.list()).names == {str(path): "one"}


async def test_as_many_requests_wait_for_a_file_as_leave_room_for_others(folder, slow_drive):
    files, path = files_in(folder), write(folder / "one.yaml", VALID)
    reading = [asyncio.create_task(files.read(path)) for _ in range(MAX_CONCURRENT)]
    await asyncio.to_thread(slow_drive.asked.wait)
    slow_drive.answers.set()
    replies = await asyncio.gather(*reading, return_exceptions=True)
    refused = [one for one in replies if isinstance(one, UserError)]
    assert all("the file of another request is being read" in str(one) for one in refused)
    assert 1 < len(replies) - len(refused) <= MAX_CONCURRENT // 2


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([{"do": "wait", "wait_s": 1}] * (MAX_STEPS + 1), f"at most {MAX_STEPS}"),
        ([{"do": "twist", "angles_rad": "0:1:1000"}] * 5, f"5000 angles in all, .* at most {MAX_ANGLES_IN_ALL}"),
        ([{"do": "twist", "angles_rad": [0.1] * (MAX_ANGLES_IN_ALL + 1)}], f"at most {MAX_ANGLES_IN_ALL}"),
    ],
)
def test_an_experiment_whose_plan_would_take_long_is_refused(steps, said, folder):
    path = folder / "long.yaml"
    path.write_text(json.dumps({"name": "long", "steps": steps}, separators=(", ", ": ")))
    with pytest.raises(UserError, match=said):
        read_experiment(path)


def answers_of(subject: Rig) -> Any:
    return bound_handlers(Commands(subject, None, None, None, asyncio.Event(), None))


async def test_what_a_person_confirmed_is_what_starts(folder, monkeypatch):
    """The file is replaced between the question and its answer, by another or by what the question showed."""
    runner, path = Runner(), write(folder / "one.yaml", VALID)
    subject = rig(folder, runner)
    start = bound_handlers(Commands(subject, None, None, None, asyncio.Event(), None))["start"]
    asked = await start({"experiment": str(path), "ask": True})
    assert asked["question"].startswith("Start 'one'?")
    before = path.read_bytes()
    # The same name and the same sentences: only the bytes differ.
    for other in (before + b"# faster\n", write(path, {**VALID, "name": "two"}).read_bytes()):
        path.write_bytes(other)
        with pytest.raises(CommandRefusedError, match="since its plan was shown, the file or the effect") as refused:
            await start({"experiment": str(path), "digest": asked["digest"]})
        assert refused.value.facts == await start({"experiment": str(path), "ask": True})
    assert runner.started == []
    await start({"experiment": str(path), "digest": refused.value.facts["digest"]})
    path.write_bytes(before)
    monkeypatch.setattr(operator_questions, "activation_note", lambda *_: " Before step 1 the gripper is activated.")
    with pytest.raises(CommandRefusedError, match="the effect of its start on a held tool has changed"):
        await start({"experiment": str(path), "digest": asked["digest"]})
    monkeypatch.undo()
    operator = subject.control_loop.operator
    operator.tool.may_hold, operator.tool.grip = lambda: True, Grip(0.3, 20.0)
    asked_again = await start({"experiment": str(path), "ask": True})
    operator.tool.grip = Grip(0.6, 20.0)
    with pytest.raises(CommandRefusedError, match="a held tool"):
        await start({"experiment": str(path), "digest": asked_again["digest"]})
    operator.tool.may_hold = lambda: False
    # Somebody has pressed STOP since.
    runner.stop_count = 1
    with pytest.raises(CommandRefusedError, match="since its plan was shown, the file or the effect"):
        await start({"experiment": str(path), "digest": asked["digest"]})
    runner.stop_count = 0
    after_restart = answers_of(rig(folder, runner, instance="b2"))["start"]
    with pytest.raises(CommandRefusedError, match="since its plan was shown, the file or the effect"):
        await after_restart({"experiment": str(path), "digest": asked["digest"]})
    await start({"experiment": str(path), "digest": asked["digest"], "confirmed": True})
    assert runner.confirmed
    # Who asks nothing names the file as it is.
    await start({"experiment": str(path)})
    assert not runner.confirmed
    assert [name for name, _ in runner.started] == ["two", "one", "one"]


async def test_a_stop_while_the_file_is_read_counts_for_the_start(folder, slow_drive):
    runner = Runner()
    starting = asyncio.create_task(rig(folder, runner).start(write(folder / "one.yaml", VALID)))
    await asyncio.to_thread(slow_drive.asked.wait)
    runner.stop_count += 1
    slow_drive.answers.set()
    await starting
    assert runner.started == [("one", 0)]


def test_the_folder_of_the_configuration_is_the_default(tmp_path):
    content = {"fingertips": {"right": {"device": {"path": "a"}}}, "robot": "ur.yaml"}
    for more, folders in (
        ({}, ["."]),
        ({"experiments": ["one", "/two"]}, ["one", "/two"]),
        ({"experiment": "three/tighten.yaml"}, [".", "three"]),
    ):
        config = load_daemon_config(write(tmp_path / "rig.yaml", {**content, **more}))
        assert config.experiment_folders == tuple(tmp_path / folder for folder in folders)


def test_the_mistakes_are_shown_to_the_person_whose_file_it_is(tmp_path, monkeypatch, capsys):
    reply = {"ok": False, "reason": "one.yaml is not a valid experiment", "invalid": True}
    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", lambda *_: reply)
    path = write(tmp_path / "one.yaml", {**VALID, "speed": 3})
    assert main(["command", "start", "--experiment", str(path)]) == 1
    assert "one.yaml:2: speed: is not a known key" in capsys.readouterr().err
    assert main(["command", "start", "--experiment", str(tmp_path / "two.yaml")]) == 1
    assert (
        f"start was refused: there is no file {tmp_path}/two.yaml on this computer; one.yaml is not"
        in capsys.readouterr().err
    )
    assert command.mistakes_of(tmp_path / "elsewhere.yaml").startswith(str(tmp_path))
