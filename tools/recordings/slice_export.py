"""Exports a recorded sweep as slices: the input of the paper's analysis, one MATLAB file for each held angle.

A slice is the frame at the middle of a hold, smoothed over time like the paper's (Gaussian over nine frames), minus
the homogeneous frame, as an absolute value. It comes with the load cell's torque over the same time. The homogeneous
frame is the mean of the frames of the latest `tare` step.
"""

import re
from collections import Counter, deque
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from shearloop.bank.arrays import FloatArray
from shearloop.bank.channels import ChannelTable
from shearloop.daemon.messaging.messages import EitFrame, GripperStateMessage, LoadTorque, LoopState
from shearloop.daemon.recorder import schema
from shearloop.errors import UserError
from shearloop.files import replace_file
from shearloop.tools.outputs import new_folder
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.matlab_import import DIAMETER_FOLDER, RAW_FRAME, RAW_HOMOGENEOUS, TORQUE_FOLDER
from shearloop.tools.recordings.message_content import check_length
from shearloop.tools.recordings.reader import open_recording, read_messages, refusing_content
from shearloop.tools.recordings.recorded_columns import ContentError, own_name

# The paper's smoothing: nine frames, with a standard deviation of a fifth of that.
WINDOW_FRAMES, STD_FRAMES = 9, 9 / 5
MIN_FRAMES = 3
CLIPPED_V = 0.45
# More than a minute of frames and torques at 1.85 and 10.9 Hz.
MAX_FRAMES, MAX_TORQUES = 256, 4096
# The keys of each topic that slices need. The message gets no others.
_NEEDED: Mapping[str, tuple[str, ...]] = {
    EitFrame.topic: ("source", "t_mono_ns", "line", "repeated"),
    LoadTorque.topic: ("source", "t_mono_ns", "torque_nm", "valid"),
    GripperStateMessage.topic: ("source", "t_mono_ns", "diameter_mm"),
    LoopState.topic: ("source", "t_mono_ns", "step_name", "phase", "hold", "slices", "torque_source"),
}


@dataclass(frozen=True, slots=True)
class _Slice:
    """A slice of a tool, or of a cylinder with a diameter; the two lines are of one frame and the homogeneous frame."""

    difference: FloatArray
    torque_nm: float
    diameter_mm: float | None
    line: FloatArray
    homogeneous_line: FloatArray

    @property
    def folder(self) -> str:
        """The folder of its kind."""
        return TORQUE_FOLDER if self.diameter_mm is None else DIAMETER_FOLDER


def export_slices(
    path: Path, out: Path, topics: list[str], progress: Progress = lambda _: None
) -> tuple[list[Path], Counter[str]]:
    """Write the slices of a recorded experiment with the key `slices` into folders of `out`.

    Returns the files, and how many holds have no slice by the reason. Existing slices stay. Raises OSError for files
    that cannot be written, and UserError for a recording that cannot be read or has no such hold; then no file is new.
    """
    used = [topic for topic in topics if own_name(topic) in _NEEDED]
    # Only a control loop holds angles; imported recordings have none.
    if LoopState.topic not in topics:
        used = []
    with open_recording(path) as recording:
        table = recording.table
        for topic in used:
            recording.columns(topic).need(topic, _NEEDED[schema.schema_name(topic)], "an export of slices")
    sweep, slices, missed = _Sweep(table), list[_Slice](), Counter[str]()
    for topic, content, _ in read_messages(path, used, progress):
        name = schema.schema_name(topic)
        with refusing_content(path, topic):
            found = sweep.add(name, {key: content[key] for key in _NEEDED[name] if key in content})
        if isinstance(found, _Slice):
            slices.append(found)
        elif found is not None:
            missed[found] += 1
    if not slices and not missed:
        raise UserError(
            f"{path}: nothing to export; slices need an experiment with the key `slices` that holds angles, as "
            "config/experiments/torque_sweep.yaml"
        )
    written: list[Path] = []
    with ExitStack() as folders:
        for name in {new_slice.folder for new_slice in slices}:
            folders.enter_context(new_folder(out / name))
        _save(slices, out, written)
    return written, missed


def _save(slices: Sequence[_Slice], out: Path, written: list[Path]) -> None:
    """Write slices, or none of them."""
    try:
        for new_slice in slices:
            _save_slice(out, new_slice, written)
        torques = [new_slice for new_slice in slices if new_slice.diameter_mm is None]
        if torques:
            _save_raw(out / TORQUE_FOLDER, max(torques, key=lambda new_slice: abs(new_slice.torque_nm)), written)
    except BaseException:
        # The next export would number their slices a second time.
        for file in written:
            file.unlink(missing_ok=True)
        raise


def _save_slice(out: Path, one: _Slice, written: list[Path]) -> None:
    """Write a slice under the number after the highest of its folder."""
    prefix, torque = "Data_Slice_", "torque_value"
    if one.diameter_mm is not None:
        prefix, torque = f"{one.diameter_mm:.0f}mm_Data_", "mean_torque"
    folder = out / one.folder
    found = (re.fullmatch(rf"{prefix}(\d+)\.mat", path.name) for path in folder.iterdir())
    number = 1 + max((int(match[1]) for match in found if match), default=0)
    arrays = {"data_diff": one.difference[None], torque: [[one.torque_nm]]}
    _save_mat(folder / f"{prefix}{number}.mat", written, **arrays)


def _save_raw(folder: Path, one: _Slice, written: list[Path]) -> None:
    """Write a slice's frames, clipped like the paper's; files of an earlier recording stay."""
    raw, homogeneous = folder / RAW_FRAME, folder / RAW_HOMOGENEOUS
    if raw.exists() or homogeneous.exists():
        return
    _save_mat(raw, written, clipped_data=np.clip(one.line, 0.0, CLIPPED_V)[None])
    _save_mat(homogeneous, written, clipped_data_hom=np.clip(one.homogeneous_line, 0.0, CLIPPED_V)[None])


