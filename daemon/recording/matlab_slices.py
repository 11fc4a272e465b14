"""Writes slices: the input of the paper's analysis, one MATLAB file for each held angle.

A slice is the frame at the middle of a hold, smoothed over time like the paper's (Gaussian over nine frames), minus
the homogeneous frame, as an absolute value. It comes with the load cell's torque over the same time. The homogeneous
frame is the mean of the frames of the latest `tare` step.
"""

import io
import re
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from scipy.io import savemat

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import channels_of_line
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import Scalar
from shearloop.files import replace_file

# The paper's smoothing: nine frames, with a standard deviation of a fifth of that.
WINDOW_FRAMES, STD_FRAMES = 9, 9 / 5
MIN_FRAMES = 3
CLIPPED_V = 0.45
# More than a minute of frames and torques at 1.85 and 10.9 Hz.
MAX_FRAMES, MAX_TORQUES = 256, 4096
TORQUE_FOLDER, DIAMETER_FOLDER = "torque_slices", "diameter_slices"
RAW_FRAME, RAW_HOMOGENEOUS = "TorqueSlice.mat", "TorqueSliceHom.mat"


@dataclass(frozen=True, slots=True)
class _SliceFrame:
    t_ns: int
    channels: FloatArray
    line: FloatArray


@dataclass(frozen=True, slots=True)
class _Hold:
    from_ns: int
    to_ns: int
    kind: str
    source: str


