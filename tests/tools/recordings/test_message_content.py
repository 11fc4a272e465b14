"""Contents that no recorder writes are refused with one sentence, and what is taken has the type of its column."""

import json
import math
import re
from io import FileIO
from typing import Any

import pytest

from shearloop.daemon.messaging.messages import TOPICS, wire_map
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.schema import basic_identity
from shearloop.daemon.recorder.writer import McapFile
from shearloop.drivers.serial_sensor import InputKind
from shearloop.tools.recordings import message_content, replay
from shearloop.tools.recordings.message_content import read_content
from shearloop.tools.recordings.recorded_columns import ContentError
from shearloop.tools.recordings.recorded_columns import own_columns as columns
from tests.sample_messages import sample
from tests.tools.recordings.every_message import made
from tests.tools.recordings.test_damage import recorded

STRANGE: list[Any] = [
    *(2**70, -(2**70), 2**63, 10**400, 1e308, -1, 1.5, True, None, "x", "\ud800", [], [[1, 2], [3]], [1, [2]], [None]),
    *([2**64], ["x"], [True], {}, {"a": [1]}, [math.inf], [1.0, None, math.nan], [1, math.inf]),
]
PYTHON = {"number": float, "integer": int, "boolean": bool, "string": str, "object": dict, "array": list}


@pytest.mark.parametrize("topic", TOPICS)
def test_each_key_takes_its_own_type_alone(topic):
    content = json.loads(schema.message_json(topic, wire_map(sample(TOPICS[topic]), 1.5, 3), 0))
    name = schema.recorded_topic(topic, "right")
    assert read_content(name, json.dumps(content).encode()).keys() == columns(topic).keys()
    for key, column in columns(topic).items():
        for value in STRANGE:
            try:
                found = read_content(name, json.dumps({**content, key: value}).encode())[key]
            except ContentError:
                continue
            assert type(found) is PYTHON[column.kind] or (found is None and column.optional), (key, value)
            if column.kind in ("integer", "number"):
                assert math.isfinite(found or 0)
                assert column.kind == "number" or abs(found) < 2**63
            if column.kind == "array":
                assert all(math.isfinite(one or 0) for one in found or []), (key, value)
        # Without a source it is an import's.
        if not column.optional and key != "source":
            with pytest.raises(ContentError, match=f"lacks the key '{key}'"):
                read_content(name, json.dumps({one: content[one] for one in content if one != key}).encode())
    with pytest.raises(ContentError, match="unknown key 'other'"):
        read_content(name, json.dumps({**content, "other": 1}).encode())


def test_the_bytes_of_an_input_are_latin_1_text():
    content = {"t_mono_ns": 1, "kind": InputKind.DATA.value, "data": "".join(map(chr, range(256)))}
    assert read_content("input.right", json.dumps(content).encode())["data"].encode("latin-1") == bytes(range(256))
    with pytest.raises(ContentError, match="data is '1€', not bytes as Latin-1 text"):
        read_content("input.right", json.dumps({**content, "data": "1€"}).encode())


@pytest.mark.parametrize("form", ["csv", "parquet", "mat", "rrd", "lerobot", "replay"])
@pytest.mark.usefixtures("rerun_runtime")
@pytest.mark.parametrize(
    ("topic", "changes", "problem"),
    [
        ("eit.heatmap.right", {"scores_shape": [2, 2]}, "scores are no rectangle"),
        ("robot.state", {"t_mono_ns": 2**62}, "which no clock shows"),
        ("gripper.state", {"width_mm": [[1.0], 2.0]}, "width_mm is [[1.0], 2.0], not a number"),
        ("load.torque", {"other": 1}, "it has the unknown key 'other'"),
    ],
)
def test_every_way_out_refuses_a_strange_message(form, topic, changes, problem, config, tmp_path, mistake):
    for module in {"parquet": ["pyarrow"], "lerobot": ["pyarrow"]}.get(form, []):
        pytest.importorskip(module)
    rows = [
        (name, {key: value for key, value in row.items() if key not in ("log_time_ns", "publish_time_ns")})
        for name, series in made(tmp_path).rows().items()
        for row in series[:2]
        # Its arrival would be days from the other times.
        if not name.startswith("eit.frame")
    ]
    strange = [(name, {**row, **changes} if name == topic else row) for name, row in rows]
    path = recorded(tmp_path / "x.mcap", *strange)
    if form == "replay":
        arguments = ["--config", config(), "--publish", f"ipc://{tmp_path}/r", "--speed", "max"]
        said = mistake("recording", "replay", path, *arguments)
    elif form == "lerobot" and topic == "eit.heatmap.right":
        # A dataset has no heatmaps.
        return
    else:
        said = mistake("recording", "export", path, "--format", form, "--out", tmp_path / "out")
    assert problem in said
    assert f"{path}: a message cannot be used: {topic}, number " in said


@pytest.mark.parametrize("data", [b"[" * 10**6, b'{"a":' * 10**6, b'{"source":' + b"9" * 10**6 + b"}"])
def test_deep_messages_and_long_numbers_end_the_parser_at_once(data):
    """Its own bounds: neither the stack nor the time grows with the message."""
    with pytest.raises(ContentError, match="it is not JSON") as refused:
        read_content("load.torque", data)
    assert int(re.search(r"column (\d+)", str(refused.value))[1]) < 10_000, "where the parser gave up"


def test_a_message_beyond_all_sizes_is_not_parsed(monkeypatch):
    monkeypatch.setattr(message_content, "from_json", lambda _: pytest.fail("parsed"))
    with pytest.raises(ContentError, match="it has 16 MB, and at most 16 are read"):
        read_content("load.torque", b" " * ((16 << 20) + 1))


def test_a_configuration_beyond_all_sizes_is_not_parsed(tmp_path, mistake, monkeypatch):
    file = McapFile(FileIO(tmp_path / "x.partial", "xb"))
    file.identify(dict(basic_identity("a test")))
    keys = {f"key{number}": 1 for number in range(100_000)}
    file.attach("configuration.json", "application/json", json.dumps(keys).encode(), 0)
    file.close(tmp_path / "x.mcap")
    monkeypatch.setattr(replay, "validated", lambda *_, **__: pytest.fail("validated"))
    said = mistake("recording", "replay", tmp_path / "x.mcap", "--publish", f"ipc://{tmp_path}/r")
    assert "its configuration has 1453 kB: no daemon wrote it" in said
