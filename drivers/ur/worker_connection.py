"""The pipe to one worker process: its start, its messages, its end, and the reason for that."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from shearloop.drivers.errors import DeviceLostError, DriverError, ProtocolError
from shearloop.drivers.ur import error_messages
from shearloop.drivers.ur.messages import (
    RECOVERY_HANG_S,
    Configure,
    Disconnect,
    FailureKind,
    Heartbeat,
    Message,
    MessageDecoder,
    RobotState,
    WorkerPhase,
    encode,
)
from shearloop.drivers.ur.settings import UrSettings

LossKind = FailureKind | Literal["crashed", "hung", "garbled"]

# A disconnecting worker stops the arm (1 s) and ends the program; after this time it is killed.
FAREWELL_S = 3.0
# The worker's own alarms end it at a known place; the daemon kills it this much later.
GRACE_S = 1.0
# The bound on bytes that a stuck worker leaves unread: some hundred commands.
MOST_UNSENT = 1 << 15
# The end of the worker's output that a message quotes, and the wait for it after the worker's end.
LAST_WORDS_BYTES, LAST_WORDS_LINES, LAST_WORDS_S = 1024, 8, 0.5
HEARTBEAT: Final = encode(Heartbeat())


class LostError(DeviceLostError):
    """The worker has to be replaced; `kind` says why."""

    def __init__(self, kind: LossKind, sentence: str) -> None:
        super().__init__(sentence)
        self.kind: LossKind = kind


class WorkerConnection:
    """The pipe to one worker process."""

    def __init__(
        self,
        settings: UrSettings,
        process: asyncio.subprocess.Process,
        stdout: int,
        on_messages: Callable[[Sequence[tuple[int, Message]]], None],
        *,
        takes_over: bool = False,
    ) -> None:
        """Configure the worker. `on_messages` receives all messages of one read, in order."""
        if process.stdin is None or process.stderr is None:
            raise DriverError("The robot's process was started without pipes.")
        self._settings = settings
        self._process = process
        self._stdin, self._stdout, self._stderr = process.stdin, stdout, process.stderr
        self._on_messages = on_messages
        self._decoder = MessageDecoder()
        self._received_s = self._sent_s = time.monotonic()
        # Done at the end of the output (None), or with the error that ends the connection. The error is a result,
        # because asyncio complains about exceptions that are never retrieved.
        self._closed: asyncio.Future[Exception | None] = asyncio.get_running_loop().create_future()
        self._stderr_tail = b""
        self._stderr_ended = asyncio.Event()
        self._activity = "starting"
        self._state: RobotState | None = None
        self.send(Configure(settings, takes_over))

    def send(self, message: Message, number: int = 0) -> None:
        """Send a message to the worker."""
        self._sent_s = time.monotonic()
        self._stdin.write(encode(message, number))

    async def listen(self) -> None:
        """Pass messages on until the worker's output ends; kill a worker that is silent for too long.

        Raises:
            LostError: always, in the end.
        """
        asyncio.get_running_loop().add_reader(self._stdout, self._read)
        try:
            while not self._closed.done():
                timeout_s = self._timeout_s()
                silent_s = time.monotonic() - self._received_s
                if silent_s >= timeout_s:
                    self._kill()
                    raise LostError("hung", self._hung_sentence(timeout_s))
                await asyncio.wait([self._closed], timeout=min(timeout_s - silent_s, self._settings.hang_timeout_s))
        finally:
            self._stop_reading()
        error = self._closed.result()
        raise error if error is not None else await self._died()

    def _read(self) -> None:
        # A callback of the event loop: waking a task for each of 125 states a second costs as much as handling them.
        try:
            data = os.read(self._stdout, 1 << 16)
            self._received_s = time.monotonic()
            messages = self._decoder.feed(data)
            for _, message in messages:
                if isinstance(message, WorkerPhase):
                    self._activity = message.activity
                elif isinstance(message, RobotState):
                    self._state, self._activity = message, "controlling"
            self._on_messages(messages)
        except BlockingIOError:
            return
        except ProtocolError as error:
            self._kill()
            self._close(LostError("garbled", str(error)))
        except Exception as error:  # noqa: BLE001 - raised again by `listen`
            self._close(error)
        else:
            if not data:
                self._close(None)

    def _stop_reading(self) -> None:
        asyncio.get_running_loop().remove_reader(self._stdout)

    def _close(self, error: Exception | None) -> None:
        self._stop_reading()
        if not self._closed.done():
            self._closed.set_result(error)

    async def keep_alive(self) -> None:
        """Send heartbeats four times within the silence timeout, unless commands go out as often."""
        longest_s = self._settings.silence_timeout_s / 4
        while True:
            left_s = longest_s - (time.monotonic() - self._sent_s)
            if left_s <= 0:
                self._sent_s, left_s = time.monotonic(), longest_s
                self._stdin.write(HEARTBEAT)
            await asyncio.sleep(left_s)
            if self._stdin.transport.get_write_buffer_size() > MOST_UNSENT:
                self._kill()
                raise LostError("hung", self._hung_sentence(self._settings.silence_timeout_s))

    async def collect_stderr(self) -> None:
        """Keep the end of the worker's error output: after a crash it is the only trace."""
        while data := await self._stderr.read(1 << 16):
            self._stderr_tail = (self._stderr_tail + data)[-LAST_WORDS_BYTES:]
        self._stderr_ended.set()

    async def end(self) -> None:
        """Disconnect the worker, and kill it after `FAREWELL_S`."""
        if self._process.returncode is None:
            with contextlib.suppress(ConnectionError):
                self._stdin.write(encode(Disconnect()))
            # The end of its input disconnects the worker too.
            self._stdin.close()
            try:
                async with asyncio.timeout(FAREWELL_S), asyncio.TaskGroup() as tasks:
                    tasks.create_task(_drain(self._stderr))
                    tasks.create_task(self._process.wait())
            except TimeoutError:
                self._kill()
        await self._process.communicate()

    def _kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def _timeout_s(self) -> float:
        if self._state is None:
            return self._settings.connect_timeout_s + GRACE_S
        return (RECOVERY_HANG_S if self._state.recovering else self._settings.hang_timeout_s) + GRACE_S

    async def _died(self) -> LostError:
        status = await self._process.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_WORDS_S):
                await self._stderr_ended.wait()
        if status == -signal.SIGALRM:
            return LostError("hung", self._hung_sentence(self._settings.hang_timeout_s))
        end = f"died of {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
        # ur-rtde crashes like this when it loses the controller.
        cause = ": it lost the controller" if -status in (signal.SIGSEGV, signal.SIGABRT) else ""
        return LostError(
            "crashed",
            f"The robot's process {end} while {self._activity}{cause}. The robot's watchdog ends the motion; the "
            f"process is started again with motion disabled.{self._last_words()}",
        )

    def _hung_sentence(self, seconds: float) -> str:
        if self._state is None:
            sentence = error_messages.silent(self._settings.host, self._settings.connect_timeout_s, self._activity)
        else:
            sentence = (
                f"The robot's process did not answer for {seconds:.1f} s and was ended. The robot's watchdog ends the "
                "motion; the process is started again with motion disabled."
            )
        return sentence + self._last_words()

    def _last_words(self) -> str:
        lines = [line.strip() for line in self._stderr_tail.decode("utf-8", "replace").splitlines()]
        words = " / ".join([line for line in lines if line][-LAST_WORDS_LINES:])
        return f" Its last words: {words}." if words else ""


async def _drain(stream: asyncio.StreamReader) -> None:
    while await stream.read(1 << 16):
        pass


@dataclass(slots=True)
class Descriptor:
    """An open file that is closed once."""

    number: int
    is_open: bool = True

    def close(self) -> None:
        """Close the file, unless it is closed."""
        if self.is_open:
            self.is_open = False
            os.close(self.number)


@contextlib.contextmanager
def output_pipe() -> Iterator[tuple[int, Descriptor]]:
    """Yield a non-blocking end to read, and the end for a process to write."""
    reading, writing = os.pipe()
    write_end = Descriptor(writing)
    os.set_blocking(reading, False)
    try:
        yield reading, write_end
    finally:
        write_end.close()
        os.close(reading)
