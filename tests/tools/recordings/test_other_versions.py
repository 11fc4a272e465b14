"""Recordings of other versions, whose schemas lack keys or have further ones, go through every way out."""

import asyncio
import csv
import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import shearloop
from shearloop.cli.terminal import message_json, message_line
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging.messages import TOPICS, decode, encode
from shearloop.daemon.recorder import schema
from shearloop.daemon.web.message_store import MessageStore
from shearloop.errors import UserError
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.replay import RecordedRun, ReplayComparison
from shearloop.tools.recordings.summary import summarise
from tests.tools.recordings.every_message import Recorded, made
from tests.tools.recordings.test_every_way_out import check_lerobot, check_rerun, check_tables
from tests.tools.recordings.test_matlab_slices import Sweep
from tests.tools.recordings.test_replay import replayed
from tests.tools.recordings.test_units import check_table_units, declared

pytestmark = pytest.mark.usefixtures("rerun_runtime")
FURTHER = "grip_force"
ENVELOPE = ("timestamp", "t_mono_ns", "seq", "source")
# What a replay cannot do without, besides the envelope.
REPLAY_NEEDS = {
    "eit.frame": ("age_s", "frame"),
    "skin.shear": ("sample",),
    "input": ("t_mono_ns", "kind", "data"),
    "input.clock": ("t_mono_ns", "offset_ns"),
}
MOST_KEYS = max(len(one["properties"]) for one in schema.schemas().values())
Row = dict[str, Any]
Change = Callable[[str, Row], Row]


def rewritten(
    source: Path,
    out: Path,
    of_schema: Callable[[str, Row], Row | bytes],
    of_message: Change = lambda _, row: row,
    renamed: Mapping[str, str] = MappingProxyType({}),
) -> Path:
    """Copy a recording with other schemas, messages and topics, each changed by its name as a live topic."""
    with source.open("rb") as file, out.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy)
        writer.start("x")
        channels: dict[str, int] = {}
        for described, channel, message in reader.iter_messages(log_time_order=False):
            name = schema.schema_name(channel.topic)
            if channel.topic not in channels:
                text = of_schema(name, json.loads(described.data))
                data = text if isinstance(text, bytes) else json.dumps(text).encode()
                number = writer.register_schema(name, "jsonschema", data)
                topic = renamed.get(channel.topic, channel.topic)
                channels[channel.topic] = writer.register_channel(topic, "json", number)
            content = json.dumps(of_message(name, json.loads(message.data))).encode()
            times = message.log_time, content, message.publish_time, message.sequence
            writer.add_message(channels[channel.topic], *times)
        for record in reader.iter_metadata():
            changed = {"code_sha256": "0", "software": "0.1.0"} if record.name == schema.METADATA else {}
            writer.add_metadata(record.name, {**record.metadata, **changed})
        writer.finish()
    return out


@dataclasses.dataclass(frozen=True)
class Other(Recorded):
    """A recording of another version."""

    dropped: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def columns(self) -> dict[str, dict[str, str]]:
        """Return the keys of the file's schemas, and those that they lack: their cells are empty, whatever the type."""
        found = super().columns()
        for topic, kinds in found.items():
            name = schema.schema_name(topic)
            if name in self.dropped:
                kinds[self.dropped[name]] = "number"
        return found


def other(source: Path, out: Path, dropped: Mapping[str, str], further: Iterable[str] = ()) -> Other:
    """Copy a recording as a version would have written it that lacks a key of some topics, and has one more."""

    def described(name: str, content: Row) -> Row:
        properties = {key: one for key, one in content["properties"].items() if key != dropped.get(name)}
        required = [key for key in content["required"] if key in properties]
        if name in further:
            properties[FURTHER] = {"type": "number", "description": "force of the fingers", "unit": "N"}
            required.append(FURTHER)
        return {**content, "properties": properties, "required": required}

    def written(name: str, content: Row) -> Row:
        own = {key: value for key, value in content.items() if key != dropped.get(name)}
        return {**own, FURTHER: 0.25} if name in further else own

    return Other(rewritten(source, out, described, written), [], replayable=False, dropped=dropped)


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    return made(tmp_path_factory.mktemp("made")).path


def nth_keys(number: int, spared: Mapping[str, Iterable[str]] | None = None) -> dict[str, str]:
    """Return one key of each topic, another for each number, but none of the spared ones."""
    found = {}
    for name, described in schema.schemas().items():
        kept = (spared or {}).get(name, ())
        if keys := [key for key in described["properties"] if key not in kept]:
            found[name] = keys[number % len(keys)]
    return found


