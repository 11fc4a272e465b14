"""Exports topics of a recording as tables: CSV or Parquet, a file per topic, or MATLAB, all topics in a file."""

import csv
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json
from scipy.io import savemat

from shearloop.daemon.recorder import schema
from shearloop.errors import UserError, require
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.reader import read_messages
from shearloop.tools.recordings.tables import Rows, arrays, columns_of, read_rows, row_of

# Numbers of a Parquet table that are written at once.
_BATCH = 200_000
# Largest size of the messages in one MATLAB file, in numbers of eight bytes; a key of a message counts as ten. It
# bounds the memory and keeps each variable below the format's 2 GB.
_MAT_SIZE, _KEY_SIZE = 12_000_000, 10


def export(path: Path, form: str, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics as `form` (csv, parquet or mat) and return the files.

    For csv and parquet `out` is a folder. For mat it is a file; a large recording continues in NAME_2.mat, NAME_3.mat,
    and so on, which must not exist. `progress` receives the number of messages so far. Raises UserError for a recording
    that cannot be read, and OSError for files that cannot be written.
    """
    if form == "mat":
        return _export_mat(path, out, topics, progress)
    return _export_tables(path, form, out, topics, progress)


def _export_mat(path: Path, out: Path, topics: list[str], progress: Progress) -> list[Path]:
    def part(number: int) -> Path:
        return out.with_name(f"{out.stem}_{number}{out.suffix}") if number > 1 else out

    if part(2).exists():
        raise UserError(f"{part(2)} exists and would look like a part of this export; remove it, or use another --out")
    written: list[Path] = []
    waiting: dict[str, Rows] = {topic: [] for topic in topics}
    size = 0

    def write() -> None:
        structs = {topic.replace(".", "_").replace("-", "_"): arrays(rows) for topic, rows in waiting.items() if rows}
        target = part(len(written) + 1)
        # savemat changes names and hides the reason if it opens the file itself.
        with target.open("xb" if written else "wb") as file:
            # The stubs allow only names.
            savemat(file, structs, long_field_names=True, oned_as="column")  # type: ignore[arg-type]
        written.append(target)

    for topic, row in read_rows(path, topics, progress):
        waiting[topic].append(row)
        size += sum(value.size if isinstance(value, np.ndarray) else _KEY_SIZE for value in row.values())
        if size >= _MAT_SIZE:
            write()
            waiting, size = {topic: [] for topic in topics}, 0
    if size or not written:
        write()
    return written


def _export_tables(path: Path, form: str, out: Path, topics: list[str], progress: Progress) -> list[Path]:
    if form == "parquet":
        require("pyarrow", "export", "Parquet")
    out.mkdir(parents=True, exist_ok=True)
    files = {topic: out / f"{topic}.{form}" for topic in topics}
    tables: dict[str, _CsvTable | _ParquetTable] = {}
    with ExitStack() as stack:
        for topic, content, message in read_messages(path, topics, progress):
            row = row_of(content, message.log_time)
            if topic not in tables:
                made = _CsvTable(files[topic], row) if form == "csv" else _ParquetTable(files[topic], topic, row)
                stack.callback(made.close)
                tables[topic] = made
            tables[topic].add(row)
    return list(files.values())


class _CsvTable:
    """A table with one column per array element, after the other columns: channels_0, channels_1, …"""

    def __init__(self, path: Path, first: dict[str, Any]) -> None:
        """Write the names of the columns, as in the first row."""
        self._path = path
        self._file = path.open("w", newline="", encoding="utf-8")
        self._table = csv.writer(self._file, lineterminator="")
        names = [key for key, value in first.items() if not isinstance(value, list)]
        arrays = {key: value for key, value in first.items() if isinstance(value, list)}
        names += [f"{key}_{i}" for key, value in arrays.items() for i in range(len(value))]
        self._width = len(names)
        self._table.writerow(names)
        self._file.write("\r\n")

    def add(self, row: dict[str, Any]) -> None:
        """Write one row; raises UserError if it has other columns than the first."""
        cells = [value for value in row.values() if not isinstance(value, list)]
        arrays = [value for value in row.values() if isinstance(value, list)]
        width = len(cells) + sum(map(len, arrays))
        if width != self._width:
            raise UserError(
                f"{self._path}: the first message has {self._width} values and a later one {width}; use --format mat"
            )
        self._table.writerow(cells)
        # The csv module takes ten times as long for numbers.
        text = b"".join(b"," + to_json(value)[1:-1] for value in arrays if value).replace(b"null", b"").decode()
        self._file.write(f"{text}\r\n")

    def close(self) -> None:
        """End the file."""
        self._file.close()


class _ParquetTable:
    """A table with the types of the topic's schema, written in batches; missing elements of arrays are NaN."""

    def __init__(self, path: Path, topic: str, first: dict[str, Any]) -> None:
        """Begin the file with the columns of the first row."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {"number": "float64", "integer": "int64", "boolean": "bool", "string": "string", "object": "string"}

        def arrow_type(described: dict[str, Any]) -> Any:
            if described["type"] == "array":
                return pa.list_(arrow_type(described["items"]))
            return pa.type_for_alias(types[described["type"]])

        described = {"log_time_ns": {"type": "integer"}, **schema.schemas()[schema.schema_name(topic)]["properties"]}
        self._schema = pa.schema([(key, arrow_type(described[key])) for key in first])
        self._arrays = [field.name for field in self._schema if field.type == pa.list_(pa.float64())]
        scalars = [field.name for field in self._schema if not pa.types.is_list(field.type)]
        # Measured values seldom repeat: a dictionary of them would only cost time, and so would limits of arrays.
        self._writer = pq.ParquetWriter(path, self._schema, use_dictionary=False, write_statistics=scalars)
        self._rows: Rows = []
        self._rows_at_once = 1 + _BATCH // sum(len(value) if isinstance(value, list) else 1 for value in first.values())

    def add(self, row: dict[str, Any]) -> None:
        """Add one row."""
        # Arrow takes twice as long for a list.
        arrays = {key: np.array(row[key], dtype=np.float64) for key in self._arrays if row.get(key) is not None}
        self._rows.append(row | arrays)
        if len(self._rows) == self._rows_at_once:
            self._write()

    def close(self) -> None:
        """Write what waits, and end the file."""
        if self._rows:
            self._write()
        self._writer.close()

    def _write(self) -> None:
        import pyarrow as pa

        self._writer.write_table(pa.table(columns_of(self._rows), schema=self._schema))
        self._rows.clear()
