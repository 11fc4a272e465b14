"""Reads the paper's MATLAB files of slices, raw lines and streams; imports streams as a recording."""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter1d

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.matlab_file import MatFileError, Variable, read_variables
from shearloop.daemon.recorder.schema import (
    DIAMETER_NOTE,
    LARGEST_DIAMETER_MM,
    LEFT_OUT_NOTE,
    LOAD_DOUBT,
    LOAD_DOUBT_NOTE,
    REMARKS_NOTE,
    SIDES,
)
from shearloop.daemon.recorder.writer import new_recording
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.eit_kit import ADC_REFERENCE_V
from shearloop.drivers.frame_clock import slope_below
from shearloop.errors import UserError
from shearloop.estimation import FrameSeries
from shearloop.estimation.load_delay import find_clock_fault, measured_delay
from shearloop.estimation.values import longest_load_gap_s
from shearloop.files import open_file
from shearloop.tools.recordings.load_validity import MAX_DAMAGED, rounding_step_nm, valid_load
from shearloop.tools.recordings.time_formats import DATENUM, STREAM_VARIABLES, TIME_FORMATS
from shearloop.words import counted

TORQUE_FOLDER, DIAMETER_FOLDER = "torque_slices", "diameter_slices"
RAW_FRAME, RAW_HOMOGENEOUS = "TorqueSlice.mat", "TorqueSliceHom.mat"
_LINES = ("clipped_data", "clipped_data_hom")
# Recordings are of 2000 to 2060: seconds since 1900, as NTP counts them, would be later.
_EARLIEST_S, _LATEST_S = 946_684_800.0, 2_840_140_800.0
# A line that is stamped late may seem to come after the next one.
_LARGEST_DELAY_S = 2.0
# Times that fall back by less are late stamps.
_LEAST_SET_BACK_S = 0.5
_COMPARED_ROWS = 9
# Time zones are whole half hours apart, but for a few, and up to 26 h. The streams of one recording begin and end
# within some seconds.
_ZONE_S, _LARGEST_ZONE_S, _SAME_START_S = 1800.0, 26 * 3600.0, 20.0
_LONGEST_ELAPSED_S = 31 * 86_400.0
# Boards send a line every 0.02 to 5 s: the load cell's every 0.09 s, fingertips' every 0.54 s.
_SHORTEST_STEP_S, _LONGEST_STEP_S = 0.005, 10.0
_SHORTEST_FRAME_S = 0.05
# Lines that were stamped late are fewer than this fraction.
_MAX_LATE = 0.1
_TORQUE_SLICE = re.compile(r"Data_Slice_(\d+)\.mat")
_DIAMETER_SLICE = re.compile(r"(\d+(?:\.\d+)?)mm_Data_(\d+)\.mat")
# Among this many frames on either side, at least one should have been read without delay.
_NEIGHBOURS = 12
# After a missing frame the stamps are higher by this fraction of a period. A late frame does not count.
_MIN_MISSING = 0.8
# Fewer frames after a gap, at the end, may all be late.
_MIN_AFTER = 4
# The load cell's board sends a line every 91.6 ms.
LOAD_PERIOD_S = 0.0916
_CYLINDER = re.compile(r"(\d+(?:\.\d+)?)mm[_.]")
# Stamps of frames and load that differ less than this, row by row, come from one loop.
_ONE_LOOP_S = 0.02
# A loop waited for its load values where this many end within this time of the line below all of them.
_MIN_PACED, _PACED_S = 3, 0.03
# The paper's loop began to read this long after the load cell's board began to send. Recordings show 2.4 to 2.8 s by
# their stamps, ± 0.27 s each, and 2.7 s by the gel's motion: one program, one delay. A loop with stamps
# that differ by more than the second number comes from another program.
_PROGRAM_LATE_S, _OTHER_PROGRAM_S = 2.7, 0.55
# Rounding to a larger fraction of the largest torque costs accuracy.
_COARSE_FRACTION = 0.02
_HDF5_SIGNATURE = b"\x89HDF"


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Arrival times unix_s (n,), and a fingertip's lines (n, 1024) in volts or the load cell's torques (n, 1) in N·m.

    The file names no time zone, so its times are read as UTC. Damaged torques are included.
    """

    unix_s: FloatArray
    values: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Slices:
    """Differences (n, 896) |frame − homogeneous frame| in volts at torque_nm (n,), by the numbers in the files' names.

    diameter_mm (n,) is of the cylinders, NaN for torque slices.
    """

    differences: FloatArray
    torque_nm: FloatArray
    numbers: IntArray
    diameter_mm: FloatArray


def find_streams(path: Path) -> tuple[str, ...]:
    """Return the streams of a file: "right", "left" or "load"; raises UserError if it cannot be read or has none."""
    variables = _load(path)
    found = tuple(stream for stream, names in STREAM_VARIABLES.items() if any(name in variables for name in names))
    if not found:
        wanted = ", ".join(name for names in STREAM_VARIABLES.values() for name in names)
        raise UserError(f"{path} holds {', '.join(variables) or 'no variable'}, expected one of {wanted}")
    return found


def read_stream(path: Path, name: str | None = None, time_format: str = DATENUM) -> Stream:
    """Return the stream "right", "left" or "load", by default the only fingertip's.

    `time_format` is one of TIME_FORMATS. Raises UserError for a file that cannot be read or holds no such stream, and
    for times that are not of this format.
    """
    table = _table(path, name)
    # A load may stand still, and a copy of its value changes nothing.
    if name != "load" or (np.ptp(table[:, 1]) > 0.0 and np.median(np.diff(table[:, 0])) == 0.0):
        _check_distinct(path, table)
    _check_times(path, table[:, 0], time_format, _SHORTEST_STEP_S if name == "load" else _SHORTEST_FRAME_S)
    return Stream(_unix_s(table[:, 0], time_format), np.ascontiguousarray(table[:, 1:]))


def read_lines(path: Path, side: str | None = None) -> FloatArray:
    """Return the lines (n, 1024) in volts of a fingertip's stream; its times may have any format.

    Raises UserError as `read_stream` does.
    """
    return np.ascontiguousarray(_table(path, side)[:, 1:])


def _table(path: Path, name: str | None) -> FloatArray:
    names = STREAM_VARIABLES[name] if name is not None else (*STREAM_VARIABLES["right"], *STREAM_VARIABLES["left"])
    table, width = _one_of(path, _load(path), names), 1 if name == "load" else PAPER_TABLE.n_line_values
    if table.shape[1] != width + 1 or len(table) == 0:
        raise UserError(f"{path}: expected rows of one time and {counted(width, 'value')}, found {_size(table)}")
    return table


def _check_distinct(path: Path, table: FloatArray) -> None:
    """Raise UserError for a frame that was copied: the rows (n, 1 + values) after it would seem to come later."""
    copied = np.flatnonzero((table[1:] == table[:-1]).all(axis=1))
    if len(copied):
        copies = counted(len(copied), "copy", "copies")
        raise UserError(
            f"{path}: row {copied[0] + 2} is a copy of the row above, with its time ({copies} in all): remove the "
            "copies"
        )


def _unix_s(times: FloatArray, time_format: str) -> FloatArray:
    form = TIME_FORMATS[time_format]
    return (times - form.epoch) * form.unit_s


def _fits(times: FloatArray, time_format: str, shortest_s: float) -> bool:
    """Return whether times (n,) in a format are plausible: of this century, or near 0, and about a line apart."""
    form, t_s = TIME_FORMATS[time_format], _unix_s(times, time_format)
    earliest_s, latest_s = (_EARLIEST_S, _LATEST_S) if form.has_date else (0.0, _LONGEST_ELAPSED_S)
    if not (t_s.min() >= earliest_s and t_s.max() <= latest_s):
        return False
    return len(t_s) == 1 or shortest_s <= float(np.median(np.diff(t_s))) <= _LONGEST_STEP_S


def _set_back(steps_s: FloatArray) -> int | None:
    """Return the step (n,) at which the clock was set back, None without one.

    Late times return to where they would have been. Those of a clock that was set back stay behind.
    """
    if not len(steps_s):
        return None
    # How late each row is, against rows at the usual step.
    late_s = np.concatenate([[0.0], np.cumsum(steps_s - np.median(steps_s))])
    for at in np.flatnonzero(steps_s < 0).tolist():
        before_s, after_s = late_s[max(0, at + 1 - _COMPARED_ROWS) : at + 1], late_s[at + 1 : at + 1 + _COMPARED_ROWS]
        if steps_s[at] < -_LARGEST_DELAY_S or before_s.min() - after_s.max() > _LEAST_SET_BACK_S:
            return int(at)
    return None


def _check_times(path: Path, times: FloatArray, time_format: str, shortest_s: float) -> None:
    """Raise UserError, with the finding and the cure, unless times (n,) are of the format and do not fall."""
    steps = np.diff(times)
    if _fits(times, time_format, shortest_s):
        steps_s = steps * TIME_FORMATS[time_format].unit_s
        fallen = int((steps_s < 0).sum())
        if fallen > max(1, _MAX_LATE * len(steps_s)):
            first = int(np.argmax(steps_s < 0)) + 2
            raise UserError(
                f"{path}: {fallen} rows are before the row above them, row {first} first: sort the rows by their times"
            )
        if (at := _set_back(steps_s)) is not None:
            raise UserError(
                f"{path}: the time in row {at + 2} is {-steps_s[at]:.1f} s before that of row {at + 1}: the clock was "
                "set back; import the rows before and after as two recordings"
            )
        return
    found = f"the times begin with {times[0]:.10g}"
    if len(steps):
        found += f" and rise by {float(np.median(steps)):.3g} from row to row"
    wrong = f"{path}: {found}, which is not {time_format}, {TIME_FORMATS[time_format].words}"
    distinct = len(np.unique(times))
    is_single = bool(times[0]) and np.array_equal(times, times.astype(np.float32))
    if len(times) > 1 and distinct == 1 and not is_single:
        raise UserError(
            f"{path}: every row has the time {times[0]:.10g}: write the time of each row into the first column"
        )
    if len(steps) and np.median(steps) == 0:
        single = ": they were saved in single precision" if is_single else ""
        raise UserError(
            f"{path}: {counted(len(times), 'row')} have {counted(distinct, 'different time')}{single}; "
            "save the times again as doubles"
        )
    fitting = [name for name in TIME_FORMATS if _fits(times, name, shortest_s)]
    if fitting:
        raise UserError(f"{wrong}; give --time-format {' or '.join(fitting)}")
    raise UserError(f"{wrong}, with a row every {shortest_s:g} to {_LONGEST_STEP_S:g} s; correct the first column")


def read_line(path: Path) -> FloatArray:
    """Return the (1024,) values in volts of a file with a single line; raises UserError as `read_stream` does."""
    return _row(path, _one_of(path, _load(path), _LINES), PAPER_TABLE.n_line_values)


def read_torque_slices(folder: Path) -> Slices:
    """Return the slices Data_Slice_N.mat of a folder by rising N, which may have gaps.

    Raises UserError for a folder without any, and for a file that cannot be used.
    """
    return _read_slices(folder, "torque", _TORQUE_SLICE, "torque_value", "Data_Slice_1.mat, Data_Slice_2.mat")


def read_diameter_slices(folder: Path) -> Slices:
    """Return the slices DDmm_Data_N.mat of a folder by rising diameter, then N; raises as `read_torque_slices` does."""
    return _read_slices(folder, "diameter", _DIAMETER_SLICE, "mean_torque", "10mm_Data_1.mat, 20mm_Data_1.mat")


def _read_slices(folder: Path, kind: str, pattern: re.Pattern[str], torque_name: str, examples: str) -> Slices:
    try:
        found = [(pattern.fullmatch(path.name), path) for path in folder.iterdir()]
    except OSError as error:
        raise UserError(f"{folder}: the recordings cannot be listed: {error.strerror}") from error
    files = sorted((tuple(map(float, match.groups())), path) for match, path in found if match)
    if not files:
        raise UserError(f"{folder} has no {kind} slices: expected files named {examples} …")
    differences, torques = [], []
    for _, path in files:
        variables = _load(path)
        differences.append(_row(path, _one_of(path, variables, ["data_diff"]), PAPER_TABLE.n_channels))
        if not differences[-1].any():
            raise UserError(f"{path}: data_diff is zero in all channels; leave this slice out")
        torques.append(_row(path, _one_of(path, variables, [torque_name]), 1)[0])
    named = np.array([numbers for numbers, _ in files])
    diameter_mm = named[:, 0] if kind == "diameter" else np.full(len(files), np.nan)
    return Slices(np.array(differences), np.array(torques), named[:, -1].astype(int), diameter_mm)


def _load(path: Path) -> dict[str, Variable]:
    try:
        with open_file(path) as file:
            content = file.read()
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error
    if content.startswith(_HDF5_SIGNATURE) or content.startswith(b"MATLAB 7.3"):
        raise UserError(f"{path} is a MATLAB file of version 7.3; save it again with `save -v7`")
    if not content.startswith(b"MATLAB"):
        raise UserError(f"{path} is not a MATLAB file: expected a recording saved with `save -v6` or `save -v7`")
    try:
        return read_variables(content)
    except MatFileError as error:
        raise UserError(f"{path}: the recording is truncated or damaged: {error}; copy it again") from error


def _one_of(path: Path, variables: dict[str, Variable], names: Sequence[str]) -> FloatArray:
    """Return the only matrix that has one of these names."""
    present = [name for name in names if name in variables]
    if len(present) > 1:
        raise UserError(f"{path} holds {' and '.join(present)}; choose one of them")
    if not present:
        others = ", ".join(variables) or "no variable"
        raise UserError(f"{path} holds {others}, expected {' or '.join(names)}")
    values = variables[present[0]]
    if not isinstance(values, np.ndarray):
        raise UserError(f"{path}: {present[0]} is {values}, expected a matrix of real numbers")
    if not np.isfinite(values).all():
        wrong = int((~np.isfinite(values)).sum())
        found = counted(wrong, "value that is not a finite number", "values that are not finite numbers")
        raise UserError(f"{path}: {present[0]} has {found}")
    return values


def _row(path: Path, values: FloatArray, length: int) -> FloatArray:
    if values.shape not in ((1, length), (length, 1)):
        raise UserError(f"{path}: expected 1 × {length} values, found {_size(values)}")
    return values.ravel()


def _size(values: FloatArray) -> str:
    return " × ".join(map(str, values.shape))


@dataclass(frozen=True, slots=True)
class ImportResult:
    """The imported frames by side, the torques' number and range in N·m, and remarks in sentences."""

    frames: dict[str, int]
    torques: int
    remarks: tuple[str, ...]
    torque_range_nm: tuple[float, float] | None = None


