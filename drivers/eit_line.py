"""The EIT-kit's stream: bytes in, frames out, without I/O."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shearloop.drivers.eit_format import (
    EXCERPT_BYTES,
    FULL_SCALE_SINE_RMS_V,
    LINE_BYTES,
    LONGEST_LINE_BYTES,
    N_VALUES,
    FrameError,
    FrameErrorKind,
    read_line,
)
from shearloop.drivers.frame_clock import FrameClock
from shearloop.drivers.raw_event import InputKind, RawEvent

# The board's own period, 1.85 frames/s; the one in use is learned from the frames as they come.
NOMINAL_PERIOD_NS = 541_000_000
# A line of 8 kB over the high-speed USB of a Teensy 4; give another time where the link is slower.
TRANSFER_NS = 1_000_000
# Longer than the longest run of equal readings of any live channel in the recordings, 168 frames: where nothing
# moves, the noise of a small signal stays below one step of the ADC.
DEAD_AFTER_FRAMES = 200
# What the rest of a line, begun before the port was opened, looks like.
_PARTIAL = (FrameErrorKind.WRONG_COUNT, FrameErrorKind.NOT_A_NUMBER)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of the board; its arrays are read-only.

    `channels` (896,) and `raw` (1024,) are in volts and line order; `line` is the line as it came, without its end.
    `t_mid_ns` is the middle of the acquisition and `t_arrival_ns` when the last byte was read, on the monotonic clock.
    `seq` counts frames from 0, over reconnections too. `saturated` (896,): the signal exceeds what the ADC can follow;
    `dead` (896,): unchanged for so many frames that nothing can be connected; `unusable`: how many are one or both;
    `repeated`: the same line as the frame before, which noise rules out, so no new measurement.
    """

    channels: NDArray[np.float64]
    raw: NDArray[np.float64]
    line: bytes
    t_mid_ns: int
    t_arrival_ns: int
    seq: int
    saturated: NDArray[np.bool_]
    dead: NDArray[np.bool_]
    unusable: int
    repeated: bool