@pytest.mark.parametrize("number", range(MOST_KEYS))
def test_each_export_takes_a_recording_without_one_key_of_each_topic_and_with_another(
    number, source, tmp_path, ran, mistake
):
    one = other(source, tmp_path / "x.mcap", nth_keys(number), schema.schemas())
    out = tmp_path / "out"
    out.mkdir()
    check_tables(one, out, ran)
    check_rerun(one, out, ran)
    check_lerobot(one, out, ran, mistake)
    found = summarise(one.path)
    for topic, summary in found.topics.items():
        name = schema.schema_name(topic)
        assert (summary.not_recorded, summary.unknown, summary.problem) == ([one.dropped[name]], [FURTHER], ""), topic
    printed = ran("recording", "info", one.path).out
    assert f"health was recorded without {one.dropped['health']}: exports have no value there" in printed
    assert f"health was recorded with {FURTHER}, which this version does not have" in printed


def test_a_key_that_this_version_does_not_have_keeps_the_unit_of_its_schema(source, tmp_path, ran):
    one = other(source, tmp_path / "x.mcap", {}, ["gripper.state"])
    assert shearloop.read(one.path).units("gripper.state")[FURTHER] == "N"
    ran("recording", "export", one.path, "--topic", "gripper.state", "--out", tmp_path / "csv")
    with (tmp_path / "csv" / "units.csv").open(newline="") as file:
        assert ["gripper.state", FURTHER, "N"] in csv.reader(file)


def spared_of_replay() -> dict[str, tuple[str, ...]]:
    """Return the keys of each topic that a replay needs."""
    return {name: (*REPLAY_NEEDS.get(name, ()), *(ENVELOPE if name in TOPICS else ())) for name in schema.schemas()}


@pytest.mark.parametrize("number", range(MOST_KEYS))
def test_a_replay_sends_what_was_recorded_and_nothing_for_a_key_that_was_not(number, source, config, tmp_path):
    one = other(source, tmp_path / "x.mcap", nth_keys(number, spared_of_replay()), schema.schemas())
    sent, _ = asyncio.run(replayed(one.path, math.inf, load_daemon_config(config())))
    recorded = one.by_stream()
    store, topics = MessageStore(3.6), set()
    for at, (topic, content) in enumerate(sent):
        row = recorded[topic, content["source"], content["seq"]]
        topics.add(topic)
        assert FURTHER not in content
        assert content[one.dropped[topic]] is None
        received = decode(encode(content))
        # A viewer of any kind shows it.
        assert json.loads(message_json(topic, received))["source"] == row["source"]
        assert message_line(topic, received)
        store.add(topic, received, float(at))
        schema.message_json(topic, received, 0)
    assert topics == TOPICS.keys() - {"eit.heatmap"}
    assert not store.refused
    store.batch(-1, 1e3)
    store.history(1e3)


def test_a_replay_names_the_keys_that_only_one_of_both_versions_has(source, config, tmp_path, ran):
    one = other(source, tmp_path / "x.mcap", {"health": "instance"}, ["loop.state"])
    arguments = ["--config", config(), "--publish", f"ipc://{tmp_path}/r", "--speed", "max"]
    said = ran("recording", "replay", one.path, *arguments).err
    assert said.count("Other code (shearloop 0.1.0) made the recording without instance of health") == 1
    assert said.count(f"Other code (shearloop 0.1.0) made the recording with {FURTHER} of loop.state") == 1


def test_a_replay_prints_each_count_and_each_difference_under_its_name(source, config, tmp_path, ran):
    one = other(source, tmp_path / "keys.mcap", {"health": "instance"}, ["loop.state"])
    path = with_definition(one.path, tmp_path / "unit.mcap", "load.torque", "torque_nm", {"unit": "mN·m"})
    path = rewritten(path, tmp_path / "x.mcap", lambda _, own: own, renamed={"gripper.state": "hand.posture"})
    arguments = ["--config", config(), "--publish", f"ipc://{tmp_path}/r", "--speed", "max", "--json"]
    printed = json.loads(ran("recording", "replay", path, *arguments).out)
    _, comparison = asyncio.run(replayed(path, math.inf, load_daemon_config(config())))
    counted = ("compared", "different", "without_state", "unrecorded", "examples", "dropped_at_opening")
    assert printed == {
        **{name: json.loads(json.dumps(getattr(comparison, name))) for name in counted},
        "before_state": {".".join(stream): count for stream, count in comparison.before_state.items()},
        "same_code": False,
        "not_recorded": {"health": ["instance"]},
        "left_out": {"loop.state": [FURTHER]},
        "differing": {"load.torque": {"torque_nm": "in mN·m, not in N·m"}},
        "lost_in_repair": {},
        "left_out_topics": ["hand.posture"],
    }