def import_mat(sources: Sequence[Path], out: Path, time_format: str = DATENUM) -> ImportResult:
    """Write the streams of MATLAB files, or of folders of them, into one recording.

    The times in the files are of `time_format`, one of TIME_FORMATS. Time stamps are corrected, and damaged load values
    are left out. Raises UserError for a file without a stream, for two streams of one side, for streams of different
    times, for other times, for torques or voltages of another unit, and if there are no frames.
    """
    files = _mat_files(sources)
    load, streams, load_path = _read_streams(files, time_format)
    remarks: list[str] = []
    if not TIME_FORMATS[time_format].has_date:
        remarks.append("The files name no date: their time 0 is 1970-01-02 00:00 UTC in the recording.")
    notes: dict[str, str] = {}
    sure = True
    if load is None:
        load = Stream(np.zeros(0), np.zeros((0, 1)))
    elif any(_is_one_loop(load.unix_s, stream.unix_s) for stream in streams.values()):
        for stream in streams.values():
            _check_whole(stream.unix_s)
        load, streams, sure = _loop_times(load, streams, remarks)
    valid, left_out = valid_load(load_path, load.unix_s, load.values[:, 0])
    load = Stream(load.unix_s[valid], load.values[valid])
    remarks += [f"Left out: {clause}." for clause in left_out]
    if left_out:
        notes[LEFT_OUT_NOTE] = "; ".join(left_out)
    remarks += _rounded_load(load.values[:, 0])
    arrivals = {side: [round(float(unix_s) * 1e9) for unix_s in stream.unix_s] for side, stream in streams.items()}
    middles = {side: frame_middles(arrivals_ns) for side, arrivals_ns in arrivals.items()}
    all_series = [_series_of_side(side, stream, middles[side], load) for side, stream in streams.items()]
    delay = measured_delay(all_series)
    faults = (find_clock_fault(series, delay) for series in all_series)
    fault = next((one for one in faults if one is not None), None)
    if fault is None or not fault.is_jump:
        remarks += _missing_load(load.unix_s, max(float(stream.unix_s.max()) for stream in streams.values()))
        remarks += [_missing(side, arrivals_ns) for side, arrivals_ns in arrivals.items() if pauses(arrivals_ns)]
    if fault is not None:
        remarks.append(f"Warning: {fault.text}; {fault.cure}.")
    elif delay is not None and delay.late_s:
        load = replace(load, unix_s=load.unix_s - delay.late_s)
        remarks.append(
            f"The load was stamped {delay.late_s:.2f} ± {delay.error_s:.2f} s too late against the gel's motion, "
            "and its times were corrected."
        )
    if delay is None and not sure:
        notes[LOAD_DOUBT_NOTE] = LOAD_DOUBT
    if remarks:
        notes[REMARKS_NOTE] = " ".join(remarks)
    if (diameter := _diameter_mm(files)) is not None:
        notes[DIAMETER_NOTE] = diameter
    source = ", ".join(sorted(path.name for path in files))
    with new_recording(out, source, notes, keep_unfinished=False) as writer:
        for side in (side for side in SIDES if side in streams):
            rows = zip(middles[side], arrivals[side], streams[side].values, strict=True)
            for middle_ns, arrival_ns, line in rows:
                writer.add_frame(side, middle_ns, arrival_ns, line)
        for t_s, torque in zip(load.unix_s, load.values[:, 0], strict=True):
            writer.add_torque(round(float(t_s) * 1e9), float(torque))
    counts = {side: len(stream.unix_s) for side, stream in streams.items()}
    torques = load.values[:, 0]
    span = (float(torques.min()), float(torques.max())) if len(torques) else None
    return ImportResult(counts, len(torques), tuple(remarks), span)


