"""Writes a recording as a LeRobotDataset v3.0 of one episode: 25 rows a second, each with the latest messages.

The format is the library lerobot's. A message counts from the moment when the daemon had it, and a
policy could have used it. Missing values are NaN, and `valid` is 1 or 0.
"""

import heapq
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.channels import ChannelTable
from shearloop.daemon.messaging.messages import (
    EitEstimate,
    EitFrame,
    GripperStateMessage,
    LoadTorque,
    RobotStateMessage,
    SkinShear,
)
from shearloop.daemon.recorder import schema
from shearloop.errors import UserError
from shearloop.extras import require
from shearloop.files import replace_file
from shearloop.tools.outputs import LentFile, check_apart, check_link, lent_file, new_folder
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.message_content import check_length
from shearloop.tools.recordings.reader import open_recording, read_messages, refusing_content
from shearloop.tools.recordings.recorded_columns import ContentError, TopicColumns, own_name

ROWS_PER_S = 25
_PERIOD_NS = 10**9 // ROWS_PER_S
# Experiments take hours.
_LONGEST_NS = 24 * 3600 * 10**9
# Rows that are written at once: a minute.
_BATCH = 1500
_FILE = "chunk-000/file-000.parquet"
_AGE = "observation.age_s"
# The feature of each topic and its keys.
_FEATURES: Mapping[str, tuple[str, str]] = {
    RobotStateMessage.topic: (
        "state",
        "joints_rad tcp_pose wrench wrist_rad wrist_speed_rad_per_s wrist_torque_nm wrist_torque_valid",
    ),
    EitEstimate.topic: (
        "estimate",
        "torque_nm torque_low_nm torque_high_nm diameter_mm diameter_low_mm diameter_high_mm k sigma score valid",
    ),
    EitFrame.topic: ("channels", ""),
    LoadTorque.topic: ("load", "torque_nm valid"),
    SkinShear.topic: ("skin", "shear_n shear_low_n shear_high_n torque_nm valid"),
    GripperStateMessage.topic: (
        "gripper",
        "width_mm diameter_mm diameter_std_mm tool_diameter_mm tool_diameter_std_mm current_ma",
    ),
}
# Keys of six numbers.
_VECTORS, _VECTOR = ("joints_rad", "tcp_pose", "wrench"), 6

# When the daemon had a message, its number, topic and content, and when it was measured.
_Known: TypeAlias = tuple[int, int, str, dict[str, Any], int]


class _Held:
    """The latest message of one topic as numbers, NaN before the first."""

    def __init__(self, topic: str, columns: TopicColumns, table: ChannelTable) -> None:
        live = schema.schema_name(topic)
        name, keys = _FEATURES[live]
        source = topic.removeprefix(live).removeprefix(".")
        self.feature = ".".join(filter(None, ("observation", name, source)))
        self._table = table if live == EitFrame.topic else None
        self._keys = keys.split()
        self.names = [f"channel_{i}" for i in range(table.n_channels)] if self._table else []
        for key in self._keys:
            self.names += [f"{key}_{i}" for i in range(_VECTOR)] if key in _VECTORS else [key]
        # By the keys of the message; those of another unit have no value.
        own = columns.own
        self.units = {key: own[key].unit for key in (self._keys or ["channels"]) if own[key].unit}
        self._columns = columns
        values = [0.0 if name == "valid" else np.nan for name in self.names]
        self.vector: NDArray[np.float32] = np.array(values, dtype=np.float32)
        self.measured_ns: int | None = None

    def hold(self, content: Mapping[str, Any], measured_ns: int) -> None:
        """Keep a message; a value that it does not have is NaN."""
        content = self._columns.known(content)
        if self._table is not None:
            vector = np.full(self._table.n_channels, np.nan)
            if content["line"] is not None:
                line = np.array(content["line"], dtype=np.float64)
                check_length("line", len(line), self._table.n_line_values)
                vector = self._table.channels_of_line(line)
        else:
            # An imported torque has no `valid`, and counts as valid.
            vector = np.concatenate([self._numbers(key, content.get(key, key == "valid")) for key in self._keys])
        # A number beyond float32 becomes infinite.
        with np.errstate(over="ignore"):
            self.vector = vector.astype(np.float32)
        self.measured_ns = measured_ns

    def arrival_ns(self, content: Mapping[str, Any]) -> int:
        """Return when a message's last byte arrived (Unix ns), 0 if it does not say so."""
        return self._columns.known(content).get(schema.ARRIVAL) or 0

    @staticmethod
    def _numbers(key: str, value: Any) -> NDArray[np.float64]:
        """Return the value of a key as numbers; raises ContentError for an array of another length."""
        size = _VECTOR if key in _VECTORS else 1
        if value is None:
            return np.full(size, np.nan)
        numbers = np.ravel(np.array(value, dtype=np.float64))
        check_length(key, len(numbers), size)
        return numbers

    def age_s(self, now_ns: int) -> float:
        """Return the time since the measurement, NaN without one."""
        return np.nan if self.measured_ns is None else (now_ns - self.measured_ns) / 1e9


