"""Every topic, column and row of every way out of a recording equals the recorded messages, read independently."""

import asyncio
import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.io import loadmat

import shearloop
from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli.terminal import message_json, message_line
from shearloop.daemon.messaging.messages import TOPICS, decode, encode
from shearloop.daemon.web.message_store import MessageStore
from tests.emulator_process import own_address
from tests.fixtures.daemons import free_port, robot_at, running_daemon
from tests.fixtures.rigs import experiment, running_rig, started
from tests.tools.recordings import test_skin_replay
from tests.tools.recordings.every_message import (
    EIT,
    Published,
    Recorded,
    Row,
    by_stream,
    latest_recording,
    live_topic,
    made,
    value_of,
)
from tests.tools.recordings.test_replay import replayed
from tests.tools.recordings.watching import Watched, check_message, no_json, page_content, same, watching

pytestmark = pytest.mark.usefixtures("rerun_runtime")
MONOTONIC = ("latency_s", "timestamp", "arrival_unix_ns", "seq")
SCALARS = ("number", "integer", "boolean")
# What the daemon of a rig with one fingertip publishes in an experiment that is done.
ON_THE_RIG = {
    *("eit.frame", "eit.estimate", "eit.heatmap", "load.torque", "robot.state", "gripper.state"),
    *("loop.state", "daemon.command", "daemon.end", "health"),
}
NOT_IN_RERUN = ("timestamp", "t_mono_ns", "seq", "scores", "scores_shape")
# Of a LeRobot dataset, by topic.
FEATURES = {
    "robot.state": (
        "state",
        "joints_rad tcp_pose wrench wrist_rad wrist_speed_rad_per_s wrist_torque_nm wrist_torque_valid",
    ),
    "eit.estimate": (
        "estimate",
        "torque_nm torque_low_nm torque_high_nm diameter_mm diameter_low_mm diameter_high_mm k sigma score valid",
    ),
    "eit.frame": ("channels", ""),
    "load.torque": ("load", "torque_nm valid"),
    "skin.shear": ("skin", "shear_n shear_low_n shear_high_n torque_nm valid"),
    "gripper.state": (
        "gripper",
        "width_mm diameter_mm diameter_std_mm tool_diameter_mm tool_diameter_std_mm current_ma",
    ),
}


def check_rows(what: str, found: list[Row], expected: list[Row], columns: dict[str, str]) -> None:
    """Hold a table to have the rows, the columns and the values of a topic."""
    assert len(found) == len(expected), what
    names = ["log_time_ns", *columns]
    for number, (row, truth) in enumerate(zip(found, expected, strict=True)):
        assert sorted(row) == sorted(names), f"{what} {number}"
        for name in names:
            assert same(row[name], truth.get(name)), f"{what} {number} {name}: {row[name]!r} is not {truth.get(name)!r}"


def from_text(text: str, kind: str) -> Any:
    """Return the value of a cell of CSV."""
    if kind in ("string", "object"):
        return text
    if text == "":
        return None
    return text == "True" if kind == "boolean" else int(text) if kind == "integer" else float(text)


def csv_rows(path: Path, columns: dict[str, str]) -> Iterator[Row]:
    with path.open(newline="", encoding="utf-8") as file:
        for cells in csv.DictReader(file, strict=True):
            assert None not in cells
            assert None not in cells.values()
            row: Row = {}
            for name, text in cells.items():
                key, _, number = name.rpartition("_")
                if columns.get(key) == "array" and number.isdigit():
                    row.setdefault(key, []).append(from_text(text, "number"))
                    assert len(row[key]) == int(number) + 1
                else:
                    row[name] = from_text(text, columns.get(name, "integer"))
            yield row


def plain(values: np.ndarray) -> list[Any]:
    """Return a field of a MATLAB struct as a list of values."""
    if values.dtype == object:
        return ["".join(cell.ravel().tolist()) for (cell,) in values]
    return values.tolist()


def mat_rows(struct: np.ndarray, columns: dict[str, str]) -> list[Row]:
    fields = {name: plain(struct[0, 0][name]) for name in struct.dtype.names}
    for name, kind in columns.items():
        if kind != "array":
            fields[name] = [one[0] if isinstance(one, list) else one for one in fields[name]]
        if kind == "boolean":
            fields[name] = [bool(one) for one in fields[name]]
    fields["log_time_ns"] = [one for (one,) in fields["log_time_ns"]]
    return [dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True)]