def _read_streams(files: Sequence[Path], time_format: str) -> tuple[Stream | None, dict[str, Stream], Path]:
    """Return the load cell's stream, if any, the fingertips' by side, and the load's file (else the first one).

    Raises UserError as `import_mat` does.
    """
    streams: dict[str, Stream] = {}
    paths: dict[str, Path] = {}
    for path in files:
        for name in find_streams(path):
            if name in streams:
                raise UserError(
                    f"{path} is a second stream of {name}, after {paths[name]}: import one recording at a time, and "
                    "name its files instead of the folder, such as one of a fingertip and one of the load cell"
                )
            streams[name] = read_stream(path, name, time_format)
            paths[name] = path
    for earlier, later in itertools.permutations(streams, 2):
        apart_s = float(streams[later].unix_s.min() - streams[earlier].unix_s.max())
        if apart_s > _LONGEST_STEP_S:
            if (zones_s := _zones_apart_s(streams[earlier].unix_s, streams[later].unix_s)) is not None:
                raise UserError(
                    f"{paths[later]} begins {_hours(zones_s)} after {paths[earlier]}, within "
                    f"{_SAME_START_S:.0f} s, and lasts as long: their times are of two time zones; write both in one. "
                    "If they are of two recordings, import the files of one recording at a time"
                )
            raise UserError(
                f"{paths[later]} begins {apart_s:.0f} s after the end of {paths[earlier]}: they are of two recordings; "
                "import the files of one recording at a time"
            )
    load = streams.pop("load", None)
    if not streams:
        raise UserError("the files hold no frames of a fingertip; name the files of the right or left side too")
    for side, stream in streams.items():
        _check_volts(paths[side], stream.values)
    return load, streams, paths.get("load", files[0])


