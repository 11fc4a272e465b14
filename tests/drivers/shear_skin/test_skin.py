"""The skin's driver against the played instruments, over real sockets and pseudo-terminals."""

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import pytest

from shearloop.drivers.connection import Link, LinkMonitor, SerialLink
from shearloop.drivers.defaults import DAQ_RATE_HZ
from shearloop.drivers.shear_skin.instruments import AdcBoard, Keithley6430, ScpiScanner, SourceReading, Voltages
from shearloop.drivers.shear_skin.skin import ShearSkin, SkinFault, SkinSample
from shearloop.drivers.shear_skin.tcp_link import TcpLink
from shearloop.emulators.ports import SocketServer
from shearloop.emulators.skin import Circuit, EmulatedKeithley6430, EmulatedScanner, Gauges, SkinInstruments
from tests.running import DEADLINE_S, LinkEvents, pass_on, running

R1, R2 = 24.6, 25.3
SPEED = 50.0
RATE_HZ = SPEED * DAQ_RATE_HZ
ANY_PORT = ("127.0.0.1", 0)


class Bench(LinkEvents):
    def __init__(self, played: SkinInstruments) -> None:
        super().__init__()
        self.command, self.circuit = played.command, played.circuit
        self.skin: ShearSkin
        self.samples: list[SkinSample] = []

    def on_sample(self, sample: SkinSample) -> None:
        self.samples.append(sample)
        self.note()

    def link(self, address: str) -> Link:
        """Return a link to an instrument, at `host:port` or at the path of its port."""
        host, _, port = address.rpartition(":")
        monitor = LinkMonitor(self, 0.001, 0.005)
        return TcpLink(host, int(port), monitor=monitor) if host else SerialLink(path=address, monitor=monitor)

    @property
    def source_errors(self) -> Mapping[str, int]:
        return self.skin.source_diagnostics()["errors"]

    async def next_says(self, *faults: SkinFault) -> None:
        """Wait for a sample with exactly these faults that was taken from here on."""
        begin = len(self.samples)
        try:
            await self.until(lambda: any(set(sample.faults) == set(faults) for sample in self.samples[begin:]))
        except TimeoutError:
            pytest.fail(f"no sample says {faults}; the last one: {self.samples[-1:]}")


@pytest.mark.parametrize(
    ("command", "error"),
    [
        (b"SOUR:CURR 2.0", b'-222,"Parameter data out of range"'),
        (b"SOUR:CURR much", b'-224,"Illegal parameter value"'),
        (b"OUTP maybe", b'-224,"Illegal parameter value"'),
        (b"FIRE", b'-113,"Undefined header"'),
    ],
)
def test_the_source_names_the_error_of_a_command(command, error):
    source = EmulatedKeithley6430(Circuit(Unstrained()))
    assert source.feed(command + b"\nSYST:ERR?\n") == error + b"\n"


class Unstrained:
    def resistances_ohm(self) -> tuple[float, float]:
        return R1, R2


class Rising:
    """Gauges that rise with the monotonic clock: a resistance tells when it was measured."""

    def __init__(self) -> None:
        self._begin_ns = time.monotonic_ns()

    def resistances_ohm(self) -> tuple[float, float]:
        rises = 0.05 * (time.monotonic_ns() - self._begin_ns) / 1e9
        return R1 * (1.0 + rises), R2 * (1.0 + rises)

    def measured_ns(self, sample: SkinSample) -> float:
        return self._begin_ns + (sample.r1_ohm / R1 - 1.0) / 0.05 * 1e9


@contextlib.asynccontextmanager
async def a_bench(
    folder: Path,
    *,
    serial_source: bool,
    adc: bool,
    deadline_s: float = 2.0,
    gauges: Gauges | None = None,
    speed: float = SPEED,
) -> AsyncIterator[Bench]:
    source_at, daq_at = folder / "source" if serial_source else ANY_PORT, folder / "adc" if adc else ANY_PORT
    played, rate_hz = SkinInstruments(gauges or Unstrained(), source_at, daq_at, speed=speed), speed * DAQ_RATE_HZ
    bench = Bench(played)
    async with running(played.run()):
        source_link = bench.link(await played.source_port.get())
        daq_link = bench.link(await played.daq_port.get())
        daq = AdcBoard(daq_link, rate_hz) if adc else ScpiScanner(daq_link, period_s=1 / rate_hz, timeout_s=deadline_s)
        bench.skin = ShearSkin(Keithley6430(source_link, period_s=0.01, timeout_s=deadline_s), daq)
        async with running(
            bench.skin.watch_source(), pass_on(bench.skin.batches(), lambda samples: [*map(bench.on_sample, samples)])
        ):
            await bench.next_says()
            yield bench


