"""Exports for Rerun and LeRobot, and the server for Foxglove, each read by another program's reader."""

import asyncio
import contextlib
import csv
import dataclasses
import io
import json
import os
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli import main
from shearloop.daemon.messaging.messages import TOPICS, decode, encode, units, wire_map
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import McapFile
from shearloop.errors import UserError
from tests.sample_messages import sample

CONFIG = Path(__file__).parents[3] / "config"
START_NS = 10**18
FRAMES = np.round(np.random.default_rng(0).uniform(0.01, 0.5, (4, 1024)), 4)
SCORES = np.array([[0.0, 0.25, 1e-5], [-0.5, np.nan, 1.0]])
SENSORS = ("eit.frame", "eit.heatmap", "eit.estimate")
RIG = (*SENSORS, "load.torque", "robot.state", "gripper.state", "loop.state", "health", "skin.shear")


def write(path: Path, topics: tuple[str, ...]) -> Path:
    """Write a recording of 2 s: each topic at 0.5 s intervals, known 0.1 s after its measurement."""
    file = McapFile(io.FileIO(f"{path}.partial", "wb"))
    file.add_metadata(schema.METADATA, {**schema.basic_identity("a bench"), "bank_right": "b4nk"})
    file.add_metadata(schema.EXPERIMENT_METADATA, {"name": "hold"})
    configuration = b'{"fingertips": {"right": {"device": {"serial_number": "K1"}}}}'
    file.attach(schema.CONFIGURATION, "application/json", configuration, START_NS)
    file.attach("/srv/../right.cal", "application/octet-stream", b"cal", START_NS)
    for i in range(4):
        for topic in topics:
            source = "right" if topic in SENSORS else "one"
            changes: dict[str, Any] = {"channels": FRAMES[i], "line": FRAMES[i]} if topic == "eit.frame" else {}
            changes |= {"model": "linear", "scores": SCORES} if topic == "eit.heatmap" else {}
            changes |= {"torque_nm": None, "valid": False} if topic == "eit.estimate" and i == 3 else {}
            t_ns = i * 500_000_000
            wire = wire_map(sample(TOPICS[topic], source=source, t_mono_ns=t_ns, **changes), t_ns / 1e9, i)
            data = schema.message_json(topic, wire, START_NS)
            log_ns = START_NS + t_ns
            file.add(schema.recorded_topic(topic, source), log_ns, log_ns + 100_000_000, data)
    file.close(path)
    return path


@pytest.fixture(scope="module")
def foxglove_runtime() -> None:
    """Start the SDK's threads and files, which stay until the process ends."""
    foxglove = pytest.importorskip("foxglove", reason="needs the extra `foxglove`")
    foxglove.start_server(port=0, context=foxglove.Context()).stop()


@pytest.mark.usefixtures("rerun_runtime")
@pytest.mark.parametrize("topics", [RIG, ("eit.frame", "eit.estimate")], ids=["rig", "fingertip"])
def test_rerun_reads_scalars_images_and_the_pose(topics, tmp_path):
    from rerun import chunk

    recording = write(tmp_path / "a.mcap", topics)
    assert main(["recording", "export", str(recording), "--format", "rrd"]) == 0
    reader = chunk.RrdReader(tmp_path / "a.rrd")
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    rows: dict[str, int] = {}
    chunks = reader.stream().to_chunks()
    for one in chunks:
        rows[one.entity_path] = rows.get(one.entity_path, 0) + one.num_rows * (not one.is_static)
    assert (rows["/eit/estimate/right/torque_nm"], rows["/eit/estimate/right/torque_low_nm"]) == (3, 4)
    assert rows.get("/robot/state/tool_centre") == (4 if topics == RIG else None)
    drawn = {"/eit/heatmap/right/scores", "/eit/estimate/right/conductivity"}
    assert drawn & rows.keys() == (drawn if topics == RIG else set())
    assert not any("channels" in entity or "line" in entity for entity in rows)
    if topics == RIG:
        image = columns(chunks, "/eit/heatmap/right/scores")
        assert image["Image:buffer"] == [[[0, 64, 0, 0, 0, 255]]] * 4
        assert {(one["width"], one["height"]) for (one,) in image["Image:format"]} == {(3, 2)}
        pose = columns(chunks, "/robot/state/tool_centre")
        np.testing.assert_allclose(pose["Transform3D:translation"], [[[0, 1, 2]]] * 4)
        turn = Rotation.from_rotvec([3, 4, 5]).as_quat()
        np.testing.assert_allclose(pose["Transform3D:quaternion"], [[turn]] * 4, rtol=1e-6)