def test_the_summary_prints_each_value_of_a_topic_under_its_name(source, tmp_path, result_of):
    one = other(source, tmp_path / "keys.mcap", {"load.torque": "raw"}, ["load.torque"])
    path = with_definition(one.path, tmp_path / "unit.mcap", "load.torque", "torque_nm", {"unit": "mN·m"})
    path = rewritten(path, tmp_path / "x.mcap", lambda _, own: own, renamed={"gripper.state": "hand.posture"})
    topics = result_of("recording", "info", path)["topics"]
    assert topics["load.torque"] == {
        "messages": 7,
        "rate_hz": None,
        "known": True,
        "not_recorded": ["raw"],
        "unknown": [FURTHER],
        "differing": {"torque_nm": "in mN·m, not in N·m"},
        "problem": "",
    }
    known = {topic: summary["known"] for topic, summary in topics.items()}
    assert known == {topic: topic != "hand.posture" for topic in topics}


@pytest.mark.parametrize(
    ("topic", "key"),
    [*((topic, key) for topic, keys in REPLAY_NEEDS.items() for key in keys), *(("health", key) for key in ENVELOPE)],
)
def test_a_replay_says_in_one_sentence_which_key_it_needs(topic, key, source, tmp_path):
    one = other(source, tmp_path / "x.mcap", {topic: key})
    with pytest.raises(UserError, match=f"x.mcap: a replay needs the key '{key}' of {topic}.*version 0.1.0 wrote"):
        RecordedRun(one.path)


@pytest.mark.parametrize(("topic", "key"), [("load.torque", "raw"), ("eit.estimate", "frame")])
def test_a_comparison_leaves_out_a_key_that_was_not_recorded(topic, key, source, tmp_path):
    one = other(source, tmp_path / "x.mcap", {topic: key}, [topic])
    (event, *_) = (event for event in RecordedRun(one.path).events() if event.topic == topic)
    for changes, differences in (({}, 0), ({"torque_nm": 9.0}, 1)):
        comparison = ReplayComparison({schema.recorded_topic(topic, event.source)})
        comparison.add_computed(topic, {**event.content, key: 7, **changes})
        comparison.compare(event)
        assert (comparison.compared.total(), comparison.different.total()) == (1, differences)


@pytest.mark.parametrize(("topic", "key"), [("eit.frame", "line"), ("load.torque", "valid")])
def test_a_calibration_takes_no_recording_without_a_key_that_it_reads(topic, key, source, tmp_path):
    with pytest.raises(UserError, match=f"needs the key '{key}' of {topic}"):
        read_recording(other(source, tmp_path / "x.mcap", {topic: key}).path)
    read_recording(other(source, tmp_path / "y.mcap", {"load.torque": "raw", "eit.frame": "dead"}).path)


def test_slices_need_their_keys_alone(tmp_path, ran, mistake):
    sweep = Sweep(tmp_path)
    sweep.hold(1, 0.1)
    sweep.export(tmp_path / "first")
    whole = sweep.path
    arguments = ("--format", "slices", "--out")
    old = other(whole, tmp_path / "old.mcap", {"loop.state": "held_s", "load.torque": "raw"}, ["loop.state"])
    ran("recording", "export", old.path, *arguments, tmp_path / "out")
    assert (tmp_path / "out/torque_slices/Data_Slice_1.mat").is_file()
    without = other(whole, tmp_path / "without.mcap", {"loop.state": "hold"})
    said = mistake("recording", "export", without.path, *arguments, tmp_path / "none")
    assert "an export of slices needs the key 'hold' of loop.state" in said
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("topic", "content", "problem"),
    [
        ("load.torque", {"saturated": None}, "it lacks the key 'saturated'"),
        ("load.torque", {"other": 1}, "it has the unknown key 'other'"),
        ("load.torque", {FURTHER: "much"}, f"{FURTHER} is 'much', not a number"),
        ("health", {"instance": "x"}, "it has the unknown key 'instance'"),
        ("health", {FURTHER: None}, f"it lacks the key '{FURTHER}'"),
    ],
)
def test_a_message_that_does_not_fit_its_own_schema_is_refused(topic, content, problem, source, tmp_path, mistake):
    first = other(source, tmp_path / "first.mcap", {"health": "instance"}, ["health", "load.torque"])

    def changed(name: str, row: Row) -> Row:
        if name != topic:
            return row
        return {key: value for key, value in {**row, **content}.items() if key not in content or value is not None}

    path = rewritten(first.path, tmp_path / "x.mcap", lambda _, described: described, changed)
    said = mistake("recording", "export", path, "--topic", topic, "--out", tmp_path / "out")
    assert problem in said
    assert f"{path}: a message cannot be used: {topic}, number " in said


