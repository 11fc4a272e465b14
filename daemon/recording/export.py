"""Exports topics of a recording as tables: CSV or Parquet, one file per topic, or one MATLAB file."""

import csv
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from scipy.io import savemat

from shearloop.daemon.errors import UserError, require
from shearloop.daemon.recording.tables import Rows, arrays, columns_of, read_rows

Progress = Callable[[int], None]


def export(path: Path, form: str, out: Path, topics: list[str], progress: Progress = lambda _: None) -> list[Path]:
    """Write topics as `form` (csv, parquet or mat) and return the files.

    For csv and parquet `out` is a folder, for mat a file. `progress` receives the number of messages so far. Raises
    UserError for a recording that cannot be read and for files that cannot be written.
    """
    done = itertools.count(1)

    def rows(topic: str) -> Rows:
        return read_rows(path, topic, lambda: progress(next(done)))

    try:
        if form == "mat":
            structs = {topic.replace(".", "_").replace("-", "_"): arrays(rows(topic)) for topic in topics}
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
    except OSError as error:
        raise UserError(f"{out}: the export cannot be written: {error.strerror or error}") from error
    return written


def _write_csv(path: Path, rows: Rows) -> None:
    """Write a table with one column per array element: channels_0, channels_1, …"""
    columns: dict[str, list[Any]] = {}
    for key, values in columns_of(rows).items():
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

    pyarrow.parquet.write_table(pyarrow.table(columns_of(rows)), path)
