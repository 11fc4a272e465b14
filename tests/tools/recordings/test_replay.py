import asyncio
import contextlib
import json
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zmq.asyncio
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter

from shearloop.daemon.app import Daemon
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.messaging.messages import EitEstimate, EitHeatmap, wire_map, with_packed_arrays
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recorder.recorder import Recorder, daemon_identity
from shearloop.daemon.recorder.schema import CONFIGURATION, message_json, recorded_topic
from shearloop.daemon.sensing.fingertip_task import FingertipTask
from shearloop.daemon.sensors import open_sessions
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.emulators.boards import format_line
from shearloop.estimation import Calibration, Measured, Session
from shearloop.estimation.session import FINGERS_MOVED
from shearloop.tools.recordings import replay
from shearloop.tools.recordings.matlab_import import import_mat
from shearloop.tools.recordings.message_content import read_content
from shearloop.tools.recordings.replay import (
    RecordedEvent,
    RecordedRun,
    Replay,
    ReplayClock,
    ReplayComparison,
    ReplayPace,
)
from tests.daemon.recorder.test_recorder import frame as one_frame
from tests.fixtures.daemons import ask, emulated_kit, played_at, recording, running_daemon
from tests.sample_messages import sample

Messages = list[tuple[str, dict[str, Any]]]
# Of the real recording's estimates with the tests' bank: what they were when it was last looked at with care.
REFERENCE = Path(__file__).parents[2] / "data" / "replayed_stream.json"
RELATIVE = 1e-9
PLAYED = played_at(20)


class Gripper:
    """Holds a tool while the number of estimates is within a range, and says nothing of it else."""

    is_holding = False
    # The numbers of estimates from frames during which the fingers moved.
    moves: Collection[int] = ()

    def __init__(self, estimates: FingertipTask, tool: Measured, held: range) -> None:
        self._estimates, self._tool, self._held = estimates, tool, held
        self.diameters = FingertipDiameters("combined", {})

    def moved_between(self, _from_ns: int, _to_ns: int) -> bool:
        return self._estimates.count in self.moves

    def held_tool(self, _t_ns: int) -> Measured | None:
        return self._tool if self._estimates.count in self._held else None


async def replayed(path: Path, speed: float, config: DaemonConfig | None = None) -> tuple[Messages, ReplayComparison]:
    """Return all that a replay publishes, and how it compares."""
    run, clock, seen = RecordedRun(path), ReplayClock(), []
    with contextlib.ExitStack() as opened:
        config = config or opened.enter_context(run.configuration())
        publisher = Publisher(opened.enter_context(zmq.asyncio.Context()), "tcp://127.0.0.1:*", clock)
        opened.callback(publisher.close)
        publisher.add_listener(lambda topic, content: seen.append((topic, content)))
        replay = Replay(run, config, publisher, clock)
        await replay.play(speed)
    return seen, replay.comparison


def measured(messages: Messages) -> Messages:
    """Return the messages without what says how long they took and how clocks were read."""
    return [(t, {k: v for k, v in c.items() if k not in ("latency_s", "timestamp")}) for t, c in messages]


@asynccontextmanager
async def recording_daemon(
    config: Path,
) -> AsyncIterator[tuple[Daemon, asyncio.subprocess.Process, Messages, Callable[[int], Awaitable[None]]]]:
    """Run a daemon on an emulated board of 60 frames; give both, what was published, and a wait for a frame."""
    published: Messages = []
    news = asyncio.Event()

    def listen(topic: str, content: dict[str, Any]) -> None:
        published.append((topic, content))
        news.set()

    async def until(frame: int) -> None:
        while not any(t == "eit.estimate" and c["frame"] >= frame for t, c in published):
            news.clear()
            await news.wait()

    async with running_daemon(config) as daemon:
        daemon.publisher.add_listener(listen)
        async with emulated_kit(config.parent, 60, "--once") as board:
            yield daemon, board, published, until


