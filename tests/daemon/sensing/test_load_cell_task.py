import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shearloop.cli.terminal import message_line
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import LoadTorque
from shearloop.daemon.sensing import load_cell_task
from shearloop.daemon.sensing.load_cell_task import ZERO_SAMPLES, LoadCellTask
from shearloop.daemon.sensing.zero_request import ZERO_TIMEOUT_S
from shearloop.daemon.torques import LatestTorques, TorqueSample
from shearloop.drivers.load_cell import COUNTS_FOR_TORQUES, COUNTS_REASON, TORQUES_FOR_COUNTS, LoadSample
from tests.running import running


@dataclass(frozen=True)
class Calibration:
    """What a load cell's calibration does, with a load that is there at every raw value."""

    load_nm: float = 0.0
    nm_per_raw: float = 0.0
    zero: float = 0.0

    def torque_nm(self, raw: float) -> float:
        return self.load_nm + self.nm_per_raw * (raw - self.zero)


class Board:
    """A load cell's board whose samples a test sends."""

    def __init__(self) -> None:
        self.sent: asyncio.Queue[LoadSample] = asyncio.Queue()
        self.tares: list[float] = []
        self.refusal = ""
        # Nothing is loaded, unless a test says so.
        self.calibration = Calibration()
        self.published: list[LoadTorque] = []
        # Later than all that a test asks for.
        self._seq = Clock().now_ns() + 10**9

    # Nothing is recorded.
    inputs = None

    async def batches(self) -> AsyncGenerator[list[LoadSample]]:
        while True:
            yield [await self.sent.get()]
            self.sent.task_done()

    def tare(self, raw_at_rest: float) -> None:
        self.tares.append(raw_at_rest)
        self.calibration = replace(self.calibration, zero=raw_at_rest)

    def diagnostics(self) -> dict[str, bool | str]:
        return {"connected": True, "last_loss": "", "last_refusal": self.refusal}

    async def send(
        self, raw: float, count: int = ZERO_SAMPLES, *, from_ns: int = 0, every_ns: int = 1, **flags: bool | str
    ) -> None:
        """Send samples that are taken from a moment on, or from where the earlier ones ended."""
        self._seq = from_ns or self._seq
        for _ in range(count):
            self._seq += every_ns
            self.sent.put_nowait(LoadSample(raw, 0.1, self._seq, self._seq, **flags))
        await self.sent.join()


@asynccontextmanager
async def reading(
    rate_hz: float = 10.9, clock: Clock | None = None, loop: Any = None
) -> AsyncIterator[tuple[LoadCellTask, Board]]:
    board = Board()
    task = LoadCellTask(board, SimpleNamespace(publish=board.published.append), clock or Clock(), loop, rate_hz)
    async with running(task.run()):
        yield task, board


async def asked(task: LoadCellTask) -> asyncio.Task[str | None]:
    zero = asyncio.create_task(task.tare_and_wait(60.0))
    await asyncio.sleep(0)
    return zero