class SliceRecorder:
    """Listens to all messages of a daemon and writes a file for each hold of an experiment that asks for slices.

    `written` counts the files by kind, `missed` the holds without a file by reason. A thread writes the files, so that
    no frame waits for the disk. `close` waits for the last file.
    """

    def __init__(self, folder: Path) -> None:
        """Create the folder for `torque_slices` and `diameter_slices`; raises UserError on failure."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder} cannot be made ({error.strerror}); choose another folder for slices") from None
        self.written: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()
        self._folder = folder
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="slices")
        # Protects the two counters.
        self._lock = threading.Lock()
        self._frames: dict[str, deque[_SliceFrame]] = {}
        self._torques: deque[tuple[int, float]] = deque(maxlen=MAX_TORQUES)
        # The start of the running `tare` step.
        self._tare_from_ns: int | None = None
        self._homogeneous: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._diameter_mm: float | None = None
        # The number and the start of the current hold.
        self._current: tuple[int, int] | None = None
        # A finished hold that waits for its last frame.
        self._pending: _Hold | None = None
        self._largest_nm = 0.0
        # The files of this run's raw frame and homogeneous frame.
        self._raw: tuple[Path, Path] | None = None

    @property
    def summary(self) -> str:
        """The written and missed slices in a sentence."""
        with self._lock:
            text = ", ".join(f"{count} {kind} slices" for kind, count in self.written.items()) or "no slice was kept"
            if self._raw is not None and self._raw[0].name != RAW_FRAME:
                text += f", their raw frame in {self._raw[0].name} (that of an earlier run stays in {RAW_FRAME})"
            return text + "".join(f"; {count} missed: {reason}" for reason, count in self.missed.items())

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the state for `health`."""
        with self._lock:
            missed = dict(self.missed)
            return {"slices": self.written.total(), "errors": missed, "error": next(reversed(missed), "")}

    def close(self) -> None:
        """Write the pending hold and wait for the writing thread."""
        self._write_pending()
        self._writer.shutdown()

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Process one message."""
        match topic:
            case "eit.frame" if not content["repeated"]:
                self._add_frame(content)
            case "load.torque" if content["valid"]:
                self._torques.append((content["t_mono_ns"], content["torque_nm"]))
            case "gripper.state":
                self._diameter_mm = content["diameter_mm"]
            case "loop.state":
                self._update_loop(content)

    def _add_frame(self, content: Mapping[str, Any]) -> None:
        source, t_ns = content["source"], content["t_mono_ns"]
        frame = _SliceFrame(t_ns, _wire_array(content["channels"]), _wire_array(content["line"]))
        self._frames.setdefault(source, deque(maxlen=MAX_FRAMES)).append(frame)
        if self._pending is not None and source == self._pending.source and t_ns > self._pending.to_ns:
            self._write_pending()

    def _update_loop(self, content: Mapping[str, Any]) -> None:
        now_ns, ended = content["t_mono_ns"], content["phase"] in ("done", "stopped")
        tares = content["step_name"] == "tare" and content["phase"] == "running"
        if tares and self._tare_from_ns is None:
            self._tare_from_ns = now_ns
        elif self._tare_from_ns is not None and not tares:
            self._end_tare(self._tare_from_ns)
            self._tare_from_ns = None
        # A safety hold or a pause keeps the angle, so the hold continues.
        hold = content["hold"] if not ended and content["slices"] else 0
        if self._current is not None and hold != self._current[0]:
            self._write_pending()
            source = self._slice_source(content["torque_source"])
            self._pending = _Hold(self._current[1], now_ns, content["slices"], source)
            self._current = None
        if hold and self._current is None:
            self._current = (hold, now_ns)
        if ended:
            self._write_pending()

    def _slice_source(self, torque_source: str) -> str:
        """Return the fingertip of a slice: the torque source, else the right one, else the first."""
        for name in (torque_source, "right", *sorted(self._frames)):
            if name in self._frames:
                return name
        return torque_source

    def _end_tare(self, began_ns: int) -> None:
        for source, frames in self._frames.items():
            # The acquisition of the first frame began before the step, maybe with a tool in the fingers.
            from_ns = began_ns + _half_period_ns(frames)
            lines = [frame.line for frame in frames if frame.t_ns >= from_ns]
            if lines:
                mean = np.mean(lines, axis=0)
                self._homogeneous[source] = (channels_of_line(mean), mean)

    def _write_pending(self) -> None:
        if self._pending is None:
            return
        hold, self._pending = self._pending, None
        known = self._frames.get(hold.source, ())
        # The whole acquisition of a frame must lie in the hold.
        half_ns = _half_period_ns(known)
        frames = [frame for frame in known if hold.from_ns + half_ns <= frame.t_ns <= hold.to_ns - half_ns]
        torques = np.array([row for row in self._torques if hold.from_ns < row[0] < hold.to_ns]).reshape(-1, 2)
        if hold.source not in self._homogeneous:
            self._add_missed("no `tare` step came before the hold")
            return
        if len(frames) < MIN_FRAMES or not len(torques):
            self._add_missed(f"the hold has fewer than {MIN_FRAMES} frames, or no torque")
            return
        homogeneous, homogeneous_line = self._homogeneous[hold.source]
        times = np.array([frame.t_ns for frame in frames], float)
        weights = _smoothing_weights(times)
        smoothed = weights @ np.array([frame.channels for frame in frames])
        # The torque has the same middle and the same weights.
        middle = float(weights @ times)
        near = np.exp(-0.5 * ((torques[:, 0] - middle) / (STD_FRAMES * float(np.diff(times).mean()))) ** 2)
        torque_nm = float(near @ torques[:, 1] / near.sum())
        difference = np.abs(smoothed - homogeneous)
        if hold.kind != "diameter":
            line = frames[len(frames) // 2].line
            self._writer.submit(self._save, self._save_torque, difference, torque_nm, line, homogeneous_line)
        elif self._diameter_mm is None:
            self._add_missed("the gripper measured no diameter")
        else:
            self._writer.submit(self._save, self._save_diameter, difference, torque_nm, self._diameter_mm)

    def _add_missed(self, reason: str) -> None:
        with self._lock:
            self.missed[reason] += 1
            first = self.missed[reason] == 1
        if first:
            structlog.get_logger().warning("a slice is missed", reason=reason)

    def _save(self, save: Callable[..., str], *slice_: Any) -> None:
        """Write one slice in the thread, and count it or the reason of a failure."""
        try:
            kind = save(*slice_)
        except OSError as error:
            self._add_missed(f"{self._folder} cannot be written ({error.strerror})")
        except Exception as error:  # noqa: BLE001 - the thread would hide it
            structlog.get_logger().exception("a slice could not be written")
            self._add_missed(f"writing it failed with {type(error).__name__}: {error}")
        else:
            with self._lock:
                self.written[kind] += 1

    def _save_torque(self, difference: FloatArray, torque_nm: float, line: FloatArray, rest: FloatArray) -> str:
        folder = self._folder / TORQUE_FOLDER
        number = _next_number(folder, r"Data_Slice_(\d+)\.mat")
        _save_mat(folder / f"Data_Slice_{number}.mat", data_diff=difference[None], torque_value=[[torque_nm]])
        if abs(torque_nm) > self._largest_nm:
            # One pair of raw frame and homogeneous frame per run, clipped like the paper's.
            self._raw = self._raw or _raw_paths(folder)
            _save_mat(self._raw[0], clipped_data=np.clip(line, 0.0, CLIPPED_V)[None])
            _save_mat(self._raw[1], clipped_data_hom=np.clip(rest, 0.0, CLIPPED_V)[None])
            self._largest_nm = abs(torque_nm)
        return "torque"

    def _save_diameter(self, difference: FloatArray, torque_nm: float, diameter_mm: float) -> str:
        folder, diameter = self._folder / DIAMETER_FOLDER, f"{diameter_mm:.0f}"
        number = _next_number(folder, rf"{diameter}mm_Data_(\d+)\.mat")
        _save_mat(folder / f"{diameter}mm_Data_{number}.mat", data_diff=difference[None], mean_torque=[[torque_nm]])
        return "diameter"


def _save_mat(path: Path, **arrays: Any) -> None:
    content = io.BytesIO()
    savemat(content, arrays)  # type: ignore[arg-type]  # the stubs allow only names
    with replace_file(path) as file:
        file.write(content.getbuffer())


def _half_period_ns(frames: Collection[_SliceFrame]) -> float:
    """Return half the duration of an acquisition, 0 for fewer than two frames."""
    return 0.5 * float(np.median(np.diff([frame.t_ns for frame in frames]))) if len(frames) > 1 else 0.0


def _wire_array(data: bytes) -> FloatArray:
    return np.frombuffer(data, "<f4").astype(np.float64)


def _smoothing_weights(times: FloatArray) -> FloatArray:
    """Return the Gaussian weights (n,) of frames around the middle of their times, non-zero for at most nine."""
    periods = (times - 0.5 * (times[0] + times[-1])) / float(np.diff(times).mean())
    weights: FloatArray = np.exp(-0.5 * (periods / STD_FRAMES) ** 2) * (np.abs(periods) <= WINDOW_FRAMES / 2)
    weights /= weights.sum()
    return weights


def _next_number(folder: Path, pattern: str) -> int:
    """Return the number after the highest of the folder's files; creates the folder."""
    folder.mkdir(exist_ok=True)
    found = (re.fullmatch(pattern, path.name) for path in folder.iterdir())
    return 1 + max((int(match[1]) for match in found if match), default=0)


def _raw_paths(folder: Path) -> tuple[Path, Path]:
    """Return free names for a raw frame and its homogeneous frame, numbered from 2."""
    frame, rest, number = folder / RAW_FRAME, folder / RAW_HOMOGENEOUS, 1
    while frame.exists() or rest.exists():
        number += 1
        frame, rest = (folder / name.replace(".mat", f"_{number}.mat") for name in (RAW_FRAME, RAW_HOMOGENEOUS))
    return frame, rest