async def record(config: Path) -> Messages:
    """Record a board with faults and a tare on the way; return what the daemon published."""
    async with recording_daemon(config) as (daemon, board, published, until):
        await until(5)
        board.stdin.write(b"wrong-count\nunplug 0.3\n")
        await until(25)
        assert (await ask(daemon, "tare", confirmed=True))["ok"]
        await until(50)
    return published


@pytest.mark.long
def test_a_replay_equals_the_recording_at_any_speed(config, tmp_path, tiny_calibration, ran):
    live = asyncio.run(record(config(recording={"folder": "recordings"}, right=PLAYED)))
    (path,) = (tmp_path / "recordings").iterdir()
    # The recording holds the calibration that was used, whatever becomes of it.
    kept = tiny_calibration.rename(tmp_path / "kept.yaml")
    try:
        _same_at_any_speed(path, live, tmp_path, ran)
    finally:
        kept.rename(tiny_calibration)
    # And what changed is found out.
    changed = yaml.safe_load((tmp_path / "config.yaml").read_text())
    changed["fingertips"]["right"]["average_frames"] = 2
    (tmp_path / "changed.yaml").write_text(yaml.safe_dump(changed))
    arguments = ["recording", "replay", str(path), "--speed", "max", "--publish", f"ipc://{tmp_path}/replay", "--check"]
    assert "eit.estimate of right, number" in ran(*arguments, "--config", tmp_path / "changed.yaml", status=1).err


def _same_at_any_speed(path: Path, live: list[Any], tmp_path: Path, ran: Callable[..., Any]) -> None:
    fast, comparison = asyncio.run(replayed(path, math.inf))
    assert comparison.compared["eit.frame"] > 50
    assert comparison.compared["eit.estimate"] > 50
    assert comparison.different == Counter(), comparison.examples
    slow, _ = asyncio.run(replayed(path, 5.0))
    assert measured(slow) == measured(fast)
    assert [c["latency_s"] for t, c in slow if t == "eit.estimate"] == [0.0] * comparison.compared["eit.estimate"]
    # And the same as what subscribers saw, but for messages under way when the daemon was stopped.
    for topic in ("eit.frame", "eit.estimate"):
        then = measured([one for one in live if one[0] == topic])
        again = measured([one for one in fast if one[0] == topic])
        assert again[: len(then)] == then
    zeros = [c for t, c in fast if t == "eit.estimate" and c["reason"].startswith("taking the idle frame, 1 of")]
    assert len(zeros) == 2, "the operator's tare is replayed"
    errors = ran("recording", "replay", path, "--speed", "max", "--publish", f"ipc://{tmp_path}/replay", "--check").err
    assert f"eit.estimate: {comparison.compared['eit.estimate']} of {comparison.compared['eit.estimate']}" in errors


@pytest.mark.parametrize(
    ("asked", "took_s", "behind"),
    [(20.0, 5.0, False), (20.0, 5.4, False), (20.0, 6.0, True), (1.0, 100.6, False), (math.inf, 50.0, False)],
)
def test_a_replay_that_is_clearly_slower_than_asked_is_behind(asked, took_s, behind):
    pace = ReplayPace(asked, 100.0, took_s)
    assert (pace.is_behind, pace.reached) == (behind, 100.0 / took_s)


def test_a_replay_that_is_slower_than_asked_says_how_fast_it_was(imported, config, monkeypatch, tmp_path, ran):
    monkeypatch.setattr("shearloop.tools.recordings.replay._LATE_S", 0.0)
    arguments = ["recording", "replay", imported, "--config", str(config()), "--publish", f"ipc://{tmp_path}/replay"]
    said = ran(*arguments, "--speed", "1e9").err
    assert re.search(r"^The replay was [\d.e+]+ times as fast as the recording, not 1e\+09 times: ", said, re.MULTILINE)
    assert "times as fast" not in ran(*arguments, "--speed", "max").err


