"""The observer's process, with its own RTDE connection, because a killed process cannot measure its own stop.

`python -m shearloop.tools.commission.observer_process HOST RATE_HZ REGISTER` prints each sample.
"""

import subprocess
import sys
import threading
import time

from pydantic import TypeAdapter

from shearloop.drivers.ur.messages import RobotLostError, RtdeOutputs
from shearloop.drivers.ur.receiver import RtdeReceiver, SampleParser, outputs_at
from shearloop.drivers.ur.sample_age import SampleAge
from shearloop.drivers.ur.script import ScriptRegisters
from shearloop.errors import UserError
from shearloop.tools.commission.observer import Observer, Seen
from shearloop.tools.commission.opened import Opened
from shearloop.tools.interrupts import interrupts_held

_OUTPUTS = TypeAdapter(RtdeOutputs)
_CONNECTS_WITHIN_S = 10.0
# An observer that lost its connection connects again after this time.
_AGAIN_S = 0.2


class EverySample(SampleParser):
    """Keeps every sample, not only the newest one."""

    def __init__(self) -> None:
        super().__init__()
        self._samples: list[RtdeOutputs] = []

    def feed(self, data: bytes) -> RtdeOutputs | None:
        """Keep every sample that `data` completes, and return the newest one, or None; raises ProtocolError."""
        data, starts = self.split(data)
        samples = [outputs_at(data, start) for start in starts]
        self._samples += samples
        return samples[-1] if samples else None

    def take(self) -> list[RtdeOutputs]:
        """Return every sample since the last call, oldest first."""
        samples, self._samples = self._samples, []
        return samples


class ObserverProcess(Observer, Opened):
    """The samples of a process; a context, which ends the process at its end."""

    def __init__(self, host: str, rate_hz: float, registers: ScriptRegisters) -> None:
        """Take the controller and its registers; nothing is started yet."""
        super().__init__()
        self._host = host
        self._command = [sys.executable, "-m", "shearloop.tools.commission.observer_process", host]
        self._command += [str(rate_hz), str(registers.first)]
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: threading.Thread | None = None

    def open(self) -> None:
        """Start the process; raises UserError where it receives nothing."""
        # Ctrl-C is for the commissioning, which ends this process.
        with interrupts_held():
            self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE)
        self._reader = threading.Thread(target=self._read, args=(self._process,), name="observer", daemon=True)
        self._reader.start()
        if self.wait_for(lambda _: True, self.clock.now_ns(), _CONNECTS_WITHIN_S) is None:
            raise UserError(
                f"the observer receives nothing from the controller at {self._host}: look at the teach pendant"
            )

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._reader is not None:
            self._reader.join()
        if self._process is not None and self._process.stdout is not None:
            self._process.stdout.close()

    def _read(self, process: "subprocess.Popen[bytes]") -> None:
        if process.stdout is None:
            return
        for line in process.stdout:
            made_ns, arrived_ns, outputs = line.split(b" ", 2)
            self.add(Seen(int(made_ns), int(arrived_ns), _OUTPUTS.validate_json(outputs)))


def main(host: str, rate_hz: float, registers: ScriptRegisters) -> None:
    """Print the samples until the reader is gone; connect again after a loss."""
    while True:
        parser = EverySample()
        try:
            receiver = RtdeReceiver(host, rate_hz, _CONNECTS_WITHIN_S / 2, registers, writes=False, parser=parser)
        except RobotLostError:
            time.sleep(_AGAIN_S)
            continue
        age = SampleAge()
        while receiver.connected:
            receiver.wait(1.0)
            receiver.latest()
            for outputs in parser.take():
                now_ns = time.monotonic_ns()
                made_ns = now_ns - age.age_ns(outputs.timestamp_s, now_ns)
                sys.stdout.buffer.write(b"%d %d %s\n" % (made_ns, now_ns, _OUTPUTS.dump_json(outputs)))
            sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), ScriptRegisters(int(sys.argv[3])))
