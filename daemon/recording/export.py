"""Exports topics of a recording as tables: CSV or Parquet, one file per topic, or one MATLAB file."""

import csv
import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from shearloop.daemon.errors import require
from shearloop.daemon.recording import schema
from shearloop.daemon.recording.reader import check_identity, open_recording, read_messages

Rows = list[dict[str, Any]]
Progress = Callable[[int], None]


def count_messages(path: Path) -> dict[str, int]:
    """Return the number of messages of each topic; raises UserError for a file that cannot be used."""
    with open_recording(path) as recording:
        check_identity(path, recording.metadata().get(schema.METADATA))
        return recording.counts


def export(path: Path, form: str, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics as `form` (csv, parquet or mat) and return the files.

    For csv and parquet `out` is a folder, for mat a file. `progress` receives the number of messages so far. Raises
    UserError for a recording that cannot be read and OSError for files that cannot be written.
    """
    done = itertools.count(1)

    def rows(topic: str) -> Rows:
        return _read_rows(path, topic, lambda: progress(next(done)))

    if form == "mat":
        structs = {topic.replace(".", "_").replace("-", "_"): _matlab_struct(rows(topic)) for topic in topics}
        # savemat changes names and hides the reason if it opens the file itself.
        with out.open("wb") as file:
            # The stubs allow only names.
            savemat(file, structs, long_field_names=True, oned_as="column", do_compression=True)  # type: ignore[arg-type]
        return [out]
    out.mkdir(parents=True, exist_ok=True)
    write = {"csv": _write_csv, "parquet": _write_parquet}[form]
    written = [out / f"{topic}.{form}" for topic in topics]
    for topic, file_path in zip(topics, written, strict=True):
        write(file_path, rows(topic))
    return written


def _read_rows(path: Path, topic: str, count: Callable[[], None]) -> Rows:
    """Return a topic's messages by time: log_time_ns first, maps as JSON text, None for a missing value."""
    rows = []
    for _, content, message in read_messages(path, [topic]):
        row = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in content.items()}
        rows.append({"log_time_ns": message.log_time, **row})
        count()
    return rows


def _columns(rows: Rows) -> dict[str, list[Any]]:
    """Return the values of each key, None where a row lacks it."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: [row.get(key) for row in rows] for key in keys}


def _write_csv(path: Path, rows: Rows) -> None:
    """Write a table with one column per array element: channels_0, channels_1, …"""
    columns: dict[str, list[Any]] = {}
    for key, values in _columns(rows).items():
        if any(isinstance(value, list) for value in values):
            width = max(len(value or []) for value in values)
            for i in range(width):
                columns[f"{key}_{i}"] = [value[i] if value and i < len(value) else None for value in values]
        else:
            columns[key] = values
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))


def _write_parquet(path: Path, rows: Rows) -> None:
    require("pyarrow", "export", "Parquet")
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table(_columns(rows)), path)


def _matlab_struct(rows: Rows) -> dict[str, Any]:
    """Return numbers as (n, 1), arrays as (n, m) with NaN for missing elements, texts as a cell array."""
    struct: dict[str, Any] = {}
    for key, values in _columns(rows).items():
        present = [value for value in values if value is not None]
        complete = bool(present) and len(present) == len(values)
        if any(isinstance(value, list) for value in present):
            matrix = np.full((len(values), max(map(len, present))), np.nan)
            for row, value in zip(matrix, values, strict=True):
                row[: len(value or [])] = np.array(value or [], dtype=np.float64)
            struct[key] = matrix
        elif any(isinstance(value, str) for value in present):
            struct[key] = np.array([value or "" for value in values], dtype=object)[:, None]
        elif complete and all(type(value) is int for value in present):
            struct[key] = np.array(values, dtype=np.int64)
        elif complete and all(type(value) is bool for value in present):
            struct[key] = np.array(values, dtype=bool)
        else:
            struct[key] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return struct