class _Sweep:
    """Finds the slices in the messages of one experiment, which come by the time of their measurement."""

    def __init__(self, table: ChannelTable) -> None:
        self._table = table
        # By source, the time and the line of each frame.
        self._frames: dict[str, deque[tuple[int, FloatArray]]] = {}
        self._torques: deque[tuple[int, float]] = deque(maxlen=MAX_TORQUES)
        # The start of the running `tare` step.
        self._tare_from_ns: int | None = None
        self._homogeneous: dict[str, FloatArray] = {}
        self._diameter_mm: float | None = None
        # The number, the start and the kind of the current hold.
        self._hold: tuple[int, int, str] | None = None

    def add(self, topic: str, content: Mapping[str, Any]) -> _Slice | str | None:
        """Take one message; return the slice of a hold that it ends, or the reason for no slice."""
        if "source" not in content:
            raise ContentError("it is imported, and the control loop's messages are not")
        t_ns = content["t_mono_ns"]
        match topic:
            case EitFrame.topic if not content["repeated"]:
                check_length("line", len(content["line"]), self._table.n_line_values)
                frames = self._frames.setdefault(content["source"], deque(maxlen=MAX_FRAMES))
                frames.append((t_ns, np.array(content["line"], dtype=np.float64)))
            case LoadTorque.topic if content["valid"]:
                self._torques.append((t_ns, content["torque_nm"]))
            case GripperStateMessage.topic:
                self._diameter_mm = content["diameter_mm"]
            case LoopState.topic:
                return self._on_loop_state(t_ns, content)
        return None

    def _on_loop_state(self, now_ns: int, content: Mapping[str, Any]) -> _Slice | str | None:
        tares = content["step_name"] == "tare" and content["phase"] == "running"
        if tares and self._tare_from_ns is None:
            self._tare_from_ns = now_ns
        elif self._tare_from_ns is not None and not tares:
            self._end_tare(self._tare_from_ns, now_ns)
            self._tare_from_ns = None
        # A safety hold or a pause keeps the angle, so the hold continues.
        number = 0 if content["phase"] in ("done", "stopped") or not content["slices"] else content["hold"]
        found: _Slice | str | None = None
        if self._hold is not None and number != self._hold[0]:
            # The fingertip of a slice: the torque source, else the right one, else the first.
            wanted = (content["torque_source"], "right", *sorted(self._frames))
            source = next((name for name in wanted if name in self._frames), wanted[0])
            found = self._slice(source, self._hold[1], now_ns, self._hold[2])
            self._hold = None
        if number and self._hold is None:
            self._hold = (number, now_ns, content["slices"])
        return found

    def _end_tare(self, began_ns: int, ended_ns: int) -> None:
        for source, frames in self._frames.items():
            # The whole acquisition of a frame must lie in the step: before and after it the fingers may move.
            half_ns = _half_period_ns(frames)
            lines = [line for t_ns, line in frames if began_ns + half_ns <= t_ns <= ended_ns - half_ns]
            if lines:
                self._homogeneous[source] = np.mean(lines, axis=0)

    def _slice(self, source: str, from_ns: int, to_ns: int, kind: str) -> _Slice | str:
        """Return the slice of a hold, or the reason for its absence."""
        known = self._frames.get(source, ())
        # The whole acquisition of a frame must lie in the hold.
        half_ns = _half_period_ns(known)
        frames = [frame for frame in known if from_ns + half_ns <= frame[0] <= to_ns - half_ns]
        load_half_ns = _half_period_ns(self._torques)
        whole = [row for row in self._torques if from_ns + load_half_ns <= row[0] <= to_ns - load_half_ns]
        torques = np.array(whole).reshape(-1, 2)
        if source not in self._homogeneous:
            return "no `tare` step came before the hold"
        if len(frames) < MIN_FRAMES or not len(torques):
            return f"the hold has fewer than {MIN_FRAMES} frames, or no torque"
        if kind == "diameter" and self._diameter_mm is None:
            return "the gripper measured no diameter"
        times, lines = np.array([t_ns for t_ns, _ in frames], float), [line for _, line in frames]
        period_ns = float(np.diff(times).mean())
        if period_ns <= 0:
            return "the frames of the hold have one time"
        # Around the middle of the times, for at most nine frames.
        periods = (times - 0.5 * (times[0] + times[-1])) / period_ns
        weights = np.exp(-0.5 * (periods / STD_FRAMES) ** 2) * (np.abs(periods) <= WINDOW_FRAMES / 2)
        weights /= weights.sum()
        # The torque has the same middle and the same weights.
        near = np.exp(-0.5 * ((torques[:, 0] - float(weights @ times)) / (STD_FRAMES * period_ns)) ** 2)
        rest = self._homogeneous[source]
        return _Slice(
            np.abs(self._table.channels_of_line(weights @ np.array(lines) - rest)),
            float(near @ torques[:, 1] / near.sum()),
            self._diameter_mm if kind == "diameter" else None,
            lines[len(lines) // 2],
            rest,
        )


def _save_mat(path: Path, written: list[Path], **arrays: Any) -> None:
    """Write a file, and add it to those that are written."""
    with replace_file(path) as file:
        savemat(file, arrays)  # type: ignore[arg-type]  # the stubs allow only names
    written.append(path)


def _half_period_ns(measured: Collection[tuple[int, object]]) -> float:
    """Return half the duration of an acquisition of frames or torques, 0 for fewer than two."""
    return 0.5 * float(np.median(np.diff([t_ns for t_ns, _ in measured]))) if len(measured) > 1 else 0.0