@pytest.mark.long
def test_a_real_recording_gives_the_stored_estimates(shared, config, tmp_path, monkeypatch):
    """Guards parser, frame clock, baseline and matching. Renew: run with SHEARLOOP_RENEW=1, and say why it changed."""
    path = tmp_path / "stream.mcap"
    folder = shared / "recordings" / "streams" / "2024-12-03_16-09"
    import_mat([folder / "device1.mat", folder / "device3.mat"], path)
    configured = load_daemon_config(config())
    averaging = {"right": configured.fingertips["right"].model_copy(update={"average_frames": 5})}
    configured = configured.model_copy(update={"fingertips": averaging})
    monkeypatch.setattr(Publisher, "has_subscriber", lambda _, topic: topic == EitHeatmap.topic)
    messages, _ = asyncio.run(replayed(path, math.inf, configured))
    scores = {content["frame"]: content["scores"] for topic, content in messages if topic == EitHeatmap.topic}
    estimates = [content for topic, content in messages if topic == "eit.estimate"]
    assert [content["frame"] for content in estimates] == list(range(832))
    matched = {content["frame"] for content in estimates if content["valid"]}
    assert len(matched) > 600
    assert scores.keys() >= matched, "a page sees the heatmaps of a replay"
    torques = [content for topic, content in messages if topic == "load.torque"]
    assert len(torques) == 4882
    seen = {
        "valid": sum(content["valid"] for content in estimates),
        "estimates": [
            {key: content[key] for key in ("frame", "t_mono_ns", "k", "sigma", "score", "torque_nm", "reason")}
            for content in estimates[::52]
        ],
    }
    if os.environ.get("SHEARLOOP_RENEW"):
        REFERENCE.write_text(json.dumps(seen, indent=1))
    reference = json.loads(REFERENCE.read_text())
    assert seen["valid"] == reference["valid"]
    for now, then in zip(seen["estimates"], reference["estimates"], strict=True):
        assert now["frame"] == then["frame"]
        assert now["reason"] == then["reason"]
        # To a microsecond, and to what another processor's arithmetic may do.
        assert now["t_mono_ns"] == pytest.approx(then["t_mono_ns"], abs=1000)
        for key in ("k", "sigma", "score", "torque_nm"):
            assert now[key] == (None if then[key] is None else pytest.approx(then[key], rel=RELATIVE)), key


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "nowhere.mcap: the recording cannot be read: No such file"),
        (["{imported}"], "has no configuration because"),
        (["{imported}", "--speed", "0"], "--speed 0 is not a number above 0, or max"),
        (["{imported}", "--speed", "fast"], "--speed fast is not a number above 0, or max"),
    ],
)
def test_mistakes_end_in_one_sentence(arguments, message, imported, mistake):
    assert message in mistake("recording", "replay", *(one.format(imported=imported) for one in arguments))


def test_nan_is_restored():
    on_wire = with_packed_arrays({"seq": 3, "joints_rad": [1.5, None, 2.5], "reason": ""})
    assert on_wire["joints_rad_shape"] == [3]
    np.testing.assert_array_equal(np.frombuffer(on_wire["joints_rad"], "<f4"), np.float32([1.5, np.nan, 2.5]))
    assert on_wire["seq"] == 3


TOPIC = EitEstimate.topic


def estimate(**changes: Any) -> dict[str, Any]:
    content = wire_map(sample(EitEstimate), Clock().unix_s(0), 7)
    return content | {"source": "right", "t_mono_ns": 5} | changes


def recorded(content: dict[str, Any]) -> RecordedEvent:
    """Return a message as it comes back from a recording, which leaves out what has no value."""
    data = message_json(TOPIC, content, 0)
    plain = read_content(recorded_topic(TOPIC, content["source"]), data)
    return RecordedEvent(TOPIC, content["t_mono_ns"], plain, content["source"])


