"""Exports topics of a recording as tables: CSV or Parquet, a file per topic, or MATLAB, all topics in a file."""

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic_core import to_json
from scipy.io import savemat

from shearloop.errors import UserError
from shearloop.extras import require
from shearloop.files import refusing_damage, replace_file
from shearloop.tools.outputs import LentFile, check_apart, check_link, check_overwrite, lent_file, new_folder
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.reader import columns_of_topics, read_messages
from shearloop.tools.recordings.recorded_columns import UNITS_TABLE, TopicColumns
from shearloop.tools.recordings.tables import Rows, arrays, columns_of, read_rows, row_of

# Numbers of a Parquet table that are written at once.
_BATCH = 200_000
# Largest size of the messages in one MATLAB file, in numbers of eight bytes; a key of a message counts as ten. It
# bounds the memory and keeps each variable below the format's 2 GB.
_MAT_SIZE, _KEY_SIZE = 12_000_000, 10
# MATLAB takes 63 characters.
_LONGEST_NAME = 59
# The first line of the table next to the CSV files, with the units of all columns.
_UNITS_HEAD = "topic,column,unit"
# A cell with one of these stands in quotes.
_QUOTED = re.compile(r'[",\r\n]')


def export(path: Path, form: str, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics as `form` (csv, parquet or mat) and return the files.

    Columns have their messages' units: in the fields' metadata of Parquet, a struct `units` of MATLAB, and `units.csv`.
    For csv and parquet `out` is a folder. For mat it is a file; a large recording continues in NAME_2.mat, NAME_3.mat,
    and so on, which must not exist. `progress` receives the number of messages so far. Raises UserError for a recording
    that cannot be read, and OSError for files that cannot be written; then no file is new or changed.
    """
    if form == "mat":
        return _export_mat(path, out, topics, progress)
    return _export_tables(path, form, out, topics, progress)


def _export_mat(path: Path, out: Path, topics: list[str], progress: Progress) -> list[Path]:
    # Further parts stand beside the target of a link.
    first = out.resolve() if out.is_symlink() else out

    def part(number: int) -> Path:
        return first.with_name(f"{first.stem}_{number}{first.suffix}") if number > 1 else out

    def check_new(target: Path) -> None:
        if target.exists():
            raise UserError(
                f"{target} exists and would look like a part of this export; remove it, or use another --out"
            )

    check_new(part(2))
    columns = columns_of_topics(path, topics)
    written: list[Path] = []
    names = _struct_names(topics)
    waiting: dict[str, Rows] = {topic: [] for topic in topics}
    size = 0

    with ExitStack() as files:

        def write() -> None:
            used = {name: topic for topic, name in names.items() if waiting[topic]}
            structs: dict[str, Mapping[str, Any]] = {name: arrays(waiting[topic]) for name, topic in used.items()}
            if used:
                structs[UNITS_TABLE] = {name: _units_of(columns[topic], structs[name]) for name, topic in used.items()}
            target = part(len(written) + 1)
            if written:
                check_new(target)
            # savemat changes names and hides the reason if it opens the file itself.
            file = files.enter_context(replace_file(target))
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


def _units_of(columns: TopicColumns, written: Collection[str]) -> dict[str, str]:
    """Return the units of the columns that are written: a recording need not have all of its schema's."""
    return {key: unit for key, unit in columns.units.items() if key in written}


def _struct_names(topics: Iterable[str]) -> dict[str, str]:
    """Return a name of MATLAB for each topic, and number those that would be alike: `eit.frame.a-b` and `….a_b`."""
    names: dict[str, str] = {}
    for topic in topics:
        # No topic is named like the variable of the units.
        plain = re.sub(r"\W", "_", topic, flags=re.ASCII)[:_LONGEST_NAME]
        number, name = 1, plain
        while name in names.values():
            number += 1
            name = f"{plain}_{number}"
        names[topic] = name
    return names


def _export_tables(path: Path, form: str, out: Path, topics: list[str], progress: Progress) -> list[Path]:
    if form == "parquet":
        require("pyarrow", "export", "Parquet")
    paths = {topic: out / f"{topic}.{form}" for topic in topics}
    units = {UNITS_TABLE: out / f"{UNITS_TABLE}.csv"} if form == "csv" else {}
    for target in (paths | units).values():
        check_link("--out", target)
        check_apart("--out", target, [(f"the recording {path}", path)])
    for target in units.values() if out.is_dir() else ():
        check_overwrite(target, "the units of exported tables", _UNITS_HEAD.encode())
    columns = columns_of_topics(path, topics)
    tables: dict[str, _CsvTable | _ParquetTable] = {}
    # By topic.
    written: dict[str, Mapping[str, str]] = {}
    with new_folder(out), ExitStack() as files:
        for topic, content, message in read_messages(path, topics, progress):
            row = row_of(content, message.log_time)
            if topic not in tables:
                written[topic] = _units_of(columns[topic], row)
                file = files.enter_context(replace_file(paths[topic]))
                if form == "csv":
                    tables[topic] = _CsvTable(paths[topic], file, row)
                else:
                    tables[topic] = _ParquetTable(files.enter_context(lent_file(file)), columns[topic], row)
            tables[topic].add(row)
        # Every table ends before the first file is replaced.
        for table in tables.values():
            table.close()
        if form == "csv":
            rows = [(topic, *unit) for topic, of_topic in written.items() for unit in of_topic.items()]
            rows += _units_of_others(units[UNITS_TABLE], tables)
            lines = [_UNITS_HEAD, *(",".join(map(_csv_cell, row)) for row in rows)]
            files.enter_context(replace_file(units[UNITS_TABLE])).write(
                "".join(f"{line}\r\n" for line in lines).encode()
            )
    return list((paths | units).values())


def _units_of_others(path: Path, written: Collection[str]) -> list[tuple[str, str, str]]:
    """Return the present rows of a table of units for tables beside it that an export did not write."""
    if not path.exists():
        return []
    damage = "the table of units cannot be read: {}; remove it, or choose another --out"
    with (
        refusing_damage(path, UserError, "the table of units", damage),
        path.open(encoding="utf-8", newline="") as file,
    ):
        rows = [(row["topic"], row["column"], row["unit"]) for row in csv.DictReader(file)]
    return [row for row in rows if row[0] not in written and (path.parent / f"{row[0]}.csv").exists()]


class _CsvTable:
    """A table with one column per array element, after the other columns: channels_0, channels_1, …"""

    def __init__(self, path: Path, file: BinaryIO, first: dict[str, Any]) -> None:
        """Write the names of the columns, as in the first row; `path` is for messages."""
        self._path = path
        self._scalars = [key for key, value in first.items() if not isinstance(value, list)]
        self._lengths = {key: len(value) for key, value in first.items() if isinstance(value, list)}
        self._file = io.TextIOWrapper(file, newline="", encoding="utf-8")
        elements = [f"{key}_{i}" for key, length in self._lengths.items() for i in range(length)]
        self._file.write(",".join([*self._scalars, *elements]) + "\r\n")

    def add(self, row: dict[str, Any]) -> None:
        """Write one row by the names of its values; raises UserError if an array has another length than the first."""
        for key, length in self._lengths.items():
            if len(row[key]) != length:
                raise UserError(
                    f"{self._path}: the first message has {length} values of {key} and a later one {len(row[key])}; "
                    "use --format mat"
                )
        cells = [_csv_cell(row[key]) for key in self._scalars]
        # The csv module takes ten times as long for numbers.
        cells += [to_json(row[key])[1:-1].replace(b"null", b"").decode() for key in self._lengths if row[key]]
        self._file.write(",".join(cells) + "\r\n")

    def close(self) -> None:
        """Write what waits; the file stays open."""
        self._file.detach()


def _csv_cell(value: Any) -> str:
    """Return a scalar as a cell of CSV: empty for None, in quotes where it holds a comma, a quote or a line's end."""
    if value is None:
        return ""
    text = str(value)
    return '"' + text.replace('"', '""') + '"' if _QUOTED.search(text) else text


class _ParquetTable:
    """A table with the recorded types of a topic, written in batches; missing elements of arrays are NaN."""

    def __init__(self, file: LentFile, columns: TopicColumns, first: dict[str, Any]) -> None:
        """Begin the file with the columns of the first row."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        names = {"number": "float64", "integer": "int64", "boolean": "bool", "string": "string", "object": "string"}
        types = {kind: pa.type_for_alias(name) for kind, name in names.items()}
        types["array"] = pa.list_(types["number"])
        # Only the log time is no key of a message.
        kinds = {key: columns.all[key].kind if key in columns.all else "integer" for key in first}
        units = {key: {"unit": unit} for key, unit in columns.units.items()}
        self._schema = pa.schema([pa.field(key, types[kind], metadata=units.get(key)) for key, kind in kinds.items()])
        self._arrays = [field.name for field in self._schema if field.type == pa.list_(pa.float64())]
        scalars = [field.name for field in self._schema if not pa.types.is_list(field.type)]
        # Measured values seldom repeat: a dictionary of them would only cost time, and so would limits of arrays.
        self._writer = pq.ParquetWriter(file, self._schema, use_dictionary=False, write_statistics=scalars)
        self._rows: Rows = []
        self._rows_at_once = 1 + _BATCH // sum(len(value) if isinstance(value, list) else 1 for value in first.values())

    def add(self, row: dict[str, Any]) -> None:
        """Add one row."""
        # Arrow takes twice as long for a list.
        arrays = {key: np.array(row[key], dtype=np.float64) for key in self._arrays if row[key] is not None}
        self._rows.append(row | arrays)
        if len(self._rows) == self._rows_at_once:
            self._write()

    def close(self) -> None:
        """Write what waits, and end the table."""
        if self._rows:
            self._write()
        self._writer.close()

    def _write(self) -> None:
        import pyarrow as pa

        self._writer.write_table(pa.table(columns_of(self._rows), schema=self._schema))
        self._rows.clear()
