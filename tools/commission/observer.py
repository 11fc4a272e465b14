"""An observer with a process and an RTDE connection of its own: it measures what happens when other processes die.

`python -m shearloop.tools.commission.observer HOST RATE_HZ REGISTER` prints each sample; `Observer` reads the lines.
"""

import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from pydantic import TypeAdapter

from shearloop.drivers.ur.control_box import RtdeReceiver, SampleAge
from shearloop.drivers.ur.messages import RobotLostError, RtdeOutputs
from shearloop.drivers.ur.motion import REST_SAMPLES
from shearloop.drivers.ur.script import ScriptRegisters
from shearloop.errors import UserError

WRIST = 5
_OUTPUTS = TypeAdapter(RtdeOutputs)
_CONNECTS_WITHIN_S = 10.0
# An observer that lost its connection connects again after this time.
_AGAIN_S = 0.2


@dataclass(frozen=True, slots=True)
class Seen:
    """One sample, when the controller made it and when it arrived (monotonic, ns)."""

    made_ns: int
    arrived_ns: int
    outputs: RtdeOutputs

    @property
    def fastest_rad_per_s(self) -> float:
        """The speed of the fastest joint."""
        return max(map(abs, self.outputs.qd_rad_per_s))

    @property
    def wrist_rad(self) -> float:
        """The angle of wrist 3."""
        return self.outputs.q_rad[WRIST]

    @property
    def wrist_rad_per_s(self) -> float:
        """The speed of wrist 3."""
        return self.outputs.qd_rad_per_s[WRIST]


class Observer:
    """The samples of a controller; a context, which ends the process at its end."""

    def __init__(self, host: str, rate_hz: float, registers: ScriptRegisters) -> None:
        """Start the process; raises UserError where it receives nothing."""
        self.samples: list[Seen] = []
        self._changed = threading.Condition()
        command = [sys.executable, "-m", "shearloop.tools.commission.observer", host]
        command += [str(rate_hz), str(registers.first)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE)
        self._reader = threading.Thread(target=self._read, name="observer", daemon=True)
        self._reader.start()
        if self.wait_for(lambda _: True, time.monotonic_ns(), _CONNECTS_WITHIN_S) is None:
            self.close()
            raise UserError(f"the observer receives nothing from the controller at {host}: look at the teach pendant")

    def __enter__(self) -> Self:
        """Return the observer."""
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        """End the process."""
        self.close()

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._reader.join()
        if self._process.stdout is not None:
            self._process.stdout.close()

    def _read(self) -> None:
        if self._process.stdout is None:
            return
        for line in self._process.stdout:
            made_ns, arrived_ns, outputs = line.split(b" ", 2)
            seen = Seen(int(made_ns), int(arrived_ns), _OUTPUTS.validate_json(outputs))
            with self._changed:
                self.samples.append(seen)
                self._changed.notify_all()

    def latest(self) -> Seen:
        """Return the newest sample."""
        with self._changed:
            return self.samples[-1]

    def forget(self) -> None:
        """Drop all samples but the newest: an hour of them takes half a gigabyte."""
        with self._changed:
            del self.samples[:-1]

    def since(self, t_ns: int, until_ns: float = math.inf) -> list[Seen]:
        """Return the samples that were made in this time."""
        with self._changed:
            return [seen for seen in self.samples if t_ns <= seen.made_ns < until_ns]

    def listen(self, seconds: float) -> list[Seen]:
        """Return the samples of the next seconds."""
        begun_ns = time.monotonic_ns()
        end_ns = begun_ns + int(seconds * 1e9)
        self.wait_for(lambda seen: seen.made_ns >= end_ns, begun_ns, seconds + 1.0)
        return self.since(begun_ns, end_ns)

    def wait_for(self, condition: Callable[[Seen], bool], since_ns: int, within_s: float) -> Seen | None:
        """Return the first sample since a moment that meets a condition, or None after `within_s`."""
        until_s, looked = time.monotonic() + within_s, 0
        with self._changed:
            while True:
                for seen in self.samples[looked:]:
                    if seen.made_ns >= since_ns and condition(seen):
                        return seen
                looked = len(self.samples)
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not self._changed.wait(left_s):
                    return None

    def interruption(self, since_ns: int, least_ns: int, within_s: float) -> tuple[Seen, Seen] | None:
        """Return the samples before and after the first interruption since a moment, or None if none comes in time."""
        before: list[Seen] = []

        def follows(seen: Seen) -> bool:
            before.append(seen)
            return len(before) > 1 and seen.made_ns - before[-2].made_ns >= least_ns

        after = self.wait_for(follows, since_ns, within_s)
        return (before[-2], after) if after is not None else None

    def rest_since(self, since_ns: int, rest_rad_per_s: float, within_s: float = 5.0) -> Seen | None:
        """Return the first of some successive samples at rest since a moment, or None if there are none in time."""
        run: list[Seen] = []

        def rests(seen: Seen) -> bool:
            if seen.fastest_rad_per_s >= rest_rad_per_s:
                run.clear()
            else:
                run.append(seen)
            return len(run) >= REST_SAMPLES

        return run[0] if self.wait_for(rests, since_ns, within_s) is not None else None


def span_s(samples: Sequence[Seen]) -> float:
    """Return the time between the first and the last sample by the controller's clock."""
    return samples[-1].outputs.timestamp_s - samples[0].outputs.timestamp_s if samples else 0.0


def main(host: str, rate_hz: float, registers: ScriptRegisters) -> None:
    """Print the samples until the reader is gone; connect again after a loss."""
    while True:
        try:
            receiver = RtdeReceiver(host, rate_hz, _CONNECTS_WITHIN_S / 2, registers, writes=False)
        except RobotLostError:
            time.sleep(_AGAIN_S)
            continue
        age = SampleAge()
        while receiver.connected:
            receiver.wait(1.0)
            for outputs in receiver.receive_all():
                now_ns = time.monotonic_ns()
                made_ns = now_ns - age.age_ns(outputs.timestamp_s, now_ns)
                sys.stdout.buffer.write(b"%d %d %s\n" % (made_ns, now_ns, _OUTPUTS.dump_json(outputs)))
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), ScriptRegisters(int(sys.argv[3])))
