"""Text that nobody waits for: in order, counted where it is lost, quiet where its reader has gone."""

import io
import subprocess
import sys
import threading
from contextlib import closing

from shearloop.daemon.logs import NonBlockingWriter

PROGRAM = """
import os, sys
from contextlib import closing
from shearloop.daemon.logs import NonBlockingWriter, logging_to_stderr
import structlog
read, write = os.pipe()
os.close(read)
os.dup2(write, 1)
with logging_to_stderr(), closing(NonBlockingWriter(sys.stdout)) as out:
    for number in range(3):
        out.write(f"{number}\\n")
"""


def test_what_is_written_comes_out_in_order_and_all_of_it_at_the_end():
    stream = io.StringIO()
    with closing(NonBlockingWriter(stream)) as outlet:
        for number in range(1000):
            assert outlet.write(f"{number}\n") == len(f"{number}\n")
    assert stream.getvalue().splitlines() == [str(number) for number in range(1000)]
    assert outlet.diagnostics() == {"errors": {}, "error": ""}


class Terminal(io.StringIO):
    """A terminal that takes a text for each that it is let take."""

    def __init__(self) -> None:
        super().__init__()
        self.asked, self.may, self.took = (threading.Semaphore(0) for _ in range(3))

    def write(self, text: str) -> int:
        self.asked.release()
        assert self.may.acquire(timeout=10)
        written = super().write(text)
        self.took.release()
        return written


def test_a_terminal_that_is_stopped_keeps_nobody_waiting_and_what_it_missed_is_told_in_its_place():
    terminal = Terminal()
    outlet = NonBlockingWriter(terminal, most_waiting=5)
    outlet.write("0\n")
    assert terminal.asked.acquire(timeout=10)
    for number in range(1, 9):
        outlet.write(f"{number}\n")
    assert outlet.lost == 3
    assert outlet.diagnostics()["errors"] == {"unread": 3}
    assert "Ctrl-Q" in str(outlet.diagnostics()["error"])
    outlet.close(timeout_s=0.0)
    assert outlet._thread.is_alive(), "the end waits no longer than it is told"
    terminal.may.release(100)
    while not outlet._waiting.empty():
        outlet.close(timeout_s=0.01)
    outlet.close(10)
    assert not outlet._thread.is_alive()
    assert terminal.getvalue().splitlines() == [
        *"012345", "… 3 texts are missing here: the terminal did not read them",
    ]  # fmt: skip


def test_what_is_missing_is_told_before_what_came_later():
    terminal = Terminal()
    outlet = NonBlockingWriter(terminal, most_waiting=4)
    outlet.write("0\n")
    terminal.may.release()
    assert terminal.took.acquire(timeout=10)
    for number in range(1, 20):
        outlet.write(f"{number}\n")
    lost = outlet.lost
    kept = 19 - lost
    terminal.may.release(kept)
    for _ in range(kept):
        assert terminal.took.acquire(timeout=10)
    outlet.write("20\n")
    terminal.may.release(2)
    outlet.close(10)
    lines = terminal.getvalue().splitlines()
    assert lines[-2:] == [f"… {lost} texts are missing here: the terminal did not read them", "20"]
    assert lines[:-2] == [str(number) for number in range(kept + 1)]


def test_what_nobody_reads_any_longer_kills_nobody():
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("the output has no reader any more") == 1
    assert "Broken pipe" in ended.stderr


def test_what_a_terminal_has_no_letters_for_is_spelt_and_what_follows_comes_out():
    taken = io.BytesIO()
    with closing(NonBlockingWriter(io.TextIOWrapper(taken, encoding="ascii", write_through=True))) as outlet:
        outlet.write("0.10 N·m …\n")
        outlet.write("and on\n")
    assert taken.getvalue().splitlines() == [rb"0.10 N\xb7m \u2026", b"and on"]