@pytest.mark.parametrize(
    ("then", "now", "difference"),
    [
        ({}, {}, ""),
        ({"latency_s": 0.1, "timestamp": 1.0, "seq": 3}, {"latency_s": 0.7, "timestamp": 2.0, "seq": 4}, ""),
        ({"torque_nm": 0.1}, {"torque_nm": 0.1 + 1e-16}, "torque_nm was 0.1, is 0.100000000000000"),
        ({"k": None}, {"k": 1.5}, "k was None, is 1.5"),
        ({"k": 1.5}, {"k": None}, "k was 1.5, is None"),
        ({"reason": ""}, {"reason": "no grip"}, "reason was"),
    ],
)
def test_a_difference_is_described(then, now, difference):
    comparison = ReplayComparison(("eit.estimate.right",))
    comparison.add_computed(TOPIC, estimate(**now))
    comparison.compare(recorded(estimate(**then)))
    assert comparison.compared[TOPIC] == 1
    assert comparison.different[TOPIC] == bool(difference)
    assert difference in "".join(comparison.examples)
    assert comparison.unrecorded == 0


def test_a_missing_message_is_a_difference():
    comparison = ReplayComparison(("eit.estimate.right", "eit.estimate.left"))
    comparison.add_computed(TOPIC, estimate(source="left"))
    comparison.compare(recorded(estimate()))
    assert comparison.different[TOPIC] == 1
    assert "the replay did not compute it" in comparison.examples[0]
    assert comparison.unrecorded == 1, "the left one has no message beside it"


def test_messages_of_unrecorded_topics_are_only_counted():
    comparison = ReplayComparison(("eit.estimate.right",))
    for _ in range(3):
        comparison.add_computed(TOPIC, estimate(source="left"))
        comparison.add_computed("health", {"source": "daemon"})
    assert comparison.unrecorded == 3
    assert comparison.waiting == {}


OTHER_TOOL = Measured(14.0, 0.5)
# The frames after which another tool is held, a further experiment is begun, and a zero is taken.
HELD, BEGUN, ZEROED, ENOUGH = 6, 12, 18, 40


async def record_experiments(config: Path) -> list[dict[str, Any]]:
    """Run a daemon through two experiments; return what was published as estimates."""
    async with recording_daemon(config) as (daemon, _, published, until):
        recorder, right = daemon.recorder, daemon.sensors.tasks["right"]
        right.gripper = Gripper(right, OTHER_TOOL, range(HELD, 10 * ENOUGH))
        recorder.record_experiment("first")
        await until(BEGUN)
        recorder.record_experiment("second")
        await until(ZEROED)
        right.tare()
        await until(ENOUGH)
    return [content for topic, content in published if topic == "eit.estimate"]


def test_a_later_file_replays_frame_numbers_tares_and_tools(config, tmp_path, monkeypatch):
    live = asyncio.run(record_experiments(config(recording={"folder": "recordings"}, right=PLAYED)))
    (later,) = (path for path in (tmp_path / "recordings").iterdir() if "second" in path.name)
    before = RecordedRun(later).replay_events().before_frames["right"]
    zeroed = next(number for number in range(ZEROED, 10 * ENOUGH) if before.of(number, number - 1).begins_tare)
    held: list[object] = []
    set_tool = Session.set_tool

    def noted(self: Session, tool: Measured | None) -> None:
        held.append(tool)
        set_tool(self, tool)

    monkeypatch.setattr(Session, "set_tool", noted)
    again, _ = asyncio.run(replayed(later, math.inf))
    assert held == [None, OTHER_TOOL], "the second one came before the file began"
    estimates = {content["frame"]: content for topic, content in again if topic == "eit.estimate"}
    assert min(estimates) >= BEGUN
    said = ("reason", "valid", "k", "sigma", "score", "torque_nm")
    after = [one for one in live if one["frame"] >= zeroed]
    assert len(after) > ENOUGH - ZEROED - 10
    for one in after:
        assert [estimates[one["frame"]][key] for key in said] == [one[key] for key in said]
    assert estimates[zeroed]["reason"].startswith("taking the idle frame, 1 of")


