"""Writes slices: the input of the paper's analysis, one MATLAB file for each held angle.

A slice is the frame at the middle of a hold, smoothed over time like the paper's (Gaussian over nine frames), minus
the homogeneous frame, as an absolute value. It comes with the load cell's torque over the same time. The homogeneous
frame is the mean of the frames of the latest `tare` step.
"""

import io
import re
from collections import Counter, deque
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import structlog
from scipy.io import savemat

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.channels import ChannelTable
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import Scalar
from shearloop.daemon.recording.matlab import DIAMETER_FOLDER, RAW_FRAME, RAW_HOMOGENEOUS, TORQUE_FOLDER
from shearloop.files import replace_file

# The paper's smoothing: nine frames, with a standard deviation of a fifth of that.
WINDOW_FRAMES, STD_FRAMES = 9, 9 / 5
MIN_FRAMES = 3
CLIPPED_V = 0.45
# More than a minute of frames and torques at 1.85 and 10.9 Hz.
MAX_FRAMES, MAX_TORQUES = 256, 4096


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


@dataclass(frozen=True, slots=True)
class _Slice:
    """A slice of a tool, or of a cylinder with a diameter; the two lines are of one frame and the homogeneous frame."""

    difference: FloatArray
    torque_nm: float
    diameter_mm: float | None
    line: FloatArray
    homogeneous_line: FloatArray


class _SliceFolder:
    """Writes slices in a thread of its own, so that no frame waits for the disk, and counts them there."""

    def __init__(self, folder: Path) -> None:
        self.written: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()
        self.thread = ThreadPoolExecutor(1, thread_name_prefix="slices")
        self._folder = folder
        self._largest_nm = 0.0
        # The files of this run's raw frame and homogeneous frame.
        self.raw: tuple[Path, Path] | None = None

    def save(self, one: _Slice) -> None:
        """Write one slice, and count it or the reason of a failure."""
        try:
            if one.diameter_mm is None:
                self._save(TORQUE_FOLDER, "Data_Slice_", data_diff=one.difference[None], torque_value=[[one.torque_nm]])
                self._save_raw(one)
            else:
                prefix = f"{one.diameter_mm:.0f}mm_Data_"
                self._save(DIAMETER_FOLDER, prefix, data_diff=one.difference[None], mean_torque=[[one.torque_nm]])
        except OSError as error:
            self.miss(f"{self._folder} cannot be written ({error.strerror})")
        except Exception as error:  # noqa: BLE001 - the thread would hide it
            structlog.get_logger().exception("a slice could not be written")
            self.miss(f"writing it failed with {type(error).__name__}: {error}")
        else:
            self.written["torque" if one.diameter_mm is None else "diameter"] += 1

    def miss(self, reason: str) -> None:
        """Count a hold without a slice, and log each reason once."""
        self.missed[reason] += 1
        if self.missed[reason] == 1:
            structlog.get_logger().warning("a slice is missed", reason=reason)

    def _save(self, folder_name: str, prefix: str, **arrays: Any) -> None:
        """Write a file with the number after the highest of the folder."""
        folder = self._folder / folder_name
        folder.mkdir(exist_ok=True)
        found = (re.fullmatch(rf"{prefix}(\d+)\.mat", path.name) for path in folder.iterdir())
        number = 1 + max((int(match[1]) for match in found if match), default=0)
        _save_mat(folder / f"{prefix}{number}.mat", **arrays)

    def _save_raw(self, one: _Slice) -> None:
        """Write the raw frame and homogeneous frame of the run's largest torque, clipped like the paper's."""
        if abs(one.torque_nm) <= self._largest_nm:
            return
        number = 1
        while self.raw is None:
            end = ".mat" if number == 1 else f"_{number}.mat"
            names = (name.replace(".mat", end) for name in (RAW_FRAME, RAW_HOMOGENEOUS))
            frame, rest = (self._folder / TORQUE_FOLDER / name for name in names)
            if not frame.exists() and not rest.exists():
                self.raw = frame, rest
            number += 1
        _save_mat(self.raw[0], clipped_data=np.clip(one.line, 0.0, CLIPPED_V)[None])
        _save_mat(self.raw[1], clipped_data_hom=np.clip(one.homogeneous_line, 0.0, CLIPPED_V)[None])
        self._largest_nm = abs(one.torque_nm)