@pytest.mark.real_time
@pytest.mark.parametrize(("serial_source", "adc"), [(True, True), (True, False), (False, True), (False, False)])
async def test_resistances_come_through_over_every_way_in(tmp_path, serial_source, adc):
    async with a_bench(tmp_path, serial_source=serial_source, adc=adc) as bench:
        await bench.until(lambda: sum(not sample.faults for sample in bench.samples) >= 50)
        good = [sample for sample in bench.samples if not sample.faults]
        for name, true_ohm in (("r1_ohm", R1), ("r2_ohm", R2)):
            values = [getattr(sample, name) for sample in good]
            assert sum(values) / len(values) == pytest.approx(true_ohm, rel=2e-4)
        assert all(sample.faults == (SkinFault.SOURCE_STARTING,) for sample in bench.samples if sample.faults)
        assert [sample.seq for sample in bench.samples] == list(range(len(bench.samples)))
        times = [sample.t_mid_ns for sample in bench.samples]
        assert all(a < b for a, b in pairwise(times))
        assert bench.circuit.output_on
        assert (bench.circuit.level_a, bench.circuit.compliance_v) == (5e-3, 1.0)
        assert "MODEL 6430" in str(bench.skin.source_diagnostics()["instrument"])
        facts = bench.skin.diagnostics()
        assert facts["connected"]
        assert facts["samples"] == len(bench.samples)
    assert not bench.circuit.output_on, "whoever stops measuring switches the current off"


@pytest.mark.parametrize("adc", [True, False])
async def test_a_sample_has_the_time_of_its_measurement(tmp_path, adc):
    """Half of a conversion, or of a scan, is 50 or 20 ms."""
    gauges = Rising()
    async with a_bench(tmp_path, serial_source=False, adc=adc, gauges=gauges, speed=1.0) as bench:
        await bench.until(lambda: sum(not sample.faults for sample in bench.samples) >= 21)
    early_s = [(sample.t_mid_ns - gauges.measured_ns(sample)) / 1e9 for sample in bench.samples if not sample.faults]
    assert abs(median(early_s)) < 0.008


@pytest.mark.parametrize("serial_source", [True, False])
@pytest.mark.parametrize("outage", ["silence", "unplug"])
async def test_a_source_that_cannot_be_switched_off_at_the_end_is_reported(tmp_path, serial_source, outage):
    async with a_bench(tmp_path, serial_source=serial_source, adc=True, deadline_s=0.1) as bench:
        bench.command(f"source {outage}")
        await bench.next_says(SkinFault.SOURCE_LOST)
    assert bench.source_errors["not switched off"] == 1
    assert any("has not confirmed that its output is off" in event.sentence for event in bench.events)


FAULTS = [
    ("open 1", {SkinFault.COMPLIANCE, SkinFault.OPEN_1}),
    ("open 2", {SkinFault.COMPLIANCE, SkinFault.OPEN_2}),
    ("short 1", {SkinFault.SHORT_1}),
    ("short 2", {SkinFault.SHORT_2}),
    ("reversed 1", {SkinFault.REVERSED_1}),
    ("reversed 2", {SkinFault.REVERSED_2}),
    ("leads 400", {SkinFault.COMPLIANCE}),
    ("leads 40", {SkinFault.SUM}),
]


@pytest.mark.parametrize("adc", [True, False])
async def test_each_fault_of_the_circuit_is_named_and_goes_away_with_its_cause(tmp_path, adc):
    async with a_bench(tmp_path, serial_source=False, adc=adc) as bench:
        for text, faults in FAULTS:
            bench.command(text)
            await bench.next_says(*faults)
            bench.command("mend")
            await bench.next_says()
        errors = bench.skin.diagnostics()["errors"]
        assert {"compliance", "open_1", "open_2", "short_1", "reversed_2", "sum"} <= set(errors)


@pytest.mark.parametrize("serial_source", [True, False])
async def test_a_source_that_is_silent_or_gone_is_named_and_set_up_again_without_a_reset(tmp_path, serial_source):
    async with a_bench(tmp_path, serial_source=serial_source, adc=True, deadline_s=0.1) as bench:
        for outage in ("silence", "unplug"):
            losses, openings = len(bench.losses), bench.skin.source_diagnostics()["connections"]
            bench.command(f"source {outage}")
            # A late reading of the source looks like a lost one for a while; the outage itself is what is awaited.
            await bench.until(lambda n=losses: len(bench.losses) > n)
            await bench.next_says(SkinFault.SOURCE_LOST)
            assert bench.circuit.output_on, "the current flows on while the cable is out"
            bench.command("source normal")
            await bench.until(lambda n=openings: bench.skin.source_diagnostics()["connections"] > n)
            await bench.next_says()


