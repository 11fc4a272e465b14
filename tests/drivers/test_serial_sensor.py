"""A board counts as lost when it is silent, and when it sends only lines that are refused."""

import time
from collections.abc import Iterator
from contextlib import aclosing
from dataclasses import dataclass, field
from types import SimpleNamespace

import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.connection import Link, LinkEvent, LinkMonitor, Port, Received
from shearloop.drivers.defaults import LOAD_CELL_RATE_HZ
from shearloop.drivers.eit_kit import EitKit
from shearloop.drivers.load_cell import LoadCalibration, LoadCell
from shearloop.drivers.serial_sensor import (
    BOOT_S,
    FORGET_REFUSAL_VALUES,
    LONGEST_PATIENCE,
    SILENT_PERIODS,
    InputKind,
    RawEvent,
    SerialSensor,
)
from shearloop.drivers.shear_skin.instruments import AdcBoard

# What each board sends, and a line that it accepts.
BOARDS = {
    "load cell": (lambda link: LoadCell(link, LoadCalibration.of_torque_lines()), b"0.01\n"),
    "converter": (AdcBoard, b"1.234,1.234\n"),
    "EIT-kit": (lambda link: EitKit(link, PAPER_TABLE.zero_slots), b""),
}
REFUSED = {
    "a decimal comma": (b"0,091\r\n", "'0,091'"),
    "a label": (b"torque: 0.091\n", "'torque: 0.091'"),
    "not a number": (b"nan\n", "'nan'"),
    "a wrong baud rate": (b"\xf8\x80\xfe\x00\n", r"'\xf8\x80\xfe\x00'"),
    "words": (b"HX711 not found.\n", "'HX711 not found.'"),
    "no line end": (b"7", "7777777"),
}


@dataclass(eq=False)
class PlayedLink(Link):
    """A link whose ports send bytes at times after their opening, in s, or what was received; None is a silence."""

    events: list[LinkEvent] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    reads: list[tuple[float, bytes | Received | None]] = field(default_factory=list)
    # How long each read would have waited.
    waits_s: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.monitor = LinkMonitor(self, 0.0, 0.0)

    def on_link_event(self, event: LinkEvent) -> None:
        self.events.append(event)

    def on_refusal(self, sentence: str) -> None:
        self.refusals.append(sentence)

    async def _connect(self) -> Port:
        opened_ns, reads = time.monotonic_ns(), iter(self.reads)

        async def read(timeout_s: float) -> Received | None:
            self.waits_s.append(timeout_s)
            after_s, data = next(reads, (0.0, None))
            if data is None or isinstance(data, Received):
                return data
            return Received(data, opened_ns + round(1e9 * after_s))

        async def write(_data: bytes) -> None:
            pass

        return SimpleNamespace(path="/dev/board", read=read, write=write, close=lambda: None)

    def losses(self) -> list[str]:
        return [event.sentence for event in self.events if not event.up]


async def played(board: SerialSensor[object], link: PlayedLink, losses: int) -> None:
    async with aclosing(board.batches()) as batches:
        async for _ in batches:
            if len(link.losses()) >= losses:
                break


class Kept(list[RawEvent]):
    """A recorder of inputs that keeps them."""

    wants_state = False

    def record(self, event: RawEvent) -> None:
        self.append(event)


async def test_that_bytes_may_have_waited_is_an_input_before_them():
    """A replay then stamps them as the daemon did."""
    kept = Kept()
    link = PlayedLink(reads=[(0.0, Received(b"0.01\n", 900, 700)), (0.1, b"0.02\n")])
    await played(LoadCell(link, LoadCalibration.of_torque_lines(), inputs=kept), link, losses=1)
    kinds = [event.kind for event in kept]
    assert kinds[:4] == [InputKind.OPENED, InputKind.WAITED, InputKind.DATA, InputKind.DATA]
    assert (kept[1].t_ns, kept[1].data) == (900, b"700")


def every(period_s: float, data: bytes, until_s: float = 30.0) -> Iterator[tuple[float, bytes]]:
    return ((period_s * n, data) for n in range(1, round(until_s / period_s)))