def check_tables(one: Recorded, out: Path, ran: Any) -> None:
    """Compare CSV, Parquet, MATLAB and `shearloop.read`."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    rows, columns = one.rows(), one.columns()
    for form in ("csv", "parquet", "mat"):
        ran("recording", "export", one.path, "--format", form, "--out", out / form)
    structs = loadmat(out / "mat.mat", squeeze_me=False)
    read = shearloop.read(one.path)
    assert set(read) == set(rows)
    for topic, expected in rows.items():
        kinds = columns[topic]
        check_rows(f"csv {topic}", list(csv_rows(out / "csv" / f"{topic}.csv", kinds)), expected, kinds)
        table = parquet.read_table(out / "parquet" / f"{topic}.parquet")
        check_rows(f"parquet {topic}", table.to_pylist(), expected, kinds)
        struct = structs[topic.replace(".", "_").replace("-", "_")]
        # SciPy reads a zero byte of a text as a blank.
        blanks = [
            {key: one.replace("\0", " ") if isinstance(one, str) else one for key, one in row.items()}
            for row in expected
        ]
        check_rows(f"mat {topic}", mat_rows(struct, kinds), blanks, kinds)
        arrays = {key: values.tolist() for key, values in read[topic].items()}
        listed = [dict(zip(arrays, row, strict=True)) for row in zip(*arrays.values(), strict=True)]
        check_rows(f"read {topic}", listed, expected, kinds)
        frame = read.frame(topic)
        for name in frame.columns:
            key, _, number = name.rpartition("_")
            if kinds.get(key) == "array" and number.isdigit():
                truth = [row[key][int(number)] for row in expected]
            else:
                truth = [row.get(name) for row in expected]
            assert all(map(same, frame[name].tolist(), truth)), f"frame {topic} {name}"
        assert frame.index.tz_localize(None).astype("datetime64[ns]").astype("int64").tolist() == [
            row["log_time_ns"] for row in expected
        ]


def check_rerun(one: Recorded, out: Path, ran: Any) -> None:
    """Compare each scalar, and each array of up to eight numbers."""
    chunk = pytest.importorskip("rerun.chunk", reason="needs the extra `rerun`")
    ran("recording", "export", one.path, "--format", "rrd", "--out", out / "a.rrd")
    found: dict[str, list[tuple[int, list[float]]]] = {}
    for part in chunk.RrdReader(out / "a.rrd").stream().to_chunks():
        table = part.to_record_batch().to_pydict()
        if not part.is_static and "Scalars:scalars" in table:
            times = [round(time.timestamp() * 1e6) for time in table["time"]]
            found.setdefault(part.entity_path, []).extend(zip(times, table["Scalars:scalars"], strict=True))
    expected: dict[str, list[tuple[int, list[Any]]]] = {}
    for topic, rows in one.rows().items():
        if topic.startswith("input."):
            continue
        for key, kind in one.columns()[topic].items():
            entity = "/" + f"{topic}/{key}".replace(".", "/")
            shown = kind in (*SCALARS, "array") and key not in NOT_IN_RERUN
            for row in rows if shown else ():
                values = row.get(key) if isinstance(row.get(key), list) else [row.get(key)]
                # Rerun's scalars are 64-bit floats.
                values = [value if value is None else float(value) for value in values]
                if values != [None] and len(values) <= 8:
                    expected.setdefault(entity, []).append((row["log_time_ns"] // 1000, values))
    assert {name.replace("\\", "") for name in found} == set(expected)
    for entity, series in found.items():
        truth = expected[entity.replace("\\", "")]
        assert len(series) == len(truth), entity
        for (t_us, values), (truth_us, truths) in zip(sorted(series, key=lambda row: row[0]), truth, strict=True):
            assert abs(t_us - truth_us) <= 1, entity
            assert all(map(same, values, truths)), (entity, values, truths)


def check_lerobot(one: Recorded, out: Path, ran: Any, mistake: Any) -> None:
    """Compare each row with the latest messages that were known then."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    rows = {topic: rows for topic, rows in one.rows().items() if live_topic(topic) in FEATURES}
    arguments = ("recording", "export", one.path, "--format", "lerobot", "--out", out / "lerobot")
    if not rows:
        assert "nothing to export" in mistake(*arguments)
        return
    ran(*arguments)
    table = parquet.read_table(out / "lerobot/data/chunk-000/file-000.parquet").to_pydict()
    features = json.loads((out / "lerobot/meta/info.json").read_text())["features"]
    began_ns = min(row["log_time_ns"] for series in rows.values() for row in series)
    ages = features["observation.age_s"]["names"]
    for topic, series in rows.items():
        live = live_topic(topic)
        feature, keys = FEATURES[live]
        name = ".".join(filter(None, (feature, topic.removeprefix(live).removeprefix("."))))
        names = features[f"observation.{name}"]["names"]
        known = sorted(
            (max(row["publish_time_ns"], row["log_time_ns"], row.get("arrival_unix_ns", 0)), n, row)
            for n, row in enumerate(series)
        )
        for number, vector in enumerate(table[f"observation.{name}"]):
            now_ns = began_ns + number * 40_000_000
            # The last row is the last message's own.
            held = [row for t_ns, _, row in known if t_ns <= now_ns or number == len(table["index"]) - 1]
            age = np.reshape(table["observation.age_s"][number], -1)[ages.index(name)]
            if not held:
                assert math.isnan(age)
                continue
            truth = held[-1]
            assert age == np.float32((now_ns - truth["log_time_ns"]) / 1e9)
            if live == "eit.frame" and "line" not in truth:
                assert np.isnan(np.array(vector, float)).all()
                continue
            if live == "eit.frame":
                line = np.array(truth["line"], float)
                expected = line[np.flatnonzero(channel_slots())]
                np.testing.assert_array_equal(np.array(vector, float), expected.astype(np.float32))
                continue
            values = dict(zip(names, np.reshape(vector, -1), strict=True))
            for key in keys.split():
                parts = truth.get(key) if isinstance(truth.get(key), list) else [truth.get(key)]
                if parts == [None] and f"{key}_0" in values:
                    parts = [None] * 6
                for i, part in enumerate(parts):
                    shown = values.pop(key if len(parts) == 1 else f"{key}_{i}")
                    assert same(float(shown), None if part is None else float(np.float32(part))), (name, key, number)
            assert not values


