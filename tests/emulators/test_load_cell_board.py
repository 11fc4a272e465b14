"""The driver against the played board, over a real pseudo-terminal: torque comes through, and every fault is met."""

import contextlib
from collections.abc import AsyncIterator, Iterable
from itertools import repeat
from pathlib import Path

import pytest

from shearloop.drivers.connection import LinkMonitor, SerialLink
from shearloop.drivers.load_cell import LoadCalibration, LoadCell, LoadSample
from shearloop.emulators.boards import PAPER_SKETCH, Hx711Board, Sketch
from tests.running import LinkEvents, pass_on, running

SKETCH = Sketch()
CALIBRATION = LoadCalibration(tare_counts=SKETCH.tare_counts, scale_n_per_count=1 / (0.035 * SKETCH.counts_per_nm))


class Rig(LinkEvents):
    def __init__(self, board: Hx711Board, link: Path, calibration: LoadCalibration) -> None:
        super().__init__()
        self.board = board
        self.cell = LoadCell(SerialLink(path=link, monitor=LinkMonitor(self, 0.001, 0.002)), calibration)
        self.samples: list[LoadSample] = []

    def on_sample(self, sample: LoadSample) -> None:
        self.samples.append(sample)
        self.note()

    async def more(self, count: int) -> int:
        """Wait for so many samples more, and return how many there were before."""
        before = len(self.samples)
        await self.until(lambda: len(self.samples) >= before + count)
        return before


@contextlib.asynccontextmanager
async def a_rig(
    tmp_path: Path,
    torques_nm: Iterable[float] = repeat(0.03),
    sketch: Sketch = SKETCH,
    calibration: LoadCalibration = CALIBRATION,
) -> AsyncIterator[Rig]:
    link = tmp_path / "load"
    board = Hx711Board(sketch.lines(torques_nm), period_s=0.002, link=link)
    rig = Rig(board, link, calibration)
    async with running(board.run()):
        await board.port.appearances.get()
        async with running(pass_on(rig.cell.readings(), rig.on_sample)):
            await rig.more(4)
            yield rig


@pytest.mark.parametrize(
    ("sketch", "calibration", "noise_nm"),
    [(SKETCH, CALIBRATION, 120 / SKETCH.counts_per_nm), (PAPER_SKETCH, LoadCalibration.of_torque_lines(), 2e-5)],
)
async def test_torque_comes_through_from_either_sketch(tmp_path, sketch, calibration, noise_nm):
    torques = [0.0, *(0.001 * n for n in range(60))]
    async with a_rig(tmp_path, torques, sketch, calibration) as rig:
        await rig.until(lambda: rig.samples and rig.samples[-1].torque_nm > 0.0585)
        sent = {round(0.001 * n, 3) for n in range(60)}
        for sample in rig.samples[1:]:
            assert sample.trusted
            assert min(abs(sample.torque_nm - torque_nm) for torque_nm in sent) < 6 * noise_nm
        assert rig.samples[-1].torque_nm == pytest.approx(0.059, abs=6 * noise_nm)
        assert rig.cell.diagnostics()["errors"] == {}
        assert rig.cell.diagnostics()["flagged"] == 1  # the first line, whose beginning may be missing


async def test_corrupted_lines_are_flagged_or_counted_and_the_rest_goes_on(tmp_path):
    async with a_rig(tmp_path) as rig:
        rig.board.command("spike")
        rig.board.command("garbage")
        await rig.until(lambda: rig.cell.diagnostics()["errors"])
        await rig.until(lambda: [sample for sample in rig.samples if sample.spike])
        n = await rig.more(6)
        assert [sample.raw for sample in rig.samples if sample.spike] == [38399996]
        assert rig.cell.diagnostics()["errors"] == {"not a number": 1}
        assert all(sample.trusted for sample in rig.samples[n:])


async def test_saturation_and_a_frozen_converter_are_flagged_while_they_last(tmp_path):
    async with a_rig(tmp_path) as rig:
        rig.board.command("saturation:0.01")
        await rig.until(lambda: [sample for sample in rig.samples if sample.saturated])
        await rig.until(lambda: rig.samples[-1].trusted)
        rig.board.command("stuck")
        await rig.until(lambda: [sample for sample in rig.samples if sample.stuck])
        rig.board.command("stuck:0.0")
        await rig.until(lambda: rig.samples[-1].trusted)


async def test_an_unplugged_board_is_lost_and_found_again(tmp_path):
    async with a_rig(tmp_path) as rig:
        rig.board.command("unplug:0.05")
        await rig.down()
        n = await rig.more(4)
        assert rig.samples[n].partial
        assert rig.cell.diagnostics()["connections"] == 2
        assert "gone" in rig.losses[0].sentence


async def test_silence_is_reported_as_a_loss(tmp_path):
    async with a_rig(tmp_path) as rig:
        rig.board.command("silence")
        await rig.down()
        assert "sent nothing for 0.7 s" in rig.losses[0].sentence


async def test_a_tare_takes_effect_with_the_next_sample(tmp_path):
    async with a_rig(tmp_path) as rig:
        rig.cell.tare(rig.samples[-1].raw)
        await rig.more(2)
        assert rig.samples[-1].torque_nm == pytest.approx(0.0, abs=0.001)
        assert rig.samples[-1].trusted