def test_lines_that_waited_at_an_opening_explain_what_earlier_code_counted(config, tmp_path, ran):
    loaded = load_daemon_config(config(right=PLAYED))
    identity = daemon_identity(loaded, open_sessions(loaded).fingertips)
    earlier = replace(identity, metadata={**identity.metadata, "code_sha256": "earlier", "software": "0.2.0"})
    recorder = Recorder(tmp_path / "recordings", earlier, Clock())
    inputs, (_, lines) = recorder.input_recorder("right"), recording(tmp_path, 3)
    opened_ns = Clock().now_ns()
    inputs.record(RawEvent(InputKind.OPENED, opened_ns))
    inputs.record(RawEvent(InputKind.DATA, opened_ns + 1_000_000, b"".join(map(format_line, lines))))
    recorder.record_message("eit.frame", one_frame(0))
    recorder.close()
    (path,) = recorder.closed_files
    said = ran("recording", "replay", path, "--speed", "max", "--check", status=1).err
    assert "The recording was made by other code (shearloop 0.2.0), so its results may differ." in said
    assert "3 lines may have waited in a port before it was opened: this code drops such lines, and earlier" in said


@pytest.mark.parametrize("kept", [slice(None, -1), slice(1, None)], ids=["last published later", "first before"])
def test_a_file_may_hold_one_of_two_frames_that_arrived_together(config, tmp_path, kept):
    loaded = load_daemon_config(config(right=PLAYED))
    identity = daemon_identity(loaded, open_sessions(loaded).fingertips)
    _, lines = recording(tmp_path, 5)
    opened_ns, period_ns = Clock().now_ns(), round(loaded.fingertips["right"].frame_period_s * 1e9)

    def recorded(folder: str, number: int, messages: Messages) -> Path:
        recorder = Recorder(tmp_path / folder, identity, Clock())
        inputs = recorder.input_recorder("right")
        inputs.record(RawEvent(InputKind.OPENED, opened_ns))
        for count, line in enumerate(map(format_line, lines[:3]), 1):
            inputs.record(RawEvent(InputKind.DATA, opened_ns + count * period_ns, line))
        together = b"".join(map(format_line, lines[3:]))
        inputs.record(RawEvent(InputKind.DATA, opened_ns + 5 * period_ns, together))
        for topic, content in messages:
            if topic == "eit.frame":
                recorder.record_message(topic, content | {"frame": content["frame"] + number})
        recorder.close()
        (path,) = recorder.closed_files
        return path

    computed, _ = asyncio.run(replayed(recorded("inputs", 0, []), math.inf))
    frames = [one for one in computed if one[0] == "eit.frame"]
    *_, before, after = frames
    assert before[1]["t_mono_ns"] + round(before[1]["age_s"] * 1e9) == after[1]["t_mono_ns"] + round(
        after[1]["age_s"] * 1e9
    ), "they arrived together"
    # A later file of a run, whose first frame has the number 100.
    _, comparison = asyncio.run(replayed(recorded("frames", 100, frames[-2:][kept]), math.inf))
    assert (comparison.different, comparison.compared["eit.frame"]) == ({}, 1), comparison.examples


STATED = 40


async def record_stated_tool(config: Path) -> list[dict[str, Any]]:
    """Run a daemon while an experiment states a tool that is not the calibration's; return its estimates."""
    async with recording_daemon(config) as (daemon, _, published, until):
        await until(STATED)
        daemon.sensors.tasks["right"].loop.stated_tool_mm = 40.0
        await until(STATED + 15)
    return [content for topic, content in published if topic == "eit.estimate"]


def test_a_stated_tool_leaves_no_torque_live_and_the_replay_is_the_same(config, tmp_path, tiny_calibration):
    of_twenty = tmp_path / "twenty.cal"
    replace(Calibration.load(tiny_calibration), tool_mm=20.0).save(of_twenty)
    path = config(
        right={**PLAYED, "calibration": str(of_twenty), "average_frames": 1}, recording={"folder": "recordings"}
    )
    live = asyncio.run(record_stated_tool(path))
    assert any(one["valid"] for one in live), Counter(one["reason"] for one in live)
    refused = "the tool has 40 mm, and the calibration was made with a tool of 20 mm"
    from_frame = next(one["frame"] for one in live if refused in one["reason"])
    assert not any(one["valid"] for one in live if one["frame"] >= from_frame)
    (recorded_file,) = (tmp_path / "recordings").iterdir()
    _, comparison = asyncio.run(replayed(recorded_file, math.inf))
    assert comparison.compared["eit.estimate"] >= ENOUGH
    assert comparison.different == Counter(), comparison.examples