class _Statistics:
    """Minimum, maximum, mean and standard deviation of each column over its finite values, for any number of rows."""

    def __init__(self, width: int) -> None:
        self._rows = 0
        self._n, self._sum, self._squares = np.zeros((3, width))
        self._min, self._max = np.full((2, width), np.nan)

    def add(self, rows: NDArray[Any]) -> None:
        """Take (n, width) values."""
        values = np.where(np.isfinite(rows), np.asarray(rows, dtype=np.float64), np.nan)
        self._rows += len(rows)
        self._n += np.isfinite(values).sum(axis=0)
        self._sum += np.nansum(values, axis=0)
        self._squares += np.nansum(values**2, axis=0)
        self._min = np.fmin(self._min, np.fmin.reduce(values))
        self._max = np.fmax(self._max, np.fmax.reduce(values))

    def result(self) -> dict[str, list[float]]:
        """Return the statistics by their names; 0 for a column without a value, for NaN is no JSON."""
        n = np.maximum(self._n, 1)
        mean = self._sum / n
        std = np.sqrt(np.maximum(self._squares / n - mean**2, 0.0))
        named = {"min": self._min, "max": self._max, "mean": mean, "std": std}
        return {**{name: np.nan_to_num(values).tolist() for name, values in named.items()}, "count": [self._rows]}


