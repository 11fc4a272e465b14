"""A recording's topics as tables: CSV and Parquet, a file for each topic, or one MATLAB file with a struct for each."""

import csv
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.opened import opened
from shearloop.daemon.recording.schema import completed, schema_of

# A MATLAB name is at most 63 characters long; ours are far shorter.
_LOG_TIME = "log_time_ns"
Rows = list[dict[str, Any]]
Progress = Callable[[int], None]


def topics_of(path: Path) -> dict[str, int]:
    """Return the topics of a recording with their numbers of messages; raises UserError for one not to be read."""
    with opened(path) as recording:
        return recording.counts


def export(path: Path, form: str, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics of a recording as `form` (csv, parquet or mat) and return the files written.

    For csv and parquet `out` is a folder, for mat a file. One topic at a time is in memory. `progress` hears of each
    message. Raises UserError for a recording that cannot be read, and where nothing can be written.
    """
    try:
        if form == "mat":
            structs = {}
            for topic in topics:
                structs[topic.replace(".", "_").replace("-", "_")] = _matlab(rows_of(path, topic, progress))
            # Opened here: the library has a sentence of its own for what it cannot open, and another name.
            with out.open("wb") as file:
                # Its stubs know of names alone.
                savemat(file, structs, long_field_names=True, oned_as="column", do_compression=True)  # type: ignore[arg-type]
            return [out]
        out.mkdir(parents=True, exist_ok=True)
        write = {"csv": _write_csv, "parquet": _write_parquet}[form]
        written = []
        for topic in topics:
            written.append(out / f"{topic}.{form}")
            write(written[-1], rows_of(path, topic, progress))
    except OSError as error:
        raise UserError(f"{out}: the export cannot be written: {error.strerror or error}") from error
    return written


def rows_of(path: Path, topic: str, progress: Progress = lambda _: None) -> Rows:
    """Return a topic's messages in order of time, log_time_ns first, nested maps as JSON text, None for no value."""
    rows = []
    with opened(path) as recording:
        wire = schema_of(topic)
        for _, message in recording.messages([topic]):
            content = completed(wire, json.loads(message.data))
            row = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in content.items()}
            rows.append({_LOG_TIME: message.log_time, **row})
            progress(1)
    return rows


def columns_of(rows: Rows) -> dict[str, list[Any]]:
    """Return the rows' keys, in the order in which they appear, each with a value per row, None where there is none."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: [row.get(key) for row in rows] for key in keys}


def _write_csv(path: Path, rows: Rows) -> None:
    """Write a table whose arrays have a column for each element: channels_0, channels_1, …"""
    widths: dict[str, int] = {}
    for row in rows:
        for key, value in row.items():
            widths[key] = max(widths.get(key, 0), len(value) if isinstance(value, list) else 0)
    arrays = {key for row in rows for key, value in row.items() if isinstance(value, list)}
    with path.open("w", newline="", encoding="utf-8") as file:
        write = csv.writer(file)
        header = []
        for key, width in widths.items():
            header += [f"{key}_{i}" for i in range(width)] if key in arrays else [key]
        write.writerow(header)
        for row in rows:
            write.writerow(_cells(row, widths, arrays))


def _cells(row: Mapping[str, Any], widths: Mapping[str, int], arrays: set[str]) -> list[Any]:
    cells: list[Any] = []
    for key, width in widths.items():
        value = row.get(key)
        if key in arrays:
            values = list(value or [])
            cells += values + [None] * (width - len(values))
        else:
            cells.append(value)
    return cells


def _write_parquet(path: Path, rows: Rows) -> None:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError as error:
        raise UserError("Parquet needs pyarrow: `pip install 'shearloop[export]'`") from error
    pyarrow.parquet.write_table(pyarrow.table(columns_of(rows)), path)


def _matlab(rows: Rows) -> dict[str, Any]:
    """Return a struct: numbers as (n, 1), arrays as (n, m) with NaN for what is missing, texts as a cell array."""
    struct: dict[str, Any] = {}
    for key, values in columns_of(rows).items():
        present = [value for value in values if value is not None]
        if any(isinstance(value, list) for value in present):
            width = max(len(value) for value in present)
            matrix = np.full((len(values), width), np.nan)
            for row, value in zip(matrix, values, strict=True):
                row[: len(value or [])] = np.array(value or [], dtype=np.float64)
            struct[key] = matrix
        elif any(isinstance(value, str) for value in present):
            struct[key] = np.array([value or "" for value in values], dtype=object)[:, None]
        elif present and len(present) == len(values) and all(type(value) is int for value in present):
            struct[key] = np.array(values, dtype=np.int64)
        elif present and len(present) == len(values) and all(type(value) is bool for value in present):
            struct[key] = np.array(values, dtype=bool)
        else:
            struct[key] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return struct