async def record_motion(config: Path) -> list[dict[str, Any]]:
    """Run a daemon whose fingers move now and then, also during a tare; return what was published as estimates."""
    async with recording_daemon(config) as (daemon, _, published, until):
        right = daemon.sensors.tasks["right"]
        right.gripper = Gripper(right, OTHER_TOOL, range(0))
        right.gripper.moves = (*range(3, 6), 20, *range(ZEROED + 10, ZEROED + 12))
        await until(ZEROED)
        right.tare()
        await until(ENOUGH)
    return [content for topic, content in published if topic == "eit.estimate"]


def test_frames_of_moving_fingers_are_replayed_as_such(config, tmp_path):
    live = asyncio.run(record_motion(config(recording={"folder": "recordings"}, right=PLAYED)))
    moved = [FINGERS_MOVED in one["reason"] for one in live]
    assert sum(moved) == 6
    assert not any(one["valid"] for one, was_moved in zip(live, moved, strict=True) if was_moved)
    (path,) = (tmp_path / "recordings").iterdir()
    again, comparison = asyncio.run(replayed(path, math.inf))
    assert comparison.compared["eit.estimate"] >= ENOUGH
    assert comparison.different == Counter(), comparison.examples
    reasons = [content["reason"] for topic, content in again if topic == "eit.estimate"]
    assert reasons[: len(live)] == [one["reason"] for one in live]