def channel_slots() -> np.ndarray:
    """Return which values of a line are channels: those whose pair touches no driven electrode."""
    slots = np.zeros(1024, bool)
    slots[PAPER_TABLE.line_slots] = True
    return slots


def check_live(one: Recorded) -> None:
    """Compare what `listen`, the page and the recording make of each published message."""
    recorded = one.by_stream()
    published = by_stream(one.published)
    assert recorded.keys() <= published.keys() or one.replayable
    assert len(recorded.keys() & published.keys()) >= 0.5 * len(recorded)
    store = MessageStore(3.6)
    for number, (stream, content) in enumerate(published.items()):
        topic = stream[0]
        received = decode(encode(content))
        listened = json.loads(message_json(topic, received), parse_constant=no_json)
        assert listened.pop("topic") == topic
        assert message_line(topic, received)
        store.add(topic, received, float(number))
        (paged,) = json.loads(store.batch(number, float(number)))["messages"]
        for shown in (listened, page_content(paged)):
            check_message(topic, shown, content, recorded.get(stream))


def check_replay(one: Recorded) -> None:
    """Compare all that a replay publishes with the recorded messages."""
    rows = one.rows()
    recorded = one.by_stream()
    again, comparison = asyncio.run(replayed(one.path, math.inf))
    assert not comparison.different, comparison.examples
    forwarded = 0
    for topic, content in again:
        row = recorded.get((topic, content["source"], content["seq"]))
        if row is None or topic in ("eit.frame", "eit.estimate", "eit.adapted", "load.torque", "skin.shear"):
            # A replay computes these again and numbers them from 0: compared bit for bit above.
            continue
        forwarded += 1
        for key in (key for key in content if not key.endswith("_shape")):
            assert same(value_of(content, key), row.get(key)), f"replayed {topic} {key}"
    computed = sum(comparison.compared.values())
    expected = sum(len(series) for topic, series in rows.items() if topic in TOPICS or live_topic(topic) in EIT)
    heatmaps = sum(len(series) for topic, series in rows.items() if live_topic(topic) == "eit.heatmap")
    assert computed + forwarded + heatmaps == expected


