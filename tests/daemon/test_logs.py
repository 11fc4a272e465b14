"""The log: what a device's link says reaches the loop, and text that nobody waits for blocks nobody."""

import io
import subprocess
import sys
import threading
from contextlib import closing

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.logs import LinkReporter, NonBlockingWriter
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSource
from shearloop.drivers.connection import LinkEvent

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


class Terminal(io.StringIO):
    """A terminal that is stopped until `may` is released."""

    def __init__(self) -> None:
        super().__init__()
        self.asked, self.may = threading.Semaphore(0), threading.Semaphore(0)

    def write(self, text: str) -> int:
        self.asked.release()
        assert self.may.acquire(timeout=10)
        return super().write(text)


def test_a_blocked_terminal_does_not_block_the_writer_and_dropped_lines_are_noted():
    terminal = Terminal()
    outlet = NonBlockingWriter(terminal, most_waiting=5)
    outlet.write("0\n")
    assert terminal.asked.acquire(timeout=10)
    for number in range(1, 9):
        outlet.write(f"{number}\n")
    outlet.close(timeout_s=0.0)
    assert outlet.thread.is_alive(), "the end waits no longer than it may"
    terminal.may.release(100)
    outlet.close(10)
    assert not outlet.thread.is_alive()
    *shown, note = terminal.getvalue().splitlines()
    assert shown == list("012345")
    assert note == "… texts are missing above: the terminal did not read them"


def test_an_output_whose_reader_has_gone_does_not_end_the_process():
    ended = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("the output has no reader any more") == 1
    assert "Broken pipe" in ended.stderr


def test_what_a_terminal_has_no_letters_for_is_spelt_and_what_follows_comes_out():
    taken = io.BytesIO()
    with closing(NonBlockingWriter(io.TextIOWrapper(taken, encoding="ascii", write_through=True))) as outlet:
        outlet.write("0.10 N·m …\n")
        outlet.write("and on\n")
    assert taken.getvalue().splitlines() == [rb"0.10 N\u00b7m \u2026", b"and on"]


def test_the_control_loop_hears_of_a_lost_device_until_it_returns():
    loop = ControlLoop(LoopConfig(), {"right": TorqueSource(name="right", period_s=0.5)}, ("robot",))
    link = LinkReporter("robot", loop)
    link.on_link_event(LinkEvent(up=False, sentence="the worker died", repeated=False))
    assert "the worker died" in " ".join(loop_reasons(loop))
    link.on_link_event(LinkEvent(up=True, sentence="it is back", repeated=False))
    assert "the worker died" not in " ".join(loop_reasons(loop))


def loop_reasons(loop: ControlLoop) -> tuple[str, ...]:
    loop.tick(0)
    return loop.status.decision.reasons