@pytest.mark.usefixtures("rerun_runtime")
def test_a_chart_of_rerun_holds_the_keys_of_one_unit(tmp_path, rerun_charts, ran):
    ran("recording", "export", write(tmp_path / "a.mcap", RIG), "--format", "rrd")
    shown = {name: {unit_of(entity) for entity in chart} for name, chart in rerun_charts.items()}
    assert shown == {"torque (N·m)": {"N·m"}, "diameter (mm)": {"mm"}, "shear force (N)": {"N"}, "angle (rad)": {"rad"}}
    assert "loop/state/stiffness_nm_per_rad" not in {one for chart in rerun_charts.values() for one in chart}


def unit_of(entity: str) -> str:
    """Return the unit of an entity of a scalar."""
    topic, _, key = entity.rpartition("/")
    return units(schema.schema_name(topic.replace("/", ".")))[key]


def columns(chunks: list[Any], entity: str) -> dict[str, list[Any]]:
    """Return the values of an entity that change with time, by component."""
    (one,) = (one for one in chunks if one.entity_path == entity and not one.is_static)
    return one.to_record_batch().to_pydict()


def test_tables_hold_every_score_of_a_heatmap(tmp_path, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    monkeypatch.setattr("shearloop.tools.recordings.export._BATCH", 30)
    recording = write(tmp_path / "a.mcap", RIG)
    assert [main(["recording", "export", str(recording), "--format", form]) for form in ("csv", "parquet")] == [0, 0]
    with (tmp_path / "a_csv/eit.heatmap.right.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = [[float(row[f"scores_{i}"] or "nan") for i in range(6)] for row in rows]
    np.testing.assert_array_equal(found, [SCORES.ravel()] * 4)
    assert [row["model"] for row in rows] == ["linear"] * 4
    table = parquet.read_table(tmp_path / "a_parquet/eit.heatmap.right.parquet").to_pydict()
    np.testing.assert_array_equal(np.array(table["scores"], dtype=float), found)


def test_a_large_recording_continues_in_further_matlab_files(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("shearloop.tools.recordings.export._MAT_SIZE", 10_000)
    arguments = ["recording", "export", str(write(tmp_path / "a.mcap", RIG)), "--format", "mat"]
    assert main(arguments) == 0
    files = list(map(Path, capsys.readouterr().out.splitlines()))
    assert files == [tmp_path / "a.mat", tmp_path / "a_2.mat"]
    structs = [loadmat(file, simplify_cells=True) for file in files]
    scores = np.concatenate([np.atleast_2d(one["eit_heatmap_right"]["scores"]) for one in structs])
    np.testing.assert_array_equal(scores, [SCORES.ravel()] * 4)
    assert main(arguments) == 2
    assert "a_2.mat exists and would look like a part of this export; remove it" in capsys.readouterr().err


def test_a_dataset_holds_what_was_known_and_names_its_origin(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    recording = write(tmp_path / "a.mcap", RIG)
    assert main(["recording", "export", str(recording), "--format", "lerobot"]) == 0
    folder = tmp_path / "a_lerobot"
    info = json.loads((folder / "meta/info.json").read_text())
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pydict()
    columns = {name: np.array(values) for name, values in rows.items()}
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 25, len(rows["index"]))
    assert {name: values.shape[1:] for name, values in columns.items() if name.startswith("observation.")} == {
        name: tuple(one["shape"]) for name, one in info["features"].items() if name.startswith("observation.")
    }
    estimates = info["features"]["observation.estimate.right"]["names"]
    torque, valid = columns["observation.estimate.right"][:, [estimates.index("torque_nm"), estimates.index("valid")]].T
    # Before 0.1 s no estimate is known; the last one, at 1.6 s, is not valid.
    np.testing.assert_array_equal(valid, (np.arange(len(valid)) >= 3) & (np.arange(len(valid)) < 40))
    np.testing.assert_array_equal(np.isnan(torque), valid == 0)
    age = columns["observation.age_s"][:, info["features"]["observation.age_s"]["names"].index("estimate.right")]
    np.testing.assert_allclose(age[[3, 14, 15, 16]], [0.12, 0.56, 0.10, 0.14], atol=1e-6)
    # A frame arrives half a second after its measurement, by the sample's age.
    frame = PAPER_TABLE.channels_of_line(FRAMES[0]).astype(np.float32)
    np.testing.assert_array_equal(columns["observation.channels.right"][13], frame)
    statistics = json.loads((folder / "meta/stats.json").read_text())["observation.estimate.right"]
    assert statistics["mean"][estimates.index("torque_nm")] == pytest.approx(np.nanmean(torque))
    assert statistics["std"][estimates.index("valid")] == pytest.approx(np.std(valid))
    about = json.loads((folder / "meta/shearloop.json").read_text())
    assert about["identity"]["bank_right"] == "b4nk"
    assert about["configuration"]["fingertips"]["right"]["device"]["serial_number"] == "K1"
    assert (folder / "meta/attachments/srv/right.cal").read_bytes() == b"cal"
    (task,) = parquet.read_table(folder / "meta/tasks.parquet").to_pylist()
    assert task == {"task_index": 0, "task": "hold"}


def test_absent_topics_are_left_out_of_a_dataset_and_none_is_refused(tmp_path, ran, mistake):
    pytest.importorskip("pyarrow", reason="needs the extra `export`")
    recording = write(tmp_path / "a.mcap", ("eit.frame", "health"))
    ran("recording", "export", recording, "--format", "lerobot")
    info = json.loads((tmp_path / "a_lerobot/meta/info.json").read_text())
    named = {name for name in info["features"] if name.startswith("observation.")}
    assert named == {"observation.channels.right", "observation.age_s"}
    assert "a dataset needs one of the topics robot.state, eit.estimate" in mistake(
        "recording", "export", recording, "--format", "lerobot", "--topic", "health"
    )


@pytest.mark.parametrize(("form", "extra"), [("rrd", "rerun"), ("lerobot", "export"), ("parquet", "export")])
def test_a_missing_extra_is_named(form, extra, tmp_path, mistake, monkeypatch):
    recording = write(tmp_path / "a.mcap", ("eit.frame",))
    monkeypatch.setattr("shearloop.extras.find_spec", lambda _: None)
    assert f"pip install 'shearloop[{extra}]'" in mistake("recording", "export", recording, "--format", form)
    assert "pip install 'shearloop[foxglove]'" in mistake("view", "--foxglove", "0")


def open_sockets() -> set[str]:
    """Return the sockets of this process."""
    found: set[str] = set()
    for name in os.listdir("/proc/self/fd"):
        # The listing's own descriptor is gone.
        with contextlib.suppress(FileNotFoundError):
            found.add(os.readlink(f"/proc/self/fd/{name}"))
    return {name for name in found if name.startswith("socket:")}


@pytest.mark.usefixtures("foxglove_runtime")
async def test_foxglove_gets_the_schema_and_each_message():
    """By the WebSocket protocol of Foxglove: a channel with its schema, then time and payload of each message."""
    aiohttp = pytest.importorskip("aiohttp", reason="needs the extra `view`")
    from shearloop.daemon.web.foxglove import FoxgloveServer

    message = sample(TOPICS["eit.heatmap"], source="right", t_mono_ns=10**9)
    content = decode(encode(wire_map(message, 1.5, 7)))
    sockets_before = open_sockets()
    with FoxgloveServer(0) as server:
        with pytest.raises(UserError, match=r"--foxglove"):
            FoxgloveServer(server.port)
        server.publish("unknown", content)
        server.publish("eit.heatmap", content)
        url = f"ws://127.0.0.1:{server.port}"
        async with (
            asyncio.timeout(20),
            aiohttp.ClientSession() as http,
            http.ws_connect(url, protocols=["foxglove.sdk.v1"]) as socket,
        ):
            while (message := await socket.receive_json())["op"] != "advertise":
                pass
            (channel,) = message["channels"]
            assert (channel["topic"], channel["encoding"]) == ("eit.heatmap.right", "json")
            assert json.loads(channel["schema"]) == schema.schemas()["eit.heatmap"]
            subscription = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel["id"]}]}
            await socket.send_json(subscription)
            received = None
            while received is None:
                # A subscription that is on its way misses messages.
                server.publish("eit.heatmap", content)
                with contextlib.suppress(TimeoutError):
                    received = await socket.receive_bytes(timeout=0.2)
    async with asyncio.timeout(20):
        # The server's own thread closes its connections.
        while not open_sockets() <= sockets_before:  # noqa: ASYNC110 - no event tells of it
            await asyncio.sleep(0.01)
    code, subscribed, t_ns = struct.unpack_from("<BIQ", received)
    assert (code, subscribed, t_ns) == (1, 1, 1_500_000_000)
    assert json.loads(received[13:])["scores_shape"] == [2, 3]


def test_the_layout_names_topics_and_keys_that_exist():
    panels = json.loads((CONFIG / "foxglove.json").read_text(encoding="utf-8"))["configById"].values()
    paths = [line["value"] for panel in panels for line in panel.get("paths", ())]
    assert len(paths) > 5
    for path in paths:
        topic, key = re.fullmatch(r'"(.+)"\.(\w+)', path).groups()
        assert key in {item.name for item in dataclasses.fields(TOPICS[schema.schema_name(topic)])}, path