def with_definition(source: Path, out: Path, topic: str, key: str, changes: Row) -> Path:
    """Copy a recording whose schema defines one key in another way; a change to None removes the word."""

    def described(name: str, content: Row) -> Row:
        if name != topic:
            return content
        defined = {**content["properties"][key], **changes}
        defined = {word: value for word, value in defined.items() if value is not None}
        return {**content, "properties": {**content["properties"], key: defined}}

    return rewritten(source, out, described)


OTHER_UNIT = pytest.mark.parametrize(
    "changes", [{"unit": "mN·m"}, {"unit": None, "description": "the torque (mN·m)"}], ids=["unit", "description"]
)


@OTHER_UNIT
def test_a_key_with_another_unit_is_exported_in_it_and_nothing_computes_with_it(changes, source, config, tmp_path, ran):
    path = with_definition(source, tmp_path / "x.mcap", "load.torque", "torque_nm", changes)
    one = Recorded(path, [], replayable=False)
    out = tmp_path / "out"
    out.mkdir()
    check_tables(one, out, ran)
    check_rerun(one, out, ran)
    assert shearloop.read(path).units("load.torque")["torque_nm"] == "mN·m"
    recorded_so = "in mN·m, not in N·m"
    assert (
        f"load.torque was recorded with torque_nm {recorded_so}: tables have this" in ran("recording", "info", path).out
    )
    with pytest.raises(UserError, match=r"needs the key 'torque_nm' of load.torque, which was recorded in mN·m, not"):
        read_recording(path)
    sent, _ = asyncio.run(replayed(path, math.inf, load_daemon_config(config())))
    assert {content["torque_nm"] for topic, content in sent if topic == "load.torque"} == {None}
    said = ran("recording", "replay", path, "--config", config(), "--publish", f"ipc://{tmp_path}/r", "--speed", "max")
    assert f"with torque_nm of load.torque {recorded_so}: no value is sent there" in said.err


def test_each_table_has_the_recorded_unit_of_keys_and_topics_of_other_versions(source, tmp_path, ran):
    one = other(source, tmp_path / "keys.mcap", {}, ["loop.state"])
    path = with_definition(one.path, tmp_path / "unit.mcap", "load.torque", "torque_nm", {"unit": "mN·m"})
    path = rewritten(path, tmp_path / "x.mcap", lambda _, own: own, renamed={"gripper.state": "hand.posture"})
    expected = declared(Recorded(source, []).columns())
    expected["loop.state"][FURTHER] = "N"
    expected["load.torque"]["torque_nm"] = "mN·m"
    expected["hand.posture"] = expected.pop("gripper.state")
    check_table_units(path, tmp_path, expected, ran)


def test_no_chart_of_rerun_draws_a_torque_in_another_unit(source, tmp_path, rerun_charts, ran):
    path = with_definition(source, tmp_path / "x.mcap", "load.torque", "torque_nm", {"unit": "mN·m"})
    ran("recording", "export", path, "--format", "rrd", "--out", tmp_path / "a.rrd")
    assert "robot/state/wrist_torque_nm" in rerun_charts["torque (N·m)"]
    assert not any("load/torque/torque_nm" in chart for chart in rerun_charts.values())


@OTHER_UNIT
def test_a_key_with_another_unit_has_no_value_in_a_data_set_of_lerobot(changes, source, tmp_path, ran):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    path = with_definition(source, tmp_path / "x.mcap", "load.torque", "torque_nm", changes)
    ran("recording", "export", path, "--format", "lerobot", "--out", tmp_path / "lerobot")
    load = parquet.read_table(tmp_path / "lerobot/data/chunk-000/file-000.parquet")["observation.load"].to_pylist()
    assert np.isnan(np.array(load)[:, 0]).all()


def test_another_unit_of_a_needed_key_refuses_slices_and_replay(source, tmp_path, mistake):
    sweep = Sweep(tmp_path)
    sweep.hold(1, 0.1)
    sweep.export(tmp_path / "first")
    changed = with_definition(sweep.path, tmp_path / "x.mcap", "load.torque", "torque_nm", {"unit": "mN·m"})
    said = mistake("recording", "export", changed, "--format", "slices", "--out", tmp_path / "none")
    assert "slices needs the key 'torque_nm' of load.torque, which was recorded in mN·m, not in N·m" in said
    changed = with_definition(source, tmp_path / "y.mcap", "eit.frame", "age_s", {"unit": "ms"})
    with pytest.raises(UserError, match=r"a replay needs the key 'age_s' of eit.frame.right, which was recorded in ms"):
        RecordedRun(changed)