@pytest.mark.parametrize("what", list(REFUSED))
@pytest.mark.parametrize("board", list(BOARDS))
async def test_a_board_that_sends_only_refused_lines_is_lost_with_the_line_and_the_cure(board, what):
    data, quoted = REFUSED[what]
    link = PlayedLink(reads=list(every(0.1, data)))
    device = BOARDS[board][0](link)
    await played(device, link, losses=1)
    (lost, *_) = link.losses()
    assert lost.startswith("/dev/board has sent nothing of use for ")
    assert quoted in lost
    assert "; " in lost, "a cure"
    assert "check the power" not in lost
    waited_s = float(lost.split(" for ")[1].split(" s")[0])
    assert BOOT_S < waited_s < BOOT_S + 1.0
    facts = device.diagnostics()
    assert quoted in str(facts["last_refusal"]) or what == "no line end"
    assert facts["last_loss"] == lost


@pytest.mark.parametrize("board", ["load cell", "converter"])
async def test_a_board_that_sends_a_value_now_and_then_among_refused_lines_is_not_lost(board):
    make, good = BOARDS[board]
    reads = [(at_s, good if n % 20 == 0 else b"0,091\n") for n, (at_s, _) in enumerate(every(0.1, b""))]
    link = PlayedLink(reads=reads)
    device = make(link)
    await played(device, link, losses=1)
    # The end of what is played is a silence.
    assert "has sent nothing for " in link.losses()[0]
    # The log has the first one, and health the number.
    (told,) = link.refusals
    assert "'0,091'" in told
    assert sum(device.diagnostics()["errors"].values()) > 200


@pytest.mark.parametrize("board", list(BOARDS))
async def test_a_torn_line_accuses_no_other_board_and_is_no_error_any_more_after_good_ones(board):
    make, good = BOARDS[board]
    good = good or frame_line()
    # A number without its beginning is a number, and is judged as one.
    torn = b"0.0.01\n" if board == "load cell" else good[len(good) // 2 :]

    async def refusal_after(n_good: int) -> str:
        link = PlayedLink(reads=[(0.6 * n, torn if n == 2 else good) for n in range(1, n_good + 3)])
        device = make(link)
        await played(device, link, losses=1)
        assert sum(device.diagnostics()["errors"].values()) == 1
        return str(device.diagnostics()["last_refusal"])

    assert "has lost bytes on its way; replace the USB cable" in await refusal_after(FORGET_REFUSAL_VALUES // 2)
    assert await refusal_after(FORGET_REFUSAL_VALUES) == ""


def frame_line() -> bytes:
    return b"".join(b"0.0000, " if is_zero else b"0.1234, " for is_zero in PAPER_TABLE.zero_slots) + b"\n"


@pytest.mark.parametrize("board", list(BOARDS))
async def test_a_board_that_is_slower_than_configured_is_waited_for_longer_each_time(board):
    link = PlayedLink()
    device = BOARDS[board][0](link)
    base_s = device.longest_silence_s
    link.monitor = LinkMonitor(_StopAfter(link, 8), 0.0, 0.0)
    with pytest.raises(_EnoughError):
        await anext(device.batches())
    assert link.waits_s[0] == max(BOOT_S, base_s)
    assert link.waits_s[7] == max(BOOT_S, LONGEST_PATIENCE * base_s)
    assert link.waits_s == sorted(link.waits_s)


async def test_an_emulated_board_is_waited_for_longer():
    link = PlayedLink(reads=[(0.1, b"0.01\n")])
    device = LoadCell(link, LoadCalibration.of_torque_lines(), patience=10.0)
    await played(device, link, losses=1)
    # It opens, sends one value, and is silent.
    assert link.waits_s[1] == pytest.approx(10.0 * SILENT_PERIODS / LOAD_CELL_RATE_HZ)


class _EnoughError(Exception):
    """The test has seen enough."""


class _StopAfter:
    """Ends the test after some losses."""

    def __init__(self, link: PlayedLink, losses: int) -> None:
        self._link, self._losses = link, losses

    def on_refusal(self, sentence: str) -> None:
        self._link.on_refusal(sentence)

    def on_link_event(self, event: LinkEvent) -> None:
        self._link.events.append(event)
        if len(self._link.losses()) >= self._losses:
            raise _EnoughError


async def test_a_board_that_is_in_time_again_is_waited_for_as_at_first():
    link = PlayedLink(reads=[*every(0.09, b"0.01\n", 3.0)])
    device = LoadCell(link, LoadCalibration.of_torque_lines())
    device.patience = 8
    await played(device, link, losses=1)
    assert link.waits_s[5] == pytest.approx(8 * SILENT_PERIODS / 10.9)
    assert link.waits_s[-2] == pytest.approx(SILENT_PERIODS / 10.9)