def _zones_apart_s(earlier_s: FloatArray, later_s: FloatArray) -> float | None:
    """Return the offset in s of two time zones if (n,) and (m,) are times of one recording in both, else None."""
    apart_s = float(later_s.min() - earlier_s.min())
    zones_s = round(apart_s / _ZONE_S) * _ZONE_S
    lasts_s = [float(np.ptp(times_s)) for times_s in (earlier_s, later_s)]
    is_one = abs(apart_s - zones_s) <= _SAME_START_S and abs(lasts_s[1] - lasts_s[0]) <= 2 * _SAME_START_S
    return zones_s if is_one and 0 < zones_s <= _LARGEST_ZONE_S else None


def _hours(seconds: float) -> str:
    return f"{seconds / 3600:g} h"


def _check_volts(path: Path, lines: FloatArray) -> None:
    """Raise UserError where more values of lines (n, 1024) in volts are impossible than a cable damages."""
    beyond = np.count_nonzero((lines < 0) | (lines > ADC_REFERENCE_V))
    if beyond > MAX_DAMAGED * lines.size:
        raise UserError(
            f"{path}: {beyond / lines.size:.0%} of the values are not within 0 to {ADC_REFERENCE_V:g} V, the range of "
            "the board's converter; write them in volts"
        )


def frame_middles(arrivals_ns: Sequence[int]) -> list[int]:
    """Return the middle of each frame's acquisition from its arrival, in nanoseconds.

    A frame is read when it is complete or later. The board's clock is therefore the line below the stamps
    (`drivers.eit_kit`), one between each two pauses. The earliest stamp among the neighbours gives its height.
    """
    edges = [0, *pauses(arrivals_ns), len(arrivals_ns)]
    parts = [range(first, end) for first, end in itertools.pairwise(edges)]
    longest = [(n, arrivals_ns[n]) for n in max(parts, key=len)]
    period = slope_below(longest) if len(longest) > 1 else 1e9 * FRAME_PERIOD_S
    middles: list[int] = []
    for part in parts:
        height = np.array([float(arrivals_ns[n] - arrivals_ns[0]) - n * period for n in part])
        lowest = minimum_filter1d(height, 2 * _NEIGHBOURS + 1, mode="nearest")
        middles += [arrivals_ns[0] + round(low + (n - 0.5) * period) for n, low in zip(part, lowest, strict=True)]
    return middles