async def record_run(config: Path, per_experiment: int) -> None:
    """Run a daemon through three experiments, with a tare, lost bytes and a board that is gone for a moment."""
    async with recording_daemon(config) as (daemon, board, published, until):
        recorder = daemon.recorder
        for number in range(3):
            recorder.record_experiment(f"run {number}")
            begin = number * per_experiment
            await until(begin + per_experiment // 3)
            if number == 0:
                board.stdin.write(b"wrong-count\nunplug 0.3\n")
            elif number == 1:
                assert (await ask(daemon, "tare", confirmed=True))["ok"]
            else:
                # It is given up before it is complete.
                right = daemon.sensors.tasks["right"]
                right.longest_tare_s = 2 * right.board.period_s
                right.tare()
            await until(begin + per_experiment - 2)
            assert published


@pytest.mark.long
def test_each_of_a_daemons_recordings_replays_bit_for_bit(config, tmp_path, ran):
    asyncio.run(record_run(config(recording={"folder": "recordings"}, right=PLAYED), 18))
    paths = list((tmp_path / "recordings").iterdir())
    assert {path.stem.rpartition("_")[2] for path in paths} == {"run-0", "run-1", "run-2"}
    for path in paths:
        said = ran("replay", path, "--speed", "max", "--publish", f"ipc://{tmp_path}/replay", "--check").err
        frames, estimates = (re.search(rf"{topic}: (\d+) of \1 equal", said) for topic in ("eit.frame", "eit.estimate"))
        assert int(frames[1]) > 8, path
        assert int(estimates[1]) > 8, path


def copy_of(path: Path, keeps: Callable[[str, dict[str, Any]], bool], *, attachments: bool = True) -> Path:
    """Return a copy of a recording, of the messages whose topic and content it `keeps`."""
    copy = path.with_name("copy.mcap")
    with path.open("rb") as source, copy.open("wb") as target:
        reader, writer = make_reader(source), McapWriter(target)
        writer.start()
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for own, channel, message in reader.iter_messages(log_time_order=False):
            if own.id not in schemas:
                schemas[own.id] = writer.register_schema(own.name, own.encoding, own.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[own.id], channel.metadata
                )
            if keeps(channel.topic, json.loads(message.data)):
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        kept = (one for one in reader.iter_attachments() if attachments or one.name == CONFIGURATION)
        for one in kept:
            writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        for one in reader.iter_metadata():
            writer.add_metadata(one.name, one.metadata)
        writer.finish()
    return copy


def is_no_state(_topic: str, content: dict[str, Any]) -> bool:
    return content.get("kind") != InputKind.STATE.value


def test_a_check_fails_for_a_source_whose_state_is_missing(config, tmp_path, ran):
    """A daemon that was killed too soon leaves such a file."""
    asyncio.run(record_experiments(config(recording={"folder": "recordings"}, right=PLAYED)))
    (later,) = (path for path in (tmp_path / "recordings").iterdir() if "second" in path.name)
    publish = ("--publish", f"ipc://{tmp_path}/replay")
    out, said = ran("replay", copy_of(later, is_no_state), "--speed", "max", *publish, "--check", "--json", status=1)
    assert "Nothing of right was compared: the recording has no state of it" in said
    result = json.loads(out.splitlines()[-1])
    assert result["without_state"] == ["right"]
    assert result["before_state"]["eit.frame.right"] > ENOUGH - BEGUN - 10
    assert result["different"] == {}


async def record_frames(config: Path) -> Messages:
    """Return what a daemon publishes of some frames."""
    async with recording_daemon(config) as (_, _, published, until):
        await until(50)
    return published


@pytest.mark.long
@pytest.mark.parametrize("lost", [("eit.",), ("eit.", "input.right")], ids=["messages", "messages and their input"])
def test_after_a_lost_part_each_message_is_compared_with_its_own(lost, config, tmp_path, monkeypatch):
    """A repaired copy has such holes; compared by their order, all messages after one are different."""
    monkeypatch.setattr(replay, "_MAX_EXAMPLES", 1000)
    published = asyncio.run(record_frames(config(recording={"folder": "recordings"}, right=PLAYED)))
    frames = [content for topic, content in published if topic == "eit.frame"]
    gone = frames[20:28]
    arrivals_ns = [frame["t_mono_ns"] + round(frame["age_s"] * 1e9) for frame in (frames[19], gone[-1])]

    def is_kept(topic: str, content: dict[str, Any]) -> bool:
        if topic.startswith("input."):
            return "input.right" not in lost or not arrivals_ns[0] < content["t_mono_ns"] <= arrivals_ns[1]
        return content.get("frame") not in [frame["frame"] for frame in gone]

    (path,) = (tmp_path / "recordings").iterdir()
    _, comparison = asyncio.run(replayed(copy_of(path, is_kept), math.inf))
    assert comparison.compared["eit.frame"] == len(frames) - len(gone)
    assert "frame was" not in "".join(comparison.examples)
    not_computed = sum("did not compute" in one for one in comparison.examples)
    if lost == ("eit.",):
        assert comparison.different == {}
        assert comparison.unrecorded >= 2 * len(gone)
    else:
        # Bytes of the next frame may have come with the last one of the hole.
        assert not_computed <= 2


def test_a_lost_calibration_is_replaced_only_by_the_same_one(config, tmp_path, tiny_calibration, ran, mistake):
    calibration = Path(shutil.copy(tiny_calibration, tmp_path / "own.cal"))
    right = {**PLAYED, "calibration": str(calibration)}
    asyncio.run(record_frames(config(recording={"folder": "recordings"}, right=right)))
    (path,) = (tmp_path / "recordings").iterdir()
    copy = copy_of(path, lambda *_: True, attachments=False)
    replay = ("recording", "replay", copy, "--speed", "max", "--check")
    ran(*replay)
    calibration.write_bytes(calibration.read_bytes() + b" ")
    assert f"has lost its copy of {calibration}" in mistake(*replay)
    calibration.unlink()
    assert f"has lost its copy of {calibration}" in mistake(*replay)