def export_lerobot(path: Path, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics of a recording as a dataset in the folder `out` and return its files; others are left out.

    Raises OSError for files that cannot be written, and UserError without pyarrow, for a recording that cannot be
    read, for one of more than 24 hours, and for one without a topic of a dataset; then no file is new or changed.
    """
    require("pyarrow", "export", "a LeRobot dataset")
    with open_recording(path) as recording:
        attachments = recording.attachments()
        used = [topic for topic in topics if own_name(topic) in _FEATURES]
        held = {topic: _Held(topic, recording.columns(topic), recording.table) for topic in used}
        try:
            configuration = json.loads(attachments.pop(schema.CONFIGURATION, b"null"))
        except (ValueError, RecursionError) as error:
            raise ContentError(f"the attachment {schema.CONFIGURATION} is not JSON ({error})") from error
    if not held:
        raise UserError(f"{path}: nothing to export; a dataset needs one of the topics {', '.join(_FEATURES)}")
    _check_span(path, held)
    experiment = recording.metadata.get(schema.EXPERIMENT_METADATA, {}).get("name", "no experiment")
    units = {message.feature: message.units for message in held.values()}
    about = {"recording": path.name, "identity": recording.identity, "configuration": configuration, "units": units}
    with ExitStack() as files:
        dataset = Dataset(path, out, held, files)
        dataset.write_rows(path, progress)
        return dataset.finish(experiment, about, attachments)


def _check_span(path: Path, topics: Iterable[str]) -> None:
    """Raise UserError for a recording that is too long, before a row of it is computed."""
    first_ns: int | None = None
    with open_recording(path) as recording:
        for _, message in recording.messages(topics):
            first_ns = message.log_time if first_ns is None else first_ns
            _check_length(path, first_ns, max(message.publish_time, message.log_time))


def _check_length(path: Path, first_ns: int, known_ns: int) -> None:
    if known_ns - first_ns > _LONGEST_NS:
        hours = (known_ns - first_ns) / 3.6e12
        raise UserError(
            f"{path}: its messages span {hours:.0f} hours, and a dataset holds 24 at most; export it with "
            "--format parquet"
        )


class Dataset:
    """The files of a dataset of one episode."""

    def __init__(self, recording: Path, out: Path, held: Mapping[str, _Held], replaced: ExitStack) -> None:
        """Take the recording, which no file replaces, the folder, and what replaces its files at the end."""
        import pyarrow as pa

        self._recording, self._out = recording, out
        self._files: list[Path] = []
        self._replaced = replaced
        self._held = held
        vectors = {message.feature: ("float32", message.names) for message in held.values()}
        vectors[_AGE] = ("float32", [message.feature.removeprefix("observation.") for message in held.values()])
        indices = dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", [""]))
        self._columns = {**vectors, "timestamp": ("float32", [""]), **indices}
        self._statistics = {name: _Statistics(len(names)) for name, (_, names) in self._columns.items()}
        fields = []
        for name, (dtype, names) in self._columns.items():
            value = pa.type_for_alias(dtype)
            fields.append((name, value if len(names) == 1 else pa.list_(value, len(names))))
        self._schema = pa.schema(fields)
        self._n_rows = 0
        self._started_ns = 0

    def write_rows(self, path: Path, progress: Progress) -> None:
        """Write the table of all rows, a row group for each minute."""
        import pyarrow.parquet as pq

        rows: list[list[NDArray[np.float32]]] = []
        now_ns = -1
        with pq.ParquetWriter(self._lent(f"data/{_FILE}"), self._schema, compression="zstd") as writer:
            for known_ns, _, topic, content, measured_ns in self._known_messages(path, progress):
                now_ns = max(now_ns, self._started_ns)
                while now_ns < known_ns:
                    rows.append(self._row(now_ns))
                    now_ns += _PERIOD_NS
                    if len(rows) == _BATCH:
                        writer.write_table(self._table(rows))
                        rows.clear()
                with refusing_content(path, topic):
                    self._held[topic].hold(content, measured_ns)
            if now_ns >= 0:
                rows.append(self._row(now_ns))
                writer.write_table(self._table(rows))

    def finish(self, task: str, about: Mapping[str, Any], attachments: Mapping[str, bytes]) -> list[Path]:
        """Write the descriptions of the rows, the episode and the recording; return all files."""
        statistics = {name: statistic.result() for name, statistic in self._statistics.items()}
        self._write_json("meta/info.json", self._info())
        self._write_json("meta/stats.json", statistics)
        self._write_json("meta/shearloop.json", {**about, "started_unix_ns": self._started_ns})
        for name, data in attachments.items():
            parts = [part for part in Path(name).parts if part not in ("/", "..")]
            self._new("/".join(("meta/attachments", *parts))).write(data)
        self._write_tasks(task)
        files = dict.fromkeys(("data/chunk_index", "data/file_index"), 0)
        files |= dict.fromkeys(("meta/episodes/chunk_index", "meta/episodes/file_index"), 0)
        rows = {"dataset_from_index": 0, "dataset_to_index": self._n_rows, "length": self._n_rows}
        episode = {"episode_index": 0, "tasks": [task], **rows, **files}
        flat = {f"stats/{name}/{key}": value for name, found in statistics.items() for key, value in found.items()}
        self._write_table(f"meta/episodes/{_FILE}", {**episode, **flat})
        return self._files

    def _known_messages(self, path: Path, progress: Progress) -> Iterator[_Known]:
        """Yield the messages by the time when the daemon had them, not by their measurement."""
        waiting: list[_Known] = []
        for number, (topic, content, message) in enumerate(read_messages(path, self._held, progress)):
            if number == 0:
                self._started_ns = message.log_time
            arrival_ns = self._held[topic].arrival_ns(content)
            known_ns = max(message.publish_time, message.log_time, arrival_ns)
            # An arrival has its own time.
            _check_length(path, self._started_ns, known_ns)
            heapq.heappush(waiting, (known_ns, number, topic, content, message.log_time))
            while waiting[0][0] < message.log_time:
                yield heapq.heappop(waiting)
        while waiting:
            yield heapq.heappop(waiting)

    def _row(self, now_ns: int) -> list[NDArray[np.float32]]:
        ages = np.array([message.age_s(now_ns) for message in self._held.values()], dtype=np.float32)
        return [*(message.vector for message in self._held.values()), ages]

    def _table(self, rows: list[list[NDArray[np.float32]]]) -> Any:
        """Return a table of rows, and count them in the statistics."""
        import pyarrow as pa

        index = np.arange(self._n_rows, self._n_rows + len(rows))
        none = np.zeros(len(rows), dtype=np.int64)
        arrays = [*map(np.array, zip(*rows, strict=True)), index / ROWS_PER_S, index, none, index, none]
        self._n_rows += len(rows)
        columns = []
        for (name, (dtype, names)), values in zip(self._columns.items(), arrays, strict=True):
            matrix = np.ascontiguousarray(values.reshape(len(rows), len(names)), dtype=dtype)
            self._statistics[name].add(matrix)
            flat = pa.array(matrix.ravel())
            columns.append(flat if len(names) == 1 else pa.FixedSizeListArray.from_arrays(flat, len(names)))
        return pa.Table.from_arrays(columns, schema=self._schema)

    def _info(self) -> dict[str, Any]:
        features = {
            name: {"dtype": dtype, "shape": [len(names)], "names": names if any(names) else None}
            for name, (dtype, names) in self._columns.items()
        }
        robot = "ur" if RobotStateMessage.topic in self._held else None
        return {
            "codebase_version": "v3.0", "robot_type": robot, "fps": ROWS_PER_S, "features": features,
            "total_episodes": 1, "total_frames": self._n_rows, "total_tasks": 1, "splits": {"train": "0:1"},
            "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", "video_path": None,
        }  # fmt: skip

    def _write_tasks(self, task: str) -> None:
        # LeRobot reads it with pandas, which takes the index from this description.
        types = {"task": ("unicode", "object"), "task_index": ("int64", "int64")}
        described = [
            {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
            for name, (kind, dtype) in types.items()
        ]
        pandas = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
        self._write_table("meta/tasks.parquet", {"task_index": 0, "task": task}, {"pandas": json.dumps(pandas)})

    def _write_table(self, name: str, row: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({key: [value] for key, value in row.items()})
        pq.write_table(table.replace_schema_metadata(metadata), self._lent(name))

    def _write_json(self, name: str, content: Any) -> None:
        self._new(name).write(json.dumps(content, indent=1, ensure_ascii=False).encode())

    def _lent(self, name: str) -> LentFile:
        """Return a new file of the dataset for Arrow."""
        return self._replaced.enter_context(lent_file(self._new(name)))

    def _new(self, name: str) -> BinaryIO:
        """Return a new file of the dataset, which stands in its place at the end."""
        path = self._out / name
        check_link("--out", path)
        check_apart("--out", path, [(f"the recording {self._recording}", self._recording)])
        self._replaced.enter_context(new_folder(path.parent))
        self._files.append(path)
        return self._replaced.enter_context(replace_file(path))
