"""The recordings of a folder, by their indices."""

from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC

from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import PARTIAL
from shearloop.errors import UserError
from shearloop.files import open_file
from shearloop.tools.recordings.being_written import is_being_written
from shearloop.tools.recordings.intact_records import check_magic, intact_index
from shearloop.tools.recordings.monotonic_times import has_one_offset
from shearloop.tools.recordings.reader import reading
from shearloop.tools.recordings.summary import summarise

_BAD_INDEX = "its index is damaged; `shearloop recording repair` makes a copy with a new one"


@dataclass(frozen=True, slots=True)
class ListedRecording:
    """One recording of a folder, times in Unix ns; the keys of `recording list --json`."""

    path: str
    size_bytes: int
    closed: bool
    first_unix_ns: int | None = None
    duration_s: float | None = None
    experiments: tuple[str, ...] = ()
    # Why its index cannot be read; empty where it can, or was never written.
    unreadable: str = ""
    # Whether a program writes it now, as far as its lock says.
    being_written: bool = False


def list_recordings(folder: Path) -> list[ListedRecording]:
    """Return the recordings in a folder and below it, by their beginning; recordings without one come last.

    Reads the indices only, except in recordings with log times of a wall clock: these are read whole. Raises UserError
    for a path that is no folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder; `shearloop recording info FILE` shows one recording")
    paths = [path for path in folder.rglob("*") if path.name.endswith((".mcap", f".mcap{PARTIAL}")) and path.is_file()]
    return sorted(map(_listed, paths), key=lambda one: (one.first_unix_ns is None, one.first_unix_ns or 0, one.path))


def _listed(path: Path) -> ListedRecording:
    size = path.stat().st_size
    if path.suffix == PARTIAL:
        return ListedRecording(str(path), size, closed=False, being_written=is_being_written(path))
    try:
        with reading(path), open_file(path) as file:
            check_magic(path, file)
            found = intact_index(file, size)
            summary = found[0] if found is not None else None
            if summary is None or summary.statistics is None:
                file.seek(max(size - len(MCAP0_MAGIC), len(MCAP0_MAGIC)))
                closed = file.read() == MCAP0_MAGIC
                return ListedRecording(str(path), size, closed=closed, unreadable=_BAD_INDEX if closed else "")
            reader, counts = make_reader(file), summary.statistics
            experiments = [record for record in reader.iter_metadata() if record.name == schema.EXPERIMENT_METADATA]
            follows_wall_clock = any(
                channel.topic == schema.CLOCK_TOPIC and not has_one_offset(channel.metadata)
                for channel in summary.channels.values()
            )
            whole = summarise(path) if follows_wall_clock else None
    except UserError as error:
        return ListedRecording(str(path), size, closed=True, unreadable=str(error))
    first_ns = counts.message_start_time if counts.message_count else None
    duration_s = (counts.message_end_time - counts.message_start_time) / 1e9
    if whole is not None:
        first_ns, duration_s = whole.first_unix_ns, whole.duration_s
    names = tuple(experiment.metadata.get("name", "") for experiment in experiments)
    return ListedRecording(
        str(path), size, closed=True, first_unix_ns=first_ns, duration_s=duration_s, experiments=names
    )