class FrameParser:
    """Turns bytes, in any slicing, into frames; refuses what is no frame, counts it by kind and names the last.

    `zero_slots` (1024,) is true where the injection pattern makes the value 0. Counted apart from `refused`, being
    nobody's fault: `first_partials`, lines that were under way when listening began, and `unfinished`, lines that had
    begun when it ended.
    """

    def __init__(
        self,
        zero_slots: NDArray[np.bool_],
        *,
        nominal_period_ns: int = NOMINAL_PERIOD_NS,
        transfer_ns: int = TRANSFER_NS,
        full_scale_v: float = FULL_SCALE_SINE_RMS_V,
        dead_after: int = DEAD_AFTER_FRAMES,
    ) -> None:
        if zero_slots.shape != (N_VALUES,):
            raise ValueError(f"the mask of zero slots has the shape {zero_slots.shape} instead of ({N_VALUES},)")
        self.clock = FrameClock(nominal_period_ns)
        self.frames = 0
        self.refused: Counter[FrameErrorKind] = Counter()
        self.last_refusal: FrameError | None = None
        self.first_partials = 0
        self.unfinished = 0
        self._zero_slots = zero_slots
        self._slots = np.flatnonzero(~zero_slots)
        self._transfer_ns = transfer_ns
        self._full_scale_v = full_scale_v
        self._dead_after = dead_after
        self._begun = bytearray()
        self._flooded = False
        self._first = True
        self._missed = False
        self._started_at = 0
        self._last_mid_ns: int | None = None
        self._last_line: bytes | None = None
        self._last_channels = np.full(len(self._slots), np.nan)
        # Of the frames that were no repetition: how many there were, in which one each channel changed last, and before
        # which one no channel can be dead, so that it is not looked for in every frame.
        self._fresh = 0
        self._changed_in = np.zeros(len(self._slots), np.int64)
        self._none_dead_before = dead_after
        self._no_channels = np.zeros(len(self._slots), np.bool_)
        self._no_channels.setflags(write=False)

    def take(self, told: RawEvent) -> list[Frame]:
        """Do what an input says, live or recorded; return the frames that it completes: a tare or a tool, none."""
        match told.kind:
            case InputKind.OPENED:
                self.port_opened()
            case InputKind.STARTED:
                self.board_started()
            case InputKind.DATA:
                return self.feed(told.data, told.t_ns)
            case InputKind.TARE | InputKind.TOOL:
                pass
        return []

    def port_opened(self) -> None:
        """Begin anew: what was half received stays so, and a line may be under way already."""
        self.unfinished += bool(self._begun)
        self._begun.clear()
        self._flooded = self._missed = False
        self._first = True
        self._started_at = 0
        self.clock.restart()

    def board_started(self) -> None:
        """Take note that a silent board was started again: it may go on with a line that it began, or begin another."""
        self._started_at = len(self._begun)

    def feed(self, data: bytes, t_arrival_ns: int) -> list[Frame]:
        """Take bytes that had all arrived at `t_arrival_ns`; return the frames that they complete, in order."""
        *ends, begun = data.split(b"\n")
        sound = []
        for end in ends:
            self._add(end)
            if not self._flooded:
                read = self._read(bytes(self._begun).removesuffix(b"\r"))
                if read is not None:
                    sound.append((*read, self._missed))
                    self._missed = False
            self._begun.clear()
            self._flooded = self._first = False
            self._started_at = 0
        self._add(begun)
        frames = []
        for number, (line, values, missed) in enumerate(sound, 1):
            # Frames that waited for the reader together were sent one period after another, the last one by now.
            waited_ns = (len(sound) - number) * self.clock.period_ns if self.clock.learned else 0
            sent_ns = self.clock.arrived(t_arrival_ns - waited_ns, missed)
            frames.append(self._frame(line, values, sent_ns, t_arrival_ns))
        return frames

    def _add(self, data: bytes) -> None:
        if self._flooded:
            return
        self._begun += data[: LONGEST_LINE_BYTES + 1]
        if len(self._begun) > LONGEST_LINE_BYTES:
            self._refuse(FrameError(FrameErrorKind.TOO_LONG, bytes(self._begun[:EXCERPT_BYTES])))
            self._begun.clear()
            self._flooded = True

    def _read(self, line: bytes) -> tuple[bytes, NDArray[np.float64]] | None:
        values = read_line(line, self._zero_slots)
        if isinstance(values, FrameError) and self._started_at:
            fresh = line[self._started_at :]
            fresh_values = read_line(fresh, self._zero_slots)
            if not isinstance(fresh_values, FrameError):
                self.unfinished += 1
                return fresh, fresh_values
        if not isinstance(values, FrameError):
            return line, values
        if self._first and values.kind in _PARTIAL and len(line) < LINE_BYTES:
            self.first_partials += 1
        else:
            self._refuse(values)
        return None

    def _frame(self, line: bytes, values: NDArray[np.float64], sent_ns: int, t_arrival_ns: int) -> Frame:
        channels = values[self._slots]
        repeated = line == self._last_line
        self._fresh += not repeated
        self._changed_in[channels != self._last_channels] = self._fresh
        saturates = bool((channels > self._full_scale_v).any())
        self._last_line, self._last_channels = line, channels
        t_mid_ns = sent_ns - self._transfer_ns - self.clock.period_ns // 2
        # Every call of numpy that is spared is: most frames have no such channel.
        saturated = channels > self._full_scale_v if saturates else self._no_channels
        dead = self._dead()
        flawless = not saturates and dead is self._no_channels
        # Where another period has just been learned, time still goes forward.
        self._last_mid_ns = t_mid_ns if self._last_mid_ns is None else max(t_mid_ns, self._last_mid_ns + 1)
        frame = Frame(
            channels=channels,
            raw=values,
            line=line,
            t_mid_ns=self._last_mid_ns,
            t_arrival_ns=t_arrival_ns,
            seq=self.frames,
            saturated=saturated,
            dead=dead,
            unusable=0 if flawless else int(np.count_nonzero(saturated | dead)),
            repeated=repeated,
        )
        for array in (frame.channels, frame.raw, frame.saturated, frame.dead):
            array.setflags(write=False)
        self.frames += 1
        return frame

    def _dead(self) -> NDArray[np.bool_]:
        if self._fresh < self._none_dead_before:
            return self._no_channels
        dead = self._changed_in <= self._fresh + 1 - self._dead_after
        if not dead.any():
            self._none_dead_before = int(self._changed_in.min()) - 1 + self._dead_after
        return dead

    def _refuse(self, refusal: FrameError) -> None:
        self.refused[refusal.kind] += 1
        self.last_refusal = refusal
        self._missed = True