async def test_a_source_that_the_operator_switches_off_stays_off_and_is_reported(tmp_path):
    async with a_bench(tmp_path, serial_source=False, adc=False) as bench:
        bench.circuit.output_on = False
        await bench.next_says(SkinFault.SOURCE_OFF)
        assert not bench.circuit.output_on
        bench.circuit.output_on = True
        await bench.next_says()


async def test_a_source_that_is_switched_off_between_two_questions_stays_off_too(tmp_path, monkeypatch):
    async with a_bench(tmp_path, serial_source=False, adc=False, deadline_s=1.0) as bench:
        openings = bench.skin.source_diagnostics()["connections"]
        sound = EmulatedKeithley6430.feed

        def switched_off_after_it_said_that_it_is_on(played: EmulatedKeithley6430, data: bytes) -> bytes:
            reply = sound(played, data)
            if b"OUTP?" in data:
                bench.circuit.output_on = False
                monkeypatch.undo()
            return reply

        monkeypatch.setattr(EmulatedKeithley6430, "feed", switched_off_after_it_said_that_it_is_on)
        await bench.next_says(SkinFault.SOURCE_OFF)
        assert not bench.circuit.output_on
        assert bench.skin.source_diagnostics()["connections"] == openings


async def test_a_source_that_says_nonsense_is_not_believed(tmp_path, monkeypatch):
    async with a_bench(tmp_path, serial_source=False, adc=False, deadline_s=0.1) as bench:
        sound = EmulatedKeithley6430.feed
        # A bad cable.
        monkeypatch.setattr(EmulatedKeithley6430, "feed", lambda *heard: sound(*heard) and b"%%%\n")
        await bench.until(lambda: bench.source_errors.get("not understood", 0) >= 3)
        await bench.next_says(SkinFault.SOURCE_LOST)
        monkeypatch.undo()
        await bench.next_says()


@pytest.mark.parametrize("adc", [True, False])
async def test_voltages_that_stop_coming_are_awaited(tmp_path, adc):
    async with a_bench(tmp_path, serial_source=False, adc=adc, deadline_s=0.1) as bench:
        for outage in ("unplug", "silence"):
            await bench.next_says()
            losses = len(bench.losses)
            bench.command(f"daq {outage}")
            await bench.until(lambda n=losses: len(bench.losses) > n)
            bench.command("daq normal")
        await bench.next_says()
        assert any(sample.missed for sample in bench.samples), "the gap is counted"


async def test_lines_of_the_board_that_are_missing_torn_or_garbage_are_counted(tmp_path):
    async with a_bench(tmp_path, serial_source=False, adc=True) as bench:
        for fault in ("garbage", "missing", "torn", "missing"):
            bench.command(f"daq {fault}")
        count = len(bench.samples)
        await bench.until(lambda: len(bench.samples) > count + 10)
        facts = bench.skin.diagnostics()
        assert facts["errors"]["not a number"] == 2
        bench.command("daq stuck")
        await bench.next_says(SkinFault.STUCK_1, SkinFault.STUCK_2)


async def test_an_instrument_that_is_no_source_is_refused_by_name():
    scanner = SocketServer(EmulatedScanner(Circuit(Unstrained())))
    links = LinkEvents()
    async with asyncio.timeout(DEADLINE_S):
        await scanner.restore()
        source = Keithley6430(TcpLink("127.0.0.1", scanner.port, monitor=LinkMonitor(links)))

        async with running(pass_on(source.readings(), lambda _: None)):
            assert "says it is 'Agilent Technologies,34972A" in (await links.down()).sentence
        await scanner.disconnect()


async def test_every_read_ends_with_the_samples_that_it_completes():
    """A recording needs the state between two reads, also if no mean ever ends with one."""
    milli_ns, current_a = 1_000_000, 1e-3

    async def batches() -> AsyncGenerator[list[Voltages]]:
        # Each mean is of the last reading of one read and the first of the next.
        for first in (0, 1, 3, 5):
            times_ns = [number * milli_ns for number in range(first, first + (2 if first else 1))]
            yield [Voltages(0.1, 0.1, t_ns, t_ns) for t_ns in times_ns]

    source = SimpleNamespace(current_a=current_a, period_s=1.0)
    skin = ShearSkin(source, SimpleNamespace(period_s=1e-3, batches=batches), 100.0, averaged=2)
    source.readings = lambda: readings(SourceReading(0, output_on=True, voltage_v=0.2, current_a=current_a))
    await skin.watch_source()
    found = [len(samples) async for samples in skin.batches()]
    assert found == [0, 1, 1, 1]


async def readings(*values: SourceReading) -> AsyncGenerator[SourceReading]:
    for one in values:
        yield one