class SliceRecorder:
    """Listens to all messages of a daemon and writes a file for each hold of an experiment that asks for slices.

    `close` waits for the last file.
    """

    def __init__(self, folder: Path, table: ChannelTable) -> None:
        """Create the folder for `torque_slices` and `diameter_slices`; raises UserError on failure."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder} cannot be made ({error.strerror}); choose another folder for slices") from None
        self._folder, self._table = _SliceFolder(folder), table
        self._frames: dict[str, deque[_SliceFrame]] = {}
        self._torques: deque[tuple[int, float]] = deque(maxlen=MAX_TORQUES)
        # The start of the running `tare` step.
        self._tare_from_ns: int | None = None
        self._homogeneous: dict[str, FloatArray] = {}
        self._diameter_mm: float | None = None
        # The number and the start of the current hold.
        self._current: tuple[int, int] | None = None
        # A finished hold that waits for its last frame.
        self._pending: _Hold | None = None

    @property
    def summary(self) -> str:
        """The written and missed slices in a sentence."""
        written, missed, raw = self._folder.written.copy(), self._folder.missed.copy(), self._folder.raw
        text = ", ".join(f"{count} {kind} slices" for kind, count in written.items()) or "no slice was kept"
        if raw is not None and raw[0].name != RAW_FRAME:
            text += f", their raw frame in {raw[0].name} (that of an earlier run stays in {RAW_FRAME})"
        return text + "".join(f"; {count} missed: {reason}" for reason, count in missed.items())

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the state for `health`."""
        missed = self._folder.missed.copy()
        return {"slices": self._folder.written.total(), "errors": missed, "error": next(reversed(missed), "")}

    def close(self) -> None:
        """Write the pending hold and wait for the writing thread."""
        self._write_pending()
        self._folder.thread.shutdown()

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
        channels, line = (np.frombuffer(content[key], "<f4").astype(np.float64) for key in ("channels", "line"))
        self._frames.setdefault(source, deque(maxlen=MAX_FRAMES)).append(_SliceFrame(t_ns, channels, line))
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
            # The fingertip of a slice: the torque source, else the right one, else the first.
            wanted = (content["torque_source"], "right", *sorted(self._frames))
            source = next((name for name in wanted if name in self._frames), wanted[0])
            self._pending = _Hold(self._current[1], now_ns, content["slices"], source)
            self._current = None
        if hold and self._current is None:
            self._current = (hold, now_ns)
        if ended:
            self._write_pending()

    def _end_tare(self, began_ns: int) -> None:
        for source, frames in self._frames.items():
            # The acquisition of the first frame began before the step, maybe with a tool in the fingers.
            from_ns = began_ns + _half_period_ns(frames)
            lines = [frame.line for frame in frames if frame.t_ns >= from_ns]
            if lines:
                self._homogeneous[source] = np.mean(lines, axis=0)

    def _write_pending(self) -> None:
        if self._pending is None:
            return
        found, self._pending = self._slice_of(self._pending), None
        if isinstance(found, str):
            self._folder.thread.submit(self._folder.miss, found)
        else:
            self._folder.thread.submit(self._folder.save, found)

    def _slice_of(self, hold: _Hold) -> _Slice | str:
        """Return the slice of a hold, or the reason for its absence."""
        known = self._frames.get(hold.source, ())
        # The whole acquisition of a frame must lie in the hold.
        half_ns = _half_period_ns(known)
        frames = [frame for frame in known if hold.from_ns + half_ns <= frame.t_ns <= hold.to_ns - half_ns]
        torques = np.array([row for row in self._torques if hold.from_ns < row[0] < hold.to_ns]).reshape(-1, 2)
        if hold.source not in self._homogeneous:
            return "no `tare` step came before the hold"
        if len(frames) < MIN_FRAMES or not len(torques):
            return f"the hold has fewer than {MIN_FRAMES} frames, or no torque"
        if hold.kind == "diameter" and self._diameter_mm is None:
            return "the gripper measured no diameter"
        times = np.array([frame.t_ns for frame in frames], float)
        period_ns = float(np.diff(times).mean())
        # Around the middle of the times, for at most nine frames.
        periods = (times - 0.5 * (times[0] + times[-1])) / period_ns
        weights = np.exp(-0.5 * (periods / STD_FRAMES) ** 2) * (np.abs(periods) <= WINDOW_FRAMES / 2)
        weights /= weights.sum()
        smoothed = weights @ np.array([frame.channels for frame in frames])
        # The torque has the same middle and the same weights.
        near = np.exp(-0.5 * ((torques[:, 0] - float(weights @ times)) / (STD_FRAMES * period_ns)) ** 2)
        rest = self._homogeneous[hold.source]
        return _Slice(
            np.abs(smoothed - self._table.channels_of_line(rest)),
            float(near @ torques[:, 1] / near.sum()),
            self._diameter_mm if hold.kind == "diameter" else None,
            frames[len(frames) // 2].line,
            rest,
        )


def _save_mat(path: Path, **arrays: Any) -> None:
    content = io.BytesIO()
    savemat(content, arrays)  # type: ignore[arg-type]  # the stubs allow only names
    with replace_file(path) as file:
        file.write(content.getbuffer())


def _half_period_ns(frames: Collection[_SliceFrame]) -> float:
    """Return half the duration of an acquisition, 0 for fewer than two frames."""
    return 0.5 * float(np.median(np.diff([frame.t_ns for frame in frames]))) if len(frames) > 1 else 0.0
