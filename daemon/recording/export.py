"""Exports topics of a recording as tables: CSV or Parquet, a file per topic, or MATLAB, all topics in a file."""

import csv
from collections.abc import Iterable, Iterator
from itertools import chain, count, islice
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json
from scipy.io import savemat

from shearloop.daemon.errors import UserError, require
from shearloop.daemon.recording import schema
from shearloop.daemon.recording.reader import Progress, read_messages
from shearloop.daemon.recording.tables import Rows, arrays, columns_of, read_rows, row_of

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
    files, number = [], count(1)
    for topic in topics:
        messages = read_messages(path, [topic], lambda _: progress(next(number)))
        rows = (row_of(content, message.log_time) for _, content, message in messages)
        files.append(out / f"{topic}.{form}")
        if form == "csv":
            _write_csv(files[-1], rows)
        else:
            _write_parquet(files[-1], topic, rows)
    return files


def _write_csv(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write a column per array element, after the other columns: channels_0, channels_1, …

    Raises UserError if a row has other columns than the first.
    """
    first_width = 0
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="")
        for row in rows:
            arrays = {key: value for key, value in row.items() if isinstance(value, list)}
            cells = {key: value for key, value in row.items() if key not in arrays}
            width = len(cells) + sum(map(len, arrays.values()))
            if not first_width:
                first_width = width
                table.writerow([*cells, *(f"{key}_{i}" for key, value in arrays.items() for i in range(len(value)))])
                file.write("\r\n")
            if width != first_width:
                raise UserError(
                    f"{path}: the first message has {first_width} values and a later one {width}; use --format mat"
                )
            table.writerow(cells.values())
            # The csv module takes ten times as long for numbers.
            text = b"".join(b"," + to_json(value)[1:-1] for value in arrays.values() if value).replace(b"null", b"")
            file.write(f"{text.decode()}\r\n")


def _write_parquet(path: Path, topic: str, rows: Iterator[dict[str, Any]]) -> None:
    """Write a table with the types of the topic's schema in batches; missing elements of arrays are NaN."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {"number": "float64", "integer": "int64", "boolean": "bool", "string": "string", "object": "string"}

    def arrow_type(described: dict[str, Any]) -> Any:
        if described["type"] == "array":
            return pa.list_(arrow_type(described["items"]))
        return pa.type_for_alias(types[described["type"]])

    first = next(rows)
    described = {"log_time_ns": {"type": "integer"}, **schema.schemas()[schema.schema_name(topic)]["properties"]}
    table_schema = pa.schema([(key, arrow_type(described[key])) for key in first])
    arrays = [field.name for field in table_schema if field.type == pa.list_(pa.float64())]
    scalars = [field.name for field in table_schema if not pa.types.is_list(field.type)]
    rows_at_once = 1 + _BATCH // sum(len(value) if isinstance(value, list) else 1 for value in first.values())
    following = chain([first], rows)
    # Measured values seldom repeat: a dictionary of them would only cost time, and so would limits of arrays.
    with pq.ParquetWriter(path, table_schema, use_dictionary=False, write_statistics=scalars) as writer:
        while batch := list(islice(following, rows_at_once)):
            for row in batch:
                # Arrow takes twice as long for a list.
                row |= {key: np.array(row[key], dtype=np.float64) for key in arrays if row.get(key) is not None}
            writer.write_table(pa.table(columns_of(batch), schema=table_schema))