def pauses(arrivals_ns: Sequence[int]) -> list[int]:
    """Return the numbers of the frames before which frames are missing, because the board or its program paused.

    A late reading raises a stamp above the board's clock for a while, and lets the next ones come at once. After
    missing frames all stamps stay higher. The last frames do not show which of the two it was.
    """
    n, t_ns = len(arrivals_ns), np.array(arrivals_ns, dtype=np.int64)
    if n <= 2 * _NEIGHBOURS:
        return []
    # Over a longer span late readings matter less, and over a shorter one fewer spans hold a pause.
    span = min(2 * _NEIGHBOURS, n // 8)
    period_ns = float(np.median(t_ns[span:] - t_ns[:-span])) / span
    height, least_ns = t_ns - t_ns[0] - period_ns * np.arange(n), _MIN_MISSING * period_ns
    found: list[int] = []
    parts = [(0, n)]
    while parts:
        first, end = parts.pop()
        latest = min(end - 1, n - _MIN_AFTER)
        risen = [at for at in range(first + 1, latest + 1) if _rise(height[first:end], at - first) >= least_ns]
        if risen:
            # The neighbours of a pause rise too. It is where the stamps are the furthest apart.
            at = max(risen, key=lambda one: t_ns[one] - t_ns[one - 1])
            found.append(at)
            parts += [(first, at), (at, end)]
    return sorted(found)


def _rise(height: FloatArray, at: int) -> float:
    """Return how much higher the lowest of the next (n,) heights is than the lowest of those before."""
    return float(height[at : at + _NEIGHBOURS].min() - height[max(0, at - _NEIGHBOURS) : at].min())


def _check_whole(stamps_s: FloatArray) -> None:
    """Raise UserError for a loop that paused: how many load values its buffer has lost meanwhile is unknown."""
    found = pauses([round(float(stamp_s) * 1e9) for stamp_s in stamps_s])
    if found:
        at = found[0]
        raise UserError(
            f"frames are missing between the rows {at} and {at + 1}, for {stamps_s[at] - stamps_s[at - 1]:.1f} s, and "
            "the load cell's times follow from whole streams alone: import the rows before and after as two recordings"
        )


def _missing(side: str, arrivals_ns: Sequence[int]) -> str:
    """Return the remark on the frames of a side that are missing."""
    found = pauses(arrivals_ns)
    longest_s = max(arrivals_ns[at] - arrivals_ns[at - 1] for at in found) / 1e9
    return (
        f"Frames of the {side} side are missing in {counted(len(found), 'place')}, for up to {longest_s:.1f} s: the "
        "board or its program paused."
    )


def _missing_load(stamps_s: FloatArray, last_frame_s: float) -> Iterator[str]:
    """Yield the remark on load values that are missing, where there is one, or that come after the last frame."""
    pauses_s = np.diff(stamps_s)
    at = np.flatnonzero(pauses_s > longest_load_gap_s(stamps_s))
    after_last = [one for one in at.tolist() if stamps_s[one + 1] > last_frame_s]
    if after_last:
        first, at = after_last[0], at[: -len(after_last)]
        yield (
            f"Warning: the last {len(stamps_s) - first - 1} of {counted(len(stamps_s), 'load value')} are after the "
            f"last frame, from a step of {pauses_s[first]:.1f} s in their times on: if the load cell measured all the "
            "time, its clock was set forward by that step. Correct the times, or record again with one clock for both."
        )
    if len(at):
        yield (
            f"Load values are missing in {counted(len(at), 'place')}, for up to {pauses_s[at].max():.1f} s: frames "
            "there have no torque."
        )


def _rounded_load(torque_nm: FloatArray) -> Iterator[str]:
    """Yield the remark on torques (n,) in N·m that are rounded coarsely, where they are."""
    step_nm = rounding_step_nm(torque_nm)
    largest_nm = float(np.abs(torque_nm).max(initial=0.0))
    if step_nm > _COARSE_FRACTION * largest_nm:
        yield (
            f"The load values are rounded to {step_nm:.2g} N·m, and the largest is {largest_nm:.2g} N·m: print more "
            "digits in the load cell's sketch."
        )


def _loop_clock(stamps_s: FloatArray) -> tuple[float, float] | None:
    """Return when a loop's lines were sent: the first load after the first stamp, and frames after theirs, in s.

    A loop with (n,) stamps reads one line of each board per row, and stamps a row before it reads it. So its lines were
    sent before the next stamp. After a stall the loop empties the fingertips' buffers, and waits for the load alone:
    then the load was sent at the next stamp. Frames were sent between the two stamps, in the middle on average.
    None where the stamps do not show this.
    """
    if len(stamps_s) <= _MIN_PACED:
        return None
    latest_s = stamps_s[1:] - stamps_s[0] - LOAD_PERIOD_S * np.arange(len(stamps_s) - 1)
    if np.count_nonzero(latest_s <= latest_s.min() + _PACED_S) < _MIN_PACED:
        return None
    return float(latest_s.min()), float(np.median(np.diff(stamps_s))) / 2


def _loop_times(load: Stream, streams: dict[str, Stream], remarks: list[str]) -> tuple[Stream, dict[str, Stream], bool]:
    """Return the streams of one loop with the times of sending, and whether these are sure."""
    # The loop read one line per frame and the board sends six. The rest waited in the port's buffer.
    clock = _loop_clock(load.unix_s)
    load_late_s, late_s = clock or (0.0, 0.0)
    t_s = load.unix_s[0] + load_late_s + LOAD_PERIOD_S * np.arange(len(load.unix_s))
    remarks.append(
        f"The load cell was read once per frame but sends a value every {1e3 * LOAD_PERIOD_S:.1f} ms, so its "
        f"values waited in a buffer. Their times are now one period apart, {t_s[-1] - t_s[0]:.0f} s in all."
    )
    if clock is None:
        remarks.append(f"Warning: {LOAD_DOUBT}.")
        return replace(load, unix_s=t_s), streams, False
    shown_s = load_late_s - late_s
    moved_s = _PROGRAM_LATE_S if abs(shown_s - _PROGRAM_LATE_S) <= _OTHER_PROGRAM_S else shown_s
    t_s = t_s + (moved_s - shown_s)
    remarks.append(
        f"The loop waited for its first load values, which shows {shown_s:.2f} ± {late_s:.2f} s of delay. The load's "
        f"times were moved by {moved_s:.2f} s against the frames"
        + (", the delay of the program." if moved_s != shown_s else ".")
    )
    frames = {
        # The next stamp less half a period: the first rows were stamped before the loop waited for its frames.
        side: replace(stream, unix_s=np.append(stream.unix_s[1:] - late_s, stream.unix_s[-1] + late_s))
        for side, stream in streams.items()
    }
    return replace(load, unix_s=t_s), frames, True


def _series_of_side(side: str, stream: Stream, middles_ns: Sequence[int], load: Stream) -> FrameSeries:
    t_s = np.array(middles_ns) / 1e9
    channels = PAPER_TABLE.channels_of_line(stream.values)[:, None]
    return FrameSeries((side,), t_s, channels, load.unix_s, load.values[:, 0], np.full(len(t_s), np.nan))


def _is_one_loop(load_s: FloatArray, frame_s: FloatArray) -> bool:
    return len(load_s) == len(frame_s) and float(np.median(np.abs(load_s - frame_s))) < _ONE_LOOP_S


def _diameter_mm(files: Sequence[Path]) -> str | None:
    """Return the diameter in mm that the files' names start with (10mm_1_right.mat); UserError if they differ."""
    found = sorted({match[1] for path in files if (match := _CYLINDER.match(path.name))})
    if len(found) > 1:
        raise UserError(f"the files are of cylinders of {' and '.join(found)} mm; import one recording at a time")
    return found[0] if found and 0 < float(found[0]) < LARGEST_DIAMETER_MM else None


def _mat_files(sources: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for source in sources:
        inside = sorted(source.glob("*.mat")) if source.is_dir() else [source]
        if not inside:
            raise UserError(f"{source} holds no .mat files; name the folder of one recording")
        found += inside
    return found
