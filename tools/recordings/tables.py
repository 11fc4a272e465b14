"""The topics of a recording as arrays and as pandas frames."""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shearloop.extras import missing
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.reader import columns_of_topics, open_recording, read_messages

if TYPE_CHECKING:
    from pandas import DataFrame

Rows = list[dict[str, Any]]


class RecordedTopics(Mapping[str, dict[str, NDArray[Any]]]):
    """The topics of a recording; each is a map of arrays, which is read when it is first used.

    `log_time_ns` is the Unix time of each message. Numbers have the shape (n,), arrays (n, m), NaN where a value is
    missing; texts are objects, "" where one is missing. `units` gives their units,
    `docs/messages.md` their meaning.
    """

    def __init__(self, path: str | Path) -> None:
        """Read what a closed recording says about itself; raises UserError for a file that cannot be used."""
        self.path = Path(path)
        with open_recording(self.path) as recording:
            self.metadata = recording.identity
            # The number of messages of each topic.
            self.counts = {topic: count for topic, count in sorted(recording.counts.items()) if count}
        self._topics: dict[str, dict[str, NDArray[Any]]] = {}

    def __getitem__(self, topic: str) -> dict[str, NDArray[Any]]:
        """Return a topic's arrays; raises KeyError for a topic that was not recorded."""
        if topic not in self._topics:
            if topic not in self.counts:
                raise KeyError(f"{self.path} has no topic {topic!r}; it has {', '.join(self)}")
            self._topics[topic] = arrays([row for _, row in read_rows(self.path, [topic])])
        return self._topics[topic]

    def __iter__(self) -> Iterator[str]:
        """Yield the topics by name."""
        return iter(self.counts)

    def __len__(self) -> int:
        """Return the number of topics."""
        return len(self.counts)

    def units(self, topic: str) -> Mapping[str, str]:
        """Return the unit of each key of a topic that has one, as it was recorded; raises UserError."""
        return columns_of_topics(self.path, [topic])[topic].units

    def frame(self, topic: str) -> "DataFrame":
        """Return a topic as a pandas frame by UTC time, a column per element of an array: `line_0`, `line_1`, …

        Raises KeyError as for the arrays, and UserError without pandas.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError as error:
            raise missing("pandas", "notebook", "a frame") from error
        columns: dict[str, NDArray[Any]] = {}
        for key, values in self[topic].items():
            if values.ndim == 2:
                columns |= {f"{key}_{i}": element for i, element in enumerate(values.T)}
            elif key != "log_time_ns":
                columns[key] = values
        time = pd.to_datetime(self[topic]["log_time_ns"], utc=True).rename("time")
        return pd.DataFrame(columns, index=time)


def read(path: str | Path) -> RecordedTopics:
    """Return the topics of a recording; raises UserError for a file that cannot be used."""
    return RecordedTopics(path)


def read_rows(
    path: Path, topics: Iterable[str], progress: Progress = lambda _: None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the messages of topics by time, as topic and row; `progress` receives the number of messages so far."""
    for topic, content, message in read_messages(path, topics, progress):
        # As arrays, heatmaps take a quarter of the memory.
        held = {key: np.array(value, float) if isinstance(value, list) else value for key, value in content.items()}
        yield topic, row_of(held, message.log_time)


def row_of(content: Mapping[str, Any], log_time_ns: int) -> dict[str, Any]:
    """Return a message as a row: log_time_ns first, maps as JSON text, None for a missing value."""
    row = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in content.items()}
    return {"log_time_ns": log_time_ns, **row}


def columns_of(rows: Rows) -> dict[str, list[Any]]:
    """Return the values of each key, None where a row lacks it."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: [row.get(key) for row in rows] for key in keys}


def arrays(rows: Rows) -> dict[str, NDArray[Any]]:
    """Return numbers as (n,), arrays as (n, m) with NaN for missing elements, texts as (n,) objects."""
    found: dict[str, NDArray[Any]] = {}
    for key, values in columns_of(rows).items():
        types = {type(value) for value in values}
        if np.ndarray in types:
            width = max(len(value) for value in values if value is not None)
            found[key] = np.full((len(values), width), np.nan)
            for row, value in zip(found[key], values, strict=True):
                if value is not None:
                    row[: len(value)] = value
        elif str in types:
            found[key] = np.array([value or "" for value in values], dtype=object)
        else:
            # None becomes NaN.
            found[key] = np.array(values, dtype=None if types in ({int}, {bool}) else np.float64)
    return found