async def test_both_callers_get_the_zero_when_a_second_one_asks_before_it_is_taken():
    async with reading() as (task, board):
        first = await asked(task)
        await board.send(5.0, ZERO_SAMPLES // 2)
        second = await asked(task)
        await board.send(7.0)
        async with asyncio.timeout(10):
            assert await asyncio.gather(first, second) == [None, None]
        assert board.tares == [7.0], "a zero is of the samples after it was asked for"


async def test_a_zero_that_cannot_be_taken_is_given_up_with_the_reason(monkeypatch):
    monkeypatch.setattr(load_cell_task, "ZERO_TIMEOUT_S", 0.05)
    # Its readings take less.
    async with reading(rate_hz=2000.0) as (task, board):
        zero = await asked(task)
        await board.send(8388607.0, saturated=True)
        why = await zero
        assert "the load cell's zero could not be taken within 0.05 s: the reading is at the end of its range" in why
        await board.send(9.0)
        assert board.tares == [], "nor at whatever load comes later"


async def test_a_zero_of_a_board_that_is_gone_ends_in_log_and_status(log):
    clock = SimpleNamespace(t_ns=10**9)
    clock.now_ns = lambda: clock.t_ns
    async with reading(clock=clock) as (task, board):
        task.tare()
        board.diagnostics = lambda: {"connected": False, "last_loss": "Its cable is out.", "last_refusal": ""}
        clock.t_ns += round(ZERO_TIMEOUT_S * 1e9) + 1
        why = "the load cell's zero could not be taken within 15 s: Its cable is out"
        for _ in range(2):
            assert task.diagnostics()["error"] == why
        assert log.said == [why]


async def test_a_zero_of_a_board_that_is_gone_says_why_it_is_gone():
    async with reading() as (task, board):
        gone = {"connected": False, "last_loss": "There is no serial port /dev/load.", "last_refusal": ""}
        board.diagnostics = lambda: gone
        why = await task.tare_and_wait(0.01)
        assert why == "the load cell's zero could not be taken within 0.01 s: There is no serial port /dev/load"


async def test_the_operators_tare_is_taken_from_the_next_samples():
    async with reading() as (task, board):
        task.tare()
        await board.send(3.0)
        assert board.tares == [3.0]


async def test_a_slow_board_has_the_time_that_its_readings_take():
    async with reading(rate_hz=1.0) as (task, board):
        task.tare()
        await board.send(3.0, 29, from_ns=Clock().now_ns(), every_ns=10**9)
        assert board.tares == [3.0]
        assert task.diagnostics()["error"] == ""


async def test_readings_that_began_before_the_tare_request_are_not_part_of_the_zero():
    """An HX711 settles within four conversions: a reading is of the time since three before its own began."""
    now_ns, period_ns = Clock().now_ns(), round(1e9 / 10.9)
    async with reading(clock=SimpleNamespace(now_ns=lambda: now_ns)) as (task, board):
        task.tare()
        for number in range(6 + ZERO_SAMPLES):
            arrives_ns = now_ns + number * period_ns
            board.sent.put_nowait(LoadSample(float(number), 0.1, arrives_ns - period_ns // 2, arrives_ns))
        await board.sent.join()
        # That of number 4 began exactly when it was asked for, and took a period.
        assert board.tares == [4 + (ZERO_SAMPLES - 1) / 2]


async def test_a_zero_that_the_operator_asked_for_is_not_taken_at_the_load_of_a_later_hour():
    passed_ns = 0
    clock = SimpleNamespace(now_ns=lambda: Clock().now_ns() + passed_ns)
    async with reading(clock=clock) as (task, board):
        task.tare()
        await board.send(8388607.0, saturated=True)
        await board.send(9.0, 2 * ZERO_SAMPLES, from_ns=Clock().now_ns() + round((ZERO_TIMEOUT_S + 1.0) * 1e9))
        assert board.tares == []
        assert "could not be taken within 15 s" in str(task.diagnostics()["error"])
        passed_ns = 60 * 10**9
        task.tare()
        assert task.diagnostics()["error"] == ""
        await board.send(3.0, from_ns=clock.now_ns() + 10**9)
        assert board.tares == [3.0]


@pytest.mark.parametrize(
    ("flag", "why"),
    [
        ("saturated", "end of its range"),
        ("spike", "can move"),
        ("stuck", "two seconds (its board hangs, or prints too few digits)"),
        ("partial", "longer line"),
    ],
)
async def test_a_reading_that_is_not_to_be_believed_says_so_to_whoever_listens(flag, why):
    async with reading() as (_, board):
        await board.send(5.0, 1, **{flag: True})
        await board.send(5.0, 1)
    spoilt, good = board.published
    assert not spoilt.valid
    assert why in spoilt.reason
    assert (good.valid, good.reason) == (True, "")


@pytest.mark.parametrize("why", [COUNTS_REASON, COUNTS_FOR_TORQUES, TORQUES_FOR_COUNTS])
async def test_a_board_of_another_unit_than_its_calibration_says_so(why):
    async with reading() as (task, board):
        await board.send(165_390.0, 1, spike=True, other_unit=why)
        (sample,) = board.published
        assert not sample.valid
        assert sample.reason == task.diagnostics()["error"]
        assert sample.reason == why.clause
        assert "can move" not in sample.reason
        line = message_line("load.torque", {**asdict(sample), "timestamp": 0.0})
        assert line.count("N·m") == why.clause.count("N·m"), "no torque is shown"
        assert sample.reason in line


async def test_health_quotes_the_last_refused_line():
    async with reading() as (task, board):
        board.refusal = "refused '0,091': not a number"
        assert task.diagnostics()["error"] == board.refusal


async def test_the_loop_learns_when_a_zero_is_asked_for_and_when_it_is_taken():
    told: list[bool] = []
    loop = SimpleNamespace(on_torque=lambda _: None, on_zero=lambda _, known=True: told.append(known))
    async with reading(loop=loop) as (task, board):
        zero = await asked(task)
        await board.send(5.0, ZERO_SAMPLES // 2)
        assert told == [False], "the zero before is not trusted any more"
        await board.send(5.0)
        async with asyncio.timeout(10):
            assert await zero is None
        assert told == [False, True]


def test_without_a_robot_only_present_torques_count_as_loads():
    latest = LatestTorques()
    assert latest.tare_refusal() is None
    latest.on_torque(TorqueSample("load_cell", -0.2, "", 0, 0))
    assert (latest.tare_refusal() or "").startswith("load_cell measures -0.200 N·m, which would become the zero")
    assert latest.tare_refusal(confirmed=True) is None
    latest.on_torque(TorqueSample("load_cell", 0.04, "", 1, 1))
    assert latest.tare_refusal() is None
    # A source knows from which torque on it is loaded.
    latest.on_torque(TorqueSample("load_cell", 0.04, "", 2, 2, loaded_nm=0.03))
    assert latest.tare_refusal() is not None
    latest.on_torque(TorqueSample("load_cell", None, "its cable is out", 3, 3, loaded_nm=0.03))
    assert latest.tare_refusal() is None
    latest.on_torque(TorqueSample("load_cell", None, "at the end of its range", 4, 4, load="its range has ended"))
    assert (latest.tare_refusal() or "").startswith("load_cell is loaded: its range has ended, which would become")
    assert latest.tare_refusal(confirmed=True) is None
    latest.on_torque(TorqueSample("load_cell", 0.0, "", 5, 5))
    # The estimate of both fingertips ends with either of them.
    latest.on_torque(TorqueSample("combined", 0.2, "", 2, 2))
    assert latest.tare_refusal() is not None
    latest.on_link("left", "its cable is out", up=False)
    assert latest.tare_refusal() is None


@pytest.mark.parametrize(
    ("torque_nm", "flags", "loaded"),
    [
        (1.0, {"saturated": True, "spike": True}, True),
        (-1.9, {"spike": True}, True),
        (0.5, {"spike": True}, False),
        (1.9, {"spike": True, "partial": True}, False),
        (1.9, {"spike": True, "other_unit": COUNTS_REASON}, False),
        (0.0, {"stuck": True}, False),
    ],
)
async def test_a_load_that_is_too_large_for_a_torque_is_a_load_all_the_same(torque_nm, flags, loaded):
    latest = LatestTorques()
    async with reading(loop=latest) as (_, board):
        board.sent.put_nowait(LoadSample(5.0, torque_nm, 1, 1, **flags))
        await board.sent.join()
        assert "beyond" not in (latest.tare_refusal() or ""), "a single reading may be a line that was changed"
        board.sent.put_nowait(LoadSample(5.0, torque_nm, 2, 2, **flags))
        await board.sent.join()
    refusal = latest.tare_refusal() or ""
    assert refusal.startswith("load_cell is loaded: the reading is beyond what it can measure, which") is loaded


@pytest.mark.parametrize(
    ("load_nm", "confirmed", "taken"), [(0.2, False, False), (0.2, True, True), (0.04, False, True)]
)
async def test_a_load_that_comes_while_a_zero_is_taken_does_not_become_it(load_nm, confirmed, taken):
    told: list[bool] = []
    loop = SimpleNamespace(on_torque=lambda _: None, on_zero=lambda _, known=True: told.append(known))
    async with reading(loop=loop) as (task, board):
        task.tare(confirmed=confirmed)
        board.calibration = Calibration(load_nm=load_nm)
        await board.send(5.0)
        assert bool(board.tares) is told[-1] is taken
        assert ("was not taken: load_cell measures +0.200 N·m" in task.diagnostics()["error"]) is not taken


@pytest.mark.parametrize("load_nm", [0.3, 0.03, 0.01])
@pytest.mark.parametrize("confirmed", [False, True])
async def test_a_load_that_comes_or_goes_while_a_zero_is_taken_refuses_it(confirmed, load_nm):
    async with reading() as (task, board):
        board.calibration = Calibration(nm_per_raw=1.0)
        task.tare(confirmed=confirmed)
        await board.send(0.0, ZERO_SAMPLES // 2)
        await board.send(load_nm, ZERO_SAMPLES - ZERO_SAMPLES // 2)
        assert board.tares == []
        assert f"was not taken: its torque changed by {load_nm:.3f} N·m during the tare" in task.diagnostics()["error"]
        assert not task.taring


async def test_a_large_cell_with_more_noise_is_tared_and_a_load_beyond_its_noise_is_refused():
    noise = np.random.default_rng(1).normal(0.0, 0.01, ZERO_SAMPLES)
    for load_nm, taken in ((0.0, True), (0.3, False)):
        async with reading() as (task, board):
            board.calibration = Calibration(nm_per_raw=1.0)
            task.tare()
            for number, raw in enumerate(noise):
                await board.send(raw + load_nm * (number > ZERO_SAMPLES // 2), 1)
            assert bool(board.tares) is taken


async def test_small_loads_in_one_zero_after_the_other_do_not_add_up():
    async with reading() as (task, board):
        board.calibration = Calibration(nm_per_raw=1.0)

        async def tare(load_nm: float, *, confirmed: bool = False) -> bool:
            taken = len(board.tares)
            task.tare(confirmed=confirmed)
            await board.send(load_nm)
            return len(board.tares) > taken

        assert await tare(0.04)
        assert not await tare(0.08), "it is only 0.04 N·m from the zero before"
        assert "load_cell measures +0.080 N·m, counted from the last confirmed tare" in task.diagnostics()["error"]
        assert await tare(0.03)
        assert await tare(0.08, confirmed=True)
        assert await tare(0.12), "0.04 N·m from the one that was confirmed"
        assert not await tare(0.16)
