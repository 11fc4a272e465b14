"""Keeps what the paper's analysis starts from: of each held angle one slice, as MATLAB files that `reproduce` reads.

A slice is the frame at the middle of a hold, smoothed over time as the paper did (Gaussian over nine frames), less the
homogeneous frame, without its sign; beside it the load cell's torque over the same time. The homogeneous frame is the
mean of the frames of the latest `tare` step.
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
# Fewer frames than this are no smoothed frame.
FEWEST_FRAMES = 3
CLIPPED_V = 0.45
# More than a minute of frames and torques at 1.85 and 10.9 Hz, and all of a hold at many times that.
MOST_FRAMES, MOST_TORQUES = 256, 4096
_ENDS = ("done", "stopped")
TORQUE_FOLDER, DIAMETER_FOLDER = "torque_slices", "diameter_slices"
RAW_FRAME, RAW_HOMOGENEOUS = "TorqueSlice.mat", "TorqueSliceHom.mat"


@dataclass(frozen=True, slots=True)
class _Frame:
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
    """Listens to every message of a daemon, and writes a file for each hold of an experiment that asks for slices.

    `written` counts the files by kind, `missed` the holds without one by reason. Files are written in a thread of their
    own, for no frame may wait for a disk; `close` waits for the last.
    """

    def __init__(self, folder: Path) -> None:
        """Take the folder in which `torque_slices` and `diameter_slices` are made; raises UserError if it cannot be."""
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{folder} cannot be made ({error.strerror}); choose another folder for slices") from None
        self.written: Counter[str] = Counter()
        self.missed: Counter[str] = Counter()
        self._folder = folder
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="slices")
        # Of the two counters, which the thread counts in too.
        self._counting = threading.Lock()
        self._frames: dict[str, deque[_Frame]] = {}
        self._torques: deque[tuple[int, float]] = deque(maxlen=MOST_TORQUES)
        self._taring: dict[str, list[_Frame]] = {}
        self._tares = False
        self._tares_from_ns = 0
        self._homogeneous: dict[str, tuple[FloatArray, FloatArray]] = {}
        self._diameter_mm: float | None = None
        self._held: tuple[int, int] | None = None
        self._pending: _Hold | None = None
        self._largest_nm = 0.0
        # What this run's raw frame beside the slices is called; None until there is one.
        self._raw: tuple[Path, Path] | None = None

    @property
    def summary(self) -> str:
        """What was kept and what was not, in a sentence."""
        with self._counting:
            kept = ", ".join(f"{count} {kind} slices" for kind, count in self.written.items()) or "no slice was kept"
            if self._raw is not None and self._raw[0].name != RAW_FRAME:
                kept += f", their raw frame in {self._raw[0].name} (that of an earlier run stays in {RAW_FRAME})"
            return kept + "".join(f"; {count} missed: {why}" for why, count in self.missed.items())

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the slices."""
        with self._counting:
            missed = dict(self.missed)
            return {"slices": self.written.total(), "errors": missed, "trouble": next(reversed(missed), "")}

    def close(self) -> None:
        """Write the hold that still waited for a later frame, and wait until everything is written."""
        if self._pending is not None:
            self._write(self._pending)
            self._pending = None
        self._writer.shutdown()

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take one message in."""
        match topic:
            # The same line once more is an old frame.
            case "eit.frame" if not content["repeated"]:
                self._frame(content)
            case "load.torque" if content["valid"]:
                self._torques.append((content["t_mono_ns"], content["torque_nm"]))
            case "gripper.state":
                self._diameter_mm = content["diameter_mm"]
            case "loop.state":
                self._loop(content)

    def _frame(self, content: Mapping[str, Any]) -> None:
        source, t_ns = content["source"], content["t_mono_ns"]
        frame = _Frame(t_ns, _array(content["channels"]), _array(content["line"]))
        self._frames.setdefault(source, deque(maxlen=MOST_FRAMES)).append(frame)
        if self._tares:
            self._taring.setdefault(source, []).append(frame)
        pending = self._pending
        if pending is not None and source == pending.source and t_ns > pending.to_ns:
            self._pending = None
            self._write(pending)

    def _loop(self, content: Mapping[str, Any]) -> None:
        now_ns, tares = content["t_mono_ns"], content["step_name"] == "tare" and content["phase"] == "running"
        if tares and not self._tares:
            self._taring.clear()
            self._tares_from_ns = now_ns
        elif self._tares and not tares:
            self._end_tare()
        self._tares = tares
        # While safety or the operator holds the wrist, it goes on standing at the angle.
        held = content["hold"] if content["phase"] not in _ENDS and content["slices"] else 0
        if self._held is not None and held != self._held[0]:
            if self._pending is not None:
                self._write(self._pending)
            self._pending = _Hold(self._held[1], now_ns, content["slices"], self._source(content["driving"]))
            self._held = None
        if held and self._held is None:
            self._held = (held, now_ns)
        if content["phase"] in _ENDS and self._pending is not None:
            self._write(self._pending)
            self._pending = None

    def _source(self, driving: str) -> str:
        """Return the fingertip that a slice is of: the one that drives, else the right one, else the first."""
        for name in (driving, "right", *sorted(self._frames)):
            if name in self._frames:
                return name
        return driving

    def _end_tare(self) -> None:
        for source, frames in self._taring.items():
            # The first to come was under way before, when something may have been gripped.
            from_ns = self._tares_from_ns + _half_period_ns(self._frames[source])
            within = [frame.line for frame in frames if frame.t_ns >= from_ns]
            if within:
                mean = np.mean(within, axis=0)
                self._homogeneous[source] = (channels_of_line(mean), mean)
        self._taring.clear()

    def _write(self, hold: _Hold) -> None:
        known = self._frames.get(hold.source, ())
        # A frame is of the hold when the whole of its acquisition is.
        half_ns = _half_period_ns(known)
        frames = [frame for frame in known if hold.from_ns + half_ns <= frame.t_ns <= hold.to_ns - half_ns]
        torques = np.array([row for row in self._torques if hold.from_ns < row[0] < hold.to_ns]).reshape(-1, 2)
        if hold.source not in self._homogeneous:
            self._miss("no `tare` step came before the hold")
            return
        if len(frames) < FEWEST_FRAMES or not len(torques):
            self._miss(f"fewer than {FEWEST_FRAMES} frames, or no torque, while it was held")
            return
        homogeneous, homogeneous_line = self._homogeneous[hold.source]
        times = np.array([frame.t_ns for frame in frames], float)
        weights = _weights(times)
        smoothed = weights @ np.array([frame.channels for frame in frames])
        # The load cell's torques around the same middle, with the same weights.
        middle = float(weights @ times)
        near = np.exp(-0.5 * ((torques[:, 0] - middle) / (STD_FRAMES * float(np.diff(times).mean()))) ** 2)
        torque_nm = float(near @ torques[:, 1] / near.sum())
        difference = np.abs(smoothed - homogeneous)
        if hold.kind != "diameter":
            line = frames[len(frames) // 2].line
            self._writer.submit(self._saved, self._save_torque, difference, torque_nm, line, homogeneous_line)
        elif self._diameter_mm is None:
            self._miss("the gripper measured no diameter")
        else:
            self._writer.submit(self._saved, self._save_diameter, difference, torque_nm, self._diameter_mm)

    def _miss(self, why: str) -> None:
        with self._counting:
            self.missed[why] += 1
            first = self.missed[why] == 1
        if first:
            structlog.get_logger().warning("a slice is missed", why=why)

    def _saved(self, save: Callable[..., str], *slice_: Any) -> None:
        """Write one slice, in the thread of its own: count it, or why it could not be."""
        try:
            kind = save(*slice_)
        except OSError as error:
            self._miss(f"{self._folder} cannot be written ({error.strerror})")
        except Exception as error:  # noqa: BLE001 - in a thread of its own nobody else would hear of it
            structlog.get_logger().exception("a slice could not be written")
            self._miss(f"writing it died of {type(error).__name__}: {error}")
        else:
            with self._counting:
                self.written[kind] += 1

    def _save_torque(self, difference: FloatArray, torque_nm: float, line: FloatArray, rest: FloatArray) -> str:
        folder = self._folder / TORQUE_FOLDER
        number = _next(folder, r"Data_Slice_(\d+)\.mat")
        _save(folder / f"Data_Slice_{number}.mat", data_diff=difference[None], torque_value=[[torque_nm]])
        if abs(torque_nm) > self._largest_nm:
            # One raw frame and its homogeneous frame, clipped as the paper's were: a pair for each run.
            self._raw = self._raw or _raw_names(folder)
            _save(self._raw[0], clipped_data=np.clip(line, 0.0, CLIPPED_V)[None])
            _save(self._raw[1], clipped_data_hom=np.clip(rest, 0.0, CLIPPED_V)[None])
            self._largest_nm = abs(torque_nm)
        return "torque"

    def _save_diameter(self, difference: FloatArray, torque_nm: float, diameter_mm: float) -> str:
        folder, diameter = self._folder / DIAMETER_FOLDER, f"{diameter_mm:.0f}"
        number = _next(folder, rf"{diameter}mm_Data_(\d+)\.mat")
        _save(folder / f"{diameter}mm_Data_{number}.mat", data_diff=difference[None], mean_torque=[[torque_nm]])
        return "diameter"


def _save(path: Path, **arrays: Any) -> None:
    """Write a MATLAB file, whole or not at all; raises OSError where it cannot be."""
    content = io.BytesIO()
    savemat(content, arrays)  # type: ignore[arg-type]  # any file will do
    with replace_file(path) as file:
        file.write(content.getbuffer())


def _half_period_ns(known: Collection[_Frame]) -> float:
    """Return half the time that the acquisition of a frame takes, 0 where that is not known."""
    return 0.5 * float(np.median(np.diff([frame.t_ns for frame in known]))) if len(known) > 1 else 0.0


def _array(wire: bytes) -> FloatArray:
    """Return an array as a message carries it on the wire."""
    return np.frombuffer(wire, "<f4").astype(np.float64)


def _weights(times: FloatArray) -> FloatArray:
    """Return Gaussian weights (n,) of frames around the middle of their times, at most nine of them not zero."""
    periods = (times - 0.5 * (times[0] + times[-1])) / float(np.diff(times).mean())
    weights: FloatArray = np.exp(-0.5 * (periods / STD_FRAMES) ** 2) * (np.abs(periods) <= WINDOW_FRAMES / 2)
    weights /= weights.sum()
    return weights


def _next(folder: Path, pattern: str) -> int:
    """Return the first number that no file of the folder has yet: what was recorded before is never overwritten."""
    folder.mkdir(exist_ok=True)
    found = (re.fullmatch(pattern, path.name) for path in folder.iterdir())
    return 1 + max((int(match[1]) for match in found if match), default=0)


def _raw_names(folder: Path) -> tuple[Path, Path]:
    """Return the first names of a raw frame and its homogeneous frame that no run has taken: numbered from 2 on."""
    frame, rest, number = folder / RAW_FRAME, folder / RAW_HOMOGENEOUS, 1
    while frame.exists() or rest.exists():
        number += 1
        frame, rest = (folder / name.replace(".mat", f"_{number}.mat") for name in (RAW_FRAME, RAW_HOMOGENEOUS))
    return frame, rest
