"""Each column of an export names the unit that its message declares."""

import csv
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

import shearloop
from shearloop.daemon.messaging.messages import TOPICS
from tests.tools.recordings.every_message import live_topic, made

# Of keys that the recorder adds, and of the envelope.
TIMES = {"log_time_ns": "ns", "t_mono_ns": "ns", "arrival_unix_ns": "ns", "offset_ns": "ns", "suspended_ns": "ns"}
# The topics of a LeRobot dataset.
FEATURED = ("robot.state", "eit.estimate", "eit.frame", "load.torque", "skin.shear", "gripper.state")
Units = dict[str, dict[str, str]]


def declared(columns: Units) -> Units:
    """Return the units of each topic's columns, from the messages' declarations."""
    found: Units = {}
    for topic, keys in columns.items():
        kind = TOPICS.get(live_topic(topic))
        own = {one.name: one.metadata.get("unit", "") for one in dataclasses.fields(kind)} if kind else {}
        every = {**own, **TIMES, "timestamp": "s"}
        found[topic] = {key: every[key] for key in ("log_time_ns", *keys) if every.get(key)}
    return found


def csv_units(path: Path) -> Units:
    found: Units = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file, strict=True):
            found.setdefault(row["topic"], {})[row["column"]] = row["unit"]
    return found


def check_table_units(path: Path, out: Path, expected: Units, ran: Callable[..., object]) -> None:
    """Export a recording as tables, and compare the unit of each column with the expected one."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    for form in ("csv", "parquet", "mat"):
        ran("recording", "export", path, "--format", form, "--out", out / form)
    assert csv_units(out / "csv" / "units.csv") == expected
    read = shearloop.read(path)
    (structs,) = loadmat(out / "mat.mat", squeeze_me=True)["units"].reshape(1)
    assert len(structs.dtype.names) == len(expected)
    for topic, units in expected.items():
        fields = parquet.read_schema(out / "parquet" / f"{topic}.parquet")
        assert {field.name: field.metadata[b"unit"].decode() for field in fields if field.metadata} == units
        struct = structs[topic.replace(".", "_").replace("-", "_")]
        assert {key: str(struct[key]) for key in struct.dtype.names} == units
        assert read.units(topic) == units


def test_units_are_of_the_columns_that_an_imported_recording_has(tmp_path, ran):
    seconds = 0.54 * np.arange(30)
    volts = np.random.default_rng(0).uniform(0.1, 0.5, (30, 1024))
    savemat(tmp_path / "right.mat", {"Right_Data": np.column_stack([739_000 + seconds / 86400, volts])})
    ran("recording", "import", "mat", tmp_path / "right.mat", "--out", tmp_path / "a.mcap")
    ran("recording", "export", tmp_path / "a.mcap", "--out", tmp_path / "x")
    ran("recording", "export", tmp_path / "a.mcap", "--format", "mat", "--out", tmp_path / "x.mat")
    structs = loadmat(tmp_path / "x.mat", squeeze_me=True)
    for topic, units in csv_units(tmp_path / "x/units.csv").items():
        header = (tmp_path / f"x/{topic}.csv").read_text().partition("\r\n")[0].split(",")
        assert units.keys() <= {re.sub(r"_\d+$", "", column) for column in header}
        name = topic.replace(".", "_")
        assert set(structs["units"][name].item().dtype.names) <= set(structs[name].dtype.names)


def test_tables_of_an_earlier_export_keep_their_units(tmp_path, ran):
    one = made(tmp_path).path
    ran("recording", "export", one, "--out", tmp_path / "x")
    whole = csv_units(tmp_path / "x/units.csv")
    gone, other, last = list(whole)[:3]
    (tmp_path / f"x/{gone}.csv").unlink()
    ran("recording", "export", one, "--topic", other, "--out", tmp_path / "x")
    assert csv_units(tmp_path / "x/units.csv") == {topic: units for topic, units in whole.items() if topic != gone}
    ran("recording", "export", one, "--topic", last, "--topic", gone, "--out", tmp_path / "x")
    assert csv_units(tmp_path / "x/units.csv") == whole


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"my own notes\n", "units.csv exists and is not the units"),
        (b"topic,column,unit\n\xff", "units cannot be read"),
    ],
)
def test_another_table_of_units_is_refused_and_stays(content, said, tmp_path, mistake):
    (tmp_path / "x").mkdir()
    (tmp_path / "x/units.csv").write_bytes(content)
    assert said in mistake("recording", "export", made(tmp_path).path, "--out", tmp_path / "x")
    assert (tmp_path / "x/units.csv").read_bytes() == content
    assert [path.name for path in (tmp_path / "x").iterdir()] == ["units.csv"]


def test_each_way_out_has_the_messages_units(tmp_path, ran):
    one = made(tmp_path)
    expected = declared(one.columns())
    assert expected["eit.frame.right"]["channels"] == "V"
    assert expected["robot.state"]["wrench"] == "N, N·m"
    check_table_units(one.path, tmp_path, expected, ran)
    ran("recording", "export", one.path, "--format", "lerobot", "--out", tmp_path / "lerobot")
    features = json.loads((tmp_path / "lerobot/meta/shearloop.json").read_text())["units"]
    assert features["observation.channels.right"] == {"channels": "V"}
    assert features["observation.load"] == {"torque_nm": "N·m"}
    assert features["observation.state"].items() <= expected["robot.state"].items()
    assert len(features) == sum(live_topic(topic) in FEATURED for topic in expected)
