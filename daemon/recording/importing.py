"""Brings the paper's MATLAB streams into a recording: stamps straightened, damaged load values counted and left out."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter1d

from shearloop.bank.arrays import FloatArray
from shearloop.bank.estimation.values import LARGEST_TORQUE_NM
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab_streams import LoadStream, Stream, contents, read_load_stream, read_stream
from shearloop.daemon.recording.schema import DIAMETER_NOTE, LARGEST_DIAMETER_MM, SIDES
from shearloop.daemon.recording.writer import RecordingWriter
from shearloop.drivers.frame_clock import slope_below

NOMINAL_PERIOD_NS = 541_200_000
# Frames on either side among which one is hoped not to have waited for its reader.
_AROUND_FRAMES = 12
# The load cell's board sends a line each 91.6 ms, whether anyone reads it or not.
LOAD_PERIOD_S = 0.0916
_DIAMETER = re.compile(r"(\d+(?:\.\d+)?)mm[_.]")
# Stamps of frames and load that lie within this of each other, row by row, come from one loop.
_ONE_LOOP_S = 0.02


@dataclass(frozen=True, slots=True)
class Imported:
    """What went into a recording, and what was done to it on the way, in sentences."""

    frames: dict[str, int]
    torques: int
    remarks: tuple[str, ...]


def import_mat(sources: Sequence[Path], out: Path) -> Imported:
    """Write the streams of MATLAB files, or of folders of them, into one recording.

    Raises UserError for a file that holds no stream, for two streams of one side, and when there are no frames.
    """
    streams: dict[str, Stream] = {}
    load: LoadStream | None = None
    for path in _files(sources):
        for what in contents(path):
            if what in streams or (what == "load" and load is not None):
                raise UserError(f"{path} is a second stream of {what}; import one recording at a time")
            if what == "load":
                load = read_load_stream(path)
            else:
                streams[what] = read_stream(path, what)
    if not streams:
        raise UserError("no frames of a fingertip among the files; name those of the right or left side as well")
    remarks: list[str] = []
    torque_t_s, torque_nm = _load(load, streams, remarks)
    source = ", ".join(sorted(path.name for path in _files(sources)))
    notes = {"remarks": " ".join(remarks)} if remarks else {}
    if (diameter := _diameter_mm(_files(sources))) is not None:
        notes[DIAMETER_NOTE] = diameter
    with RecordingWriter(out, source, notes or None) as writer:
        for side in (side for side in SIDES if side in streams):
            stream = streams[side]
            arrivals = [round(float(unix_s) * 1e9) for unix_s in stream.unix_s]
            for middle_ns, arrival_ns, line in zip(middles(arrivals), arrivals, stream.lines, strict=True):
                writer.frame(side, middle_ns, arrival_ns, line)
        for t_s, torque in zip(torque_t_s, torque_nm, strict=True):
            writer.torque(round(float(t_s) * 1e9), float(torque))
    return Imported({side: len(streams[side].unix_s) for side in streams}, len(torque_nm), tuple(remarks))


def middles(arrivals_ns: Sequence[int]) -> list[int]:
    """Return when the middle of each frame's acquisition was, from when each was read, all in nanoseconds.

    A frame is sent when it is complete and is read then or later, never earlier: the board's clock is the line below
    the stamps (`shearloop.drivers.frame_clock`), here with the frames after it known as well. Its height is that of
    the earliest
    of the frames around, so that a board which paused is followed.
    """
    numbered = list(enumerate(arrivals_ns))
    period = slope_below(numbered) if len(numbered) > 1 else float(NOMINAL_PERIOD_NS)
    height = np.array([float(arrival - arrivals_ns[0]) - n * period for n, arrival in numbered])
    lowest = minimum_filter1d(height, 2 * _AROUND_FRAMES + 1, mode="nearest")
    return [arrivals_ns[0] + round(low + (n - 0.5) * period) for n, low in enumerate(lowest)]


def _load(load: LoadStream | None, streams: dict[str, Stream], remarks: list[str]) -> tuple[FloatArray, FloatArray]:
    if load is None:
        return np.zeros(0), np.zeros(0)
    t_s, torque = load.unix_s, load.torque_nm
    if any(_one_loop(t_s, stream.unix_s) for stream in streams.values()):
        # One line was taken off the port per frame, and the board sends six: the rest waited in the port's buffer.
        t_s = t_s[0] + LOAD_PERIOD_S * np.arange(len(t_s))
        remarks.append(
            f"The load cell was read once per frame although it sends one each {1e3 * LOAD_PERIOD_S:.1f} ms, so "
            f"its values waited in a buffer; they got the times of their sending, {t_s[-1] - t_s[0]:.0f} s in all."
        )
    sound = np.abs(torque) <= LARGEST_TORQUE_NM
    if not sound.all():
        remarks.append(
            f"{np.count_nonzero(~sound)} load values beyond {LARGEST_TORQUE_NM:g} N·m are damaged and were left out."
        )
    order = np.argsort(t_s[sound], kind="stable")
    return t_s[sound][order], torque[sound][order]


def _one_loop(load_s: FloatArray, frame_s: FloatArray) -> bool:
    return len(load_s) == len(frame_s) and float(np.median(np.abs(load_s - frame_s))) < _ONE_LOOP_S


def _diameter_mm(files: Sequence[Path]) -> str | None:
    """Return the diameter in mm that the files' names begin with, as those of cylinders do (10mm_1_right.mat).

    Raises UserError where they tell of different ones.
    """
    told = sorted({found[1] for path in files if (found := _DIAMETER.match(path.name))})
    if len(told) > 1:
        raise UserError(f"the files are of cylinders of {' and '.join(told)} mm; import one recording at a time")
    return told[0] if told and 0 < float(told[0]) < LARGEST_DIAMETER_MM else None


def _files(sources: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for source in sources:
        if source.is_dir():
            inside = sorted(source.glob("*.mat"))
            if not inside:
                raise UserError(f"{source} holds no .mat files; name the folder of one recording")
            found += inside
        else:
            found.append(source)
    return found