def test_schemas_with_units_in_their_descriptions_alone_differ_in_nothing(source, tmp_path):
    def described(_: str, content: Row) -> Row:
        properties = {
            key: {word: value for word, value in one.items() if word != "unit"}
            for key, one in content["properties"].items()
        }
        return {**content, "properties": properties}

    path = rewritten(source, tmp_path / "x.mcap", described)
    assert not any(topic.differing for topic in summarise(path).topics.values())
    older, newer = shearloop.read(path), shearloop.read(source)
    assert {topic: older.units(topic) for topic in older} == {topic: newer.units(topic) for topic in newer}
    read_recording(path)
    RecordedRun(path)


@pytest.mark.parametrize("unit", ["cm", "cm or rad/cm", ""])
def test_the_bank_decides_the_unit_of_k_whatever_a_schema_says(unit, source, tmp_path):
    path = with_definition(source, tmp_path / "x.mcap", "eit.estimate", "k", {"unit": unit})
    assert not summarise(path).topics["eit.estimate.right"].differing
    assert shearloop.read(path).units("eit.estimate.right").get("k", "") == unit


def test_a_topic_that_this_version_does_not_have_is_exported_as_it_was_recorded(source, config, tmp_path, ran, mistake):
    path = rewritten(
        source, tmp_path / "x.mcap", lambda _, described: described, renamed={"gripper.state": "hand.posture"}
    )
    one = Recorded(path, [], replayable=False)
    out = tmp_path / "out"
    out.mkdir()
    check_tables(one, out, ran)
    check_rerun(one, out, ran)
    check_lerobot(one, out, ran, mistake)
    assert shearloop.read(path).units("hand.posture") == shearloop.read(source).units("gripper.state")
    assert "hand.posture is a topic that this version does not have" in ran("recording", "info", path).out
    said = ran("recording", "replay", path, "--config", config(), "--publish", f"ipc://{tmp_path}/r", "--speed", "max")
    assert "made the recording with the topics hand.posture: this version does not have them" in said.err


NUMBER = {"type": "number"}
HOSTILE: list[Any] = [
    b"",
    b"{",
    b"\xff\xfe",
    b"[" * 100_000,
    b'"text"',
    b"[]",
    b"{}",
    b" " * (257 << 10),
    {"properties": []},
    {"properties": {"torque_nm": 5}},
    {"properties": {"torque_nm": {"type": "tensor"}}},
    {"properties": {"torque_nm": {"type": ["number", "null"]}}},
    {"properties": {f"key_{number}": NUMBER for number in range(1001)}},
    {"properties": {"a,b": NUMBER}},
    {"properties": {"": NUMBER}},
    {"properties": {"k" * 100: NUMBER}},
    {"properties": {"log_time_ns": NUMBER}},
    {"properties": {"force": {"type": "number", "unit": "N" * 100}}},
    {"properties": {"force": {"type": "number", "unit": 5}}},
    {"properties": {}, "required": ["torque_nm"]},
    {"properties": {}, "required": [{}]},
    {"properties": {}, "required": 5},
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
@pytest.mark.parametrize("form", ["csv", "parquet", "mat", "rrd", "lerobot", "slices", "read", "replay", "calibrate"])
def test_a_schema_that_no_version_writes_ends_in_one_sentence(form, text, source, tmp_path, mistake):
    if form in ("parquet", "lerobot"):
        pytest.importorskip("pyarrow")
    described = text if isinstance(text, bytes) else {"type": "object", **text}
    path = rewritten(source, tmp_path / "x.mcap", lambda name, own: described if name == "load.torque" else own)
    arguments: tuple[Any, ...] = ("recording", "export", path, "--format", form, "--out", tmp_path / "out")
    if form == "replay":
        arguments = ("recording", "replay", path)
    if form == "read":
        with pytest.raises(UserError) as refused:
            shearloop.read(path)["load.torque"]
        said = str(refused.value)
    elif form == "calibrate":
        with pytest.raises(UserError) as refused:
            read_recording(path)
        said = str(refused.value)
    else:
        said = mistake(*arguments)
    assert f"{path}: a schema cannot be used: load.torque: its schema " in said
    assert len(said.strip().splitlines()) == 1
    assert not list(tmp_path.glob("out*"))
    # The summary counts, and the other topics can be read.
    assert summarise(path).topics["load.torque"].problem.startswith("its schema ")
    assert shearloop.read(path)["health"]["log_time_ns"].size == 7
