"""Imports the paper's MATLAB streams as a recording: corrects the time stamps, leaves out damaged load values."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter1d

from shearloop.bank.arrays import FloatArray
from shearloop.bank.estimation.values import LARGEST_TORQUE_NM
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab import LoadStream, Stream, find_streams, read_load_stream, read_stream
from shearloop.daemon.recording.schema import DIAMETER_NOTE, LARGEST_DIAMETER_MM, SIDES
from shearloop.daemon.recording.writer import RecordingWriter
from shearloop.drivers.frame_clock import slope_below

NOMINAL_PERIOD_NS = 541_200_000
# Among this many frames on either side, at least one should have been read without delay.
_NEIGHBOURS = 12
# The load cell's board sends a line every 91.6 ms.
LOAD_PERIOD_S = 0.0916
_DIAMETER = re.compile(r"(\d+(?:\.\d+)?)mm[_.]")
# Stamps of frames and load that differ less than this, row by row, come from one loop.
_ONE_LOOP_S = 0.02


@dataclass(frozen=True, slots=True)
class ImportResult:
    """The imported frames by side, the number of torques, and remarks in sentences."""

    frames: dict[str, int]
    torques: int
    remarks: tuple[str, ...]


def import_mat(sources: Sequence[Path], out: Path) -> ImportResult:
    """Write the streams of MATLAB files, or of folders of them, into one recording.

    Raises UserError for a file without a stream, for two streams of one side, and if there are no frames.
    """
    files = _mat_files(sources)
    streams: dict[str, Stream] = {}
    load: LoadStream | None = None
    for path in files:
        for name in find_streams(path):
            if name in streams or (name == "load" and load is not None):
                raise UserError(f"{path} is a second stream of {name}; import one recording at a time")
            if name == "load":
                load = read_load_stream(path)
            else:
                streams[name] = read_stream(path, name)
    if not streams:
        raise UserError("the files hold no frames of a fingertip; name those of the right or left side as well")
    remarks: list[str] = []
    torque_t_s, torque_nm = _corrected_load(load, streams, remarks)
    notes = {"remarks": " ".join(remarks)} if remarks else {}
    if (diameter := _diameter_mm(files)) is not None:
        notes[DIAMETER_NOTE] = diameter
    with RecordingWriter(out, ", ".join(sorted(path.name for path in files)), notes) as writer:
        for side in (side for side in SIDES if side in streams):
            stream = streams[side]
            arrivals = [round(float(unix_s) * 1e9) for unix_s in stream.unix_s]
            for middle_ns, arrival_ns, line in zip(frame_middles(arrivals), arrivals, stream.lines, strict=True):
                writer.add_frame(side, middle_ns, arrival_ns, line)
        for t_s, torque in zip(torque_t_s, torque_nm, strict=True):
            writer.add_torque(round(float(t_s) * 1e9), float(torque))
    return ImportResult({side: len(streams[side].unix_s) for side in streams}, len(torque_nm), tuple(remarks))


def frame_middles(arrivals_ns: Sequence[int]) -> list[int]:
    """Return the middle of each frame's acquisition from its arrival, in nanoseconds.

    A frame is read when it is complete or later. The board's clock is therefore the line below the stamps
    (`drivers.frame_clock`). The earliest stamp among the neighbours gives its height, so that it follows a
    board that paused.
    """
    numbered = list(enumerate(arrivals_ns))
    period = slope_below(numbered) if len(numbered) > 1 else float(NOMINAL_PERIOD_NS)
    height = np.array([float(arrival - arrivals_ns[0]) - n * period for n, arrival in numbered])
    lowest = minimum_filter1d(height, 2 * _NEIGHBOURS + 1, mode="nearest")
    return [arrivals_ns[0] + round(low + (n - 0.5) * period) for n, low in enumerate(lowest)]


def _corrected_load(
    load: LoadStream | None, streams: dict[str, Stream], remarks: list[str]
) -> tuple[FloatArray, FloatArray]:
    """Return the times in s and torques in N·m of the valid load values; appends to `remarks`."""
    if load is None:
        return np.zeros(0), np.zeros(0)
    t_s, torque = load.unix_s, load.torque_nm
    if any(_is_one_loop(t_s, stream.unix_s) for stream in streams.values()):
        # The loop read one line per frame and the board sends six. The rest waited in the port's buffer.
        t_s = t_s[0] + LOAD_PERIOD_S * np.arange(len(t_s))
        remarks.append(
            f"The load cell was read once per frame but sends a value every {1e3 * LOAD_PERIOD_S:.1f} ms, so its "
            f"values waited in a buffer. They got the times at which they were sent, {t_s[-1] - t_s[0]:.0f} s in all."
        )
    valid = np.abs(torque) <= LARGEST_TORQUE_NM
    if not valid.all():
        remarks.append(
            f"{np.count_nonzero(~valid)} load values beyond {LARGEST_TORQUE_NM:g} N·m are damaged and were left out."
        )
    order = np.argsort(t_s[valid], kind="stable")
    return t_s[valid][order], torque[valid][order]


def _is_one_loop(load_s: FloatArray, frame_s: FloatArray) -> bool:
    return len(load_s) == len(frame_s) and float(np.median(np.abs(load_s - frame_s))) < _ONE_LOOP_S


def _diameter_mm(files: Sequence[Path]) -> str | None:
    """Return the diameter in mm that the files' names start with (10mm_1_right.mat); UserError if they differ."""
    found = sorted({match[1] for path in files if (match := _DIAMETER.match(path.name))})
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