def check_slices(one: Recorded, out: Path, ran: Any) -> None:
    """Compare each slice with the held frames and torques, averaged here."""
    ran("recording", "export", one.path, "--format", "slices", "--out", out / "slices")
    rows = one.rows()
    states, frames, loads = rows["loop.state"], rows["eit.frame.right"], rows["load.torque"]
    tare = [row["t_mono_ns"] for row in states if row["step_name"] == "tare"]
    after = min(row["t_mono_ns"] for row in states if row["t_mono_ns"] > max(tare))
    half_ns = np.median(np.diff([row["t_mono_ns"] for row in frames])) / 2
    from_ns, to_ns = min(tare) + half_ns, after - half_ns
    rested = [row for row in frames if from_ns <= row["t_mono_ns"] <= to_ns and not row["repeated"]]
    rest = np.mean([row["line"] for row in rested], axis=0)
    held = [row["t_mono_ns"] for row in states if row["hold"]]
    end_ns = min(row["t_mono_ns"] for row in states if row["t_mono_ns"] > max(held))
    from_ns, to_ns = min(held) + half_ns, end_ns - half_ns
    during = [row for row in frames if from_ns <= row["t_mono_ns"] <= to_ns and not row["repeated"]]
    t_ns = np.array([row["t_mono_ns"] for row in during], float)
    at = (t_ns - (t_ns[0] + t_ns[-1]) / 2) / np.mean(np.diff(t_ns))
    weights = np.where(np.abs(at) <= 4.5, np.exp(-(at**2) / 2 / 1.8**2), 0)
    weights /= weights.sum()
    found = loadmat(out / "slices/torque_slices/Data_Slice_1.mat")
    expected = np.abs(weights @ np.array([row["line"] for row in during]) - rest)[channel_slots()]
    np.testing.assert_allclose(found["data_diff"][0], expected, atol=2e-4)
    torques = [row["torque_nm"] for row in loads if row["valid"] and min(held) < row["t_mono_ns"] < end_ns]
    assert min(torques) <= found["torque_value"].item() <= max(torques)


def check(one: Recorded, out: Path, ran: Any, mistake: Any) -> None:
    out.mkdir(exist_ok=True)
    check_live(one)
    check_tables(one, out, ran)
    check_rerun(one, out, ran)
    check_lerobot(one, out, ran, mistake)
    if one.replayable:
        check_replay(one)


@pytest.mark.long
def test_every_export_gives_back_every_topic_with_empty_keys_and_odd_texts(tmp_path, ran, mistake):
    one = made(tmp_path)
    assert {live_topic(topic) for topic in one.rows()} >= set(TOPICS)
    check(one, tmp_path / "out", ran, mistake)


def test_every_export_gives_back_a_recording_of_the_skin(tmp_path, ran, mistake):
    published = asyncio.run(test_skin_replay.recorded(tmp_path, socket=False, average_s=0.02))
    check(Recorded(latest_recording(tmp_path / "recordings"), published), tmp_path / "out", ran, mistake)


async def absent(path: Path) -> Published:
    """Return what a daemon publishes whose fingertip, load cell and gripper are not there."""
    published: Published = []
    async with running_daemon(path) as daemon:
        heard = asyncio.Event()

        def listen(topic: str, content: Row) -> None:
            published.append((topic, content))
            if topic == "health" and len(published) > 2:
                heard.set()

        daemon.publisher.add_listener(listen)
        await heard.wait()
    return published


@pytest.mark.long
@pytest.mark.usefixtures("ur_rtde")
def test_every_export_gives_back_a_recording_with_absent_devices(config, tmp_path, ran, mistake):
    robot_at(own_address(5), tmp_path)
    path = config(
        load_cell={"device": {"path": "no-load-cell"}},
        robot="ur.yaml",
        gripper={"model": "2F-140", "socket": {"host": own_address(5), "port": free_port()}},
        recording={"folder": str(tmp_path / "recordings")},
    )
    published = asyncio.run(absent(path))
    check(Recorded(latest_recording(tmp_path / "recordings"), published), tmp_path / "out", ran, mistake)


async def twisted(config: Path, bank: Path, path: Path) -> tuple[Published, Watched]:
    """Return what the daemon of an emulated rig publishes during an experiment, and what is heard of it."""
    async with watching(config.parent) as watched:
        async with running_rig(config, bank) as (_, watcher, _fault, command):
            # Whoever is connected late on a busy computer misses the command.
            await watched.until_begun()
            await started(watcher, command, str(path))
            state = await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"))
            assert state["phase"] == "done", state["activity"]
        await watched.until_ended()
    return [(topic, content) for topic, contents in watcher.seen.items() for content in contents], watched


@pytest.mark.real_time
def test_every_export_gives_back_a_recording_of_the_whole_rig(rig_config, tiny_bank, tmp_path, ran, mistake):
    content = yaml.safe_load(rig_config.read_text())
    rig_config.write_text(yaml.safe_dump({**content, "recording": {"folder": str(tmp_path / "recordings")}}))
    twist = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.3, "hold_s": 1.5}
    path = Path(experiment(tmp_path, twist, {"do": "release"}))
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "slices": "torque"}))
    published, watched = asyncio.run(twisted(rig_config, tiny_bank, path))
    one = Recorded(latest_recording(tmp_path / "recordings"), published)
    watched.check(one, ON_THE_RIG, {"eit.frame"})
    check(one, tmp_path / "out", ran, mistake)
    check_slices(one, tmp_path / "out", ran)
