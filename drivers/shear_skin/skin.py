"""The shear skin as a device: two voltages and a current become two resistances, or named faults."""

import contextlib
import math
from collections import Counter
from collections.abc import AsyncGenerator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from statistics import fmean

from shearloop.drivers.connection import Diagnostics
from shearloop.drivers.serial_sensor import StepFilter
from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, PollClock, SourceReading, Voltages

# The resistance of the paper's gauges.
GAUGE_OHM = 25.0
# Multiples of that: a gauge at rest may be made 40 % smaller, a stretched one has at most twice its resistance.
MIN_FACTOR, MAX_FACTOR = 0.6, 2.0
SHORT_FACTOR, OPEN_FACTOR = 0.1, 4.0
# Largest relative error of the current.
CURRENT_TOLERANCE = 0.01
# Leads and contacts in series with the gauges.
LEAD_OHM = 5.0
# What the load may change between a source reading and a scan.
SUM_TOLERANCE = 0.1
# A source reading older than this is stale.
SOURCE_STALE_PERIODS = 4.0
# Relative change of a resistance between two readings: three newtons within a tenth of a second.
MAX_CHANGE = 0.25
# Periods between two readings after which the skin may have been loaded and unloaded unseen.
LONGEST_PAUSE = 2.5
# A live converter's noise moves its last digit.
STUCK_AFTER = 50


class SkinFault(StrEnum):
    """Faults of the circuit; the text is for the person at the bench."""

    SOURCE_STARTING = "the current source is starting: its first reading has not come yet"
    SOURCE_LOST = "the current source does not answer: see its cable, its address and whether it is on"
    SOURCE_OFF = "the current source's output is off: press its OUTPUT key, or see what opened its interlock"
    COMPLIANCE = "the current source is in compliance: the circuit is open or a contact is bad, follow the two leads"
    CURRENT = "the current is not the one that was set: see whether the source was set by hand"
    OPEN_1 = "gauge 1 is open: its channel or one of its wires is broken"
    OPEN_2 = "gauge 2 is open: its channel or one of its wires is broken"
    SHORT_1 = "gauge 1 is shorted, or its sense wires are off: there is no voltage across it"
    SHORT_2 = "gauge 2 is shorted, or its sense wires are off: there is no voltage across it"
    OVERRANGE_1 = "the voltage of gauge 1 is beyond the range of its channel"
    OVERRANGE_2 = "the voltage of gauge 2 is beyond the range of its channel"
    REVERSED_1 = "the sense wires of gauge 1 are reversed: its voltage is negative"
    REVERSED_2 = "the sense wires of gauge 2 are reversed: its voltage is negative"
    IMPLAUSIBLE_1 = "gauge 1 has a resistance that it cannot have: see that its own wires are on its channel"
    IMPLAUSIBLE_2 = "gauge 2 has a resistance that it cannot have: see that its own wires are on its channel"
    SUM = "the two voltages do not add up to the source's: see the contacts, and that each channel has its gauge"
    STUCK_1 = "the voltage of gauge 1 has not changed for seconds: its converter stands still"
    STUCK_2 = "the voltage of gauge 2 has not changed for seconds: its converter stands still"
    SPIKE = "the resistances jumped by more than a skin can: the reading is taken for a disturbance"

    @classmethod
    def of_gauge(cls, kind: str, gauge: int) -> "SkinFault":
        """Return the fault of a kind, `OPEN` for instance, of gauge 0 or 1."""
        return cls[f"{kind}_{gauge + 1}"]


@dataclass(frozen=True, slots=True)
class SkinSample:
    """Both gauges at one time: resistances in Ω, or None with the faults.

    A reading of the voltages becomes one, or a block of them where they are averaged. `missed` readings are found
    missing since the sample before. `paused`: more than `LONGEST_PAUSE` periods passed before it, or before a reading
    since the sample before. `seq` counts from 0.
    """

    r1_ohm: float | None
    r2_ohm: float | None
    t_mid_ns: int
    t_arrival_ns: int
    seq: int
    missed: int = 0
    paused: bool = False
    faults: tuple[SkinFault, ...] = ()


class SampleValidator:
    """Turns readings of voltages and current into samples, one by one. No I/O; times are passed in."""

    def __init__(
        self, current_a: float, source_period_s: float, daq_period_s: float, gauge_ohm: float = GAUGE_OHM
    ) -> None:
        """Expect the current that was set, the periods of source and voltages, and gauges of `gauge_ohm` at rest."""
        self.faults: Counter[str] = Counter()
        self.samples = 0
        self.missed = 0
        self._current_a = current_a
        self._gauge_v = gauge_ohm * current_a
        self._stale_ns = round(SOURCE_STALE_PERIODS * source_period_s * 1e9)
        self._period_ns = round(daq_period_s * 1e9)
        self._polls = PollClock(daq_period_s)
        self._last: Voltages | None = None
        self._repeats = [1, 1]
        self._steps = StepFilter[tuple[float, float]]()
        # The last fault of the source, and the time since when it works.
        self._source_fault = SkinFault.SOURCE_STARTING
        self._source_since_ns: int | None = None
        # When the first voltages came.
        self._begun_ns: int | None = None

    def sample(self, voltages: Voltages, source: SourceReading | None) -> SkinSample:
        """Return the sample of a reading of the voltages, with the latest reading of the source."""
        missed = voltages.missed if voltages.t_asked_ns is None else self._polls.skipped(voltages.t_asked_ns)
        self.missed += missed
        last, self._last = self._last or voltages, voltages
        self._count_repeats(last, voltages)
        # By the arrival: before a late line others may be missing.
        periods = max(round((voltages.t_arrival_ns - last.t_arrival_ns) / self._period_ns), 1)
        faults = self._find_faults(voltages, source)
        r1_ohm = r2_ohm = None
        if not faults and source is not None:
            pair = voltages.v1_v / source.current_a, voltages.v2_v / source.current_a
            if self._steps.is_spike(pair, partial(_is_reachable, periods=periods)):
                faults = [SkinFault.SPIKE]
            else:
                r1_ohm, r2_ohm = pair
        self.faults.update(fault.name.lower() for fault in faults if fault is not SkinFault.SOURCE_STARTING)
        sample = SkinSample(
            r1_ohm=r1_ohm,
            r2_ohm=r2_ohm,
            t_mid_ns=voltages.t_mid_ns,
            t_arrival_ns=voltages.t_arrival_ns,
            seq=self.samples,
            missed=missed,
            paused=voltages.t_mid_ns - last.t_mid_ns > LONGEST_PAUSE * self._period_ns,
            faults=tuple(faults),
        )
        self.samples += 1
        return sample

    def _count_repeats(self, last: Voltages, voltages: Voltages) -> None:
        if voltages is last:
            return
        for i, same in enumerate((voltages.v1_v == last.v1_v, voltages.v2_v == last.v2_v)):
            self._repeats[i] = self._repeats[i] + 1 if same else 1

    def _find_faults(self, voltages: Voltages, source: SourceReading | None) -> list[SkinFault]:
        if self._begun_ns is None:
            self._begun_ns = voltages.t_arrival_ns
        if source is None and voltages.t_arrival_ns - self._begun_ns <= self._stale_ns:
            return [SkinFault.SOURCE_STARTING]
        if source is None or voltages.t_arrival_ns - source.t_ns > self._stale_ns:
            self._source_fault, self._source_since_ns = SkinFault.SOURCE_LOST, None
            return [SkinFault.SOURCE_LOST]
        if not source.output_on:
            self._source_fault, self._source_since_ns = SkinFault.SOURCE_OFF, None
            return [SkinFault.SOURCE_OFF]
        if self._source_since_ns is None:
            self._source_since_ns = source.t_ns
        if voltages.t_mid_ns < self._source_since_ns:
            # Measured before the current flowed: intact gauges would look like shorts.
            return [self._source_fault]
        gauges = self._gauge_faults(voltages)
        if source.compliance:
            # Compliance is the cause; an open gauge is the place.
            opened = [fault for fault in gauges if fault in (SkinFault.OPEN_1, SkinFault.OPEN_2)]
            return [SkinFault.COMPLIANCE, *opened]
        if abs(source.current_a - self._current_a) > CURRENT_TOLERANCE * self._current_a:
            return [SkinFault.CURRENT, *gauges]
        if gauges:
            return gauges
        stuck = [SkinFault.of_gauge("STUCK", i) for i, repeats in enumerate(self._repeats) if repeats >= STUCK_AFTER]
        if stuck:
            return stuck
        across_v = voltages.v1_v + voltages.v2_v
        slack_v = SUM_TOLERANCE * across_v
        leads_v = LEAD_OHM * self._current_a
        adds_up = -slack_v <= source.voltage_v - across_v <= leads_v + slack_v
        return [] if adds_up else [SkinFault.SUM]

    def _gauge_faults(self, voltages: Voltages) -> list[SkinFault]:
        values = (voltages.v1_v, voltages.v2_v)
        overranges = (voltages.over_1, voltages.over_2)
        is_open = [over or abs(v) > OPEN_FACTOR * self._gauge_v for v, over in zip(values, overranges, strict=True)]
        is_short = [abs(v) < SHORT_FACTOR * self._gauge_v for v in values]
        found = []
        for i, (v, over) in enumerate(zip(values, overranges, strict=True)):
            if is_open[i] and is_short[1 - i]:
                # Without a current the whole compliance lies across the open gauge and nothing across the other.
                found.append(SkinFault.of_gauge("OPEN", i))
            elif over:
                found.append(SkinFault.of_gauge("OVERRANGE", i))
            elif is_short[i]:
                if not is_open[1 - i]:
                    found.append(SkinFault.of_gauge("SHORT", i))
            elif v < 0:
                found.append(SkinFault.of_gauge("REVERSED", i))
            elif not MIN_FACTOR * self._gauge_v <= v <= MAX_FACTOR * self._gauge_v:
                found.append(SkinFault.of_gauge("IMPLAUSIBLE", i))
        return found


class SampleAverager:
    """Averages samples in blocks, as the paper's DAQ did over 1 s. No I/O.

    A sample with faults passes at once. It and a pause end the block before them, whose readings are dropped.
    """

    def __init__(self, size: int) -> None:
        """Average `size` samples into one; with 1 each passes unchanged."""
        self._size = size
        self._block: list[SkinSample] = []
        self._missed = self._seq = 0
        self._paused = False

    def restart(self) -> None:
        """Begin a new block: samples from before a tare do not belong to its zero."""
        self._block.clear()

    def add(self, sample: SkinSample) -> SkinSample | None:
        """Return the mean of the block that this sample completes, the sample itself if it has faults, else None."""
        self._missed += sample.missed
        self._paused = self._paused or sample.paused
        if sample.paused or sample.faults:
            self._block.clear()
        self._block.append(sample)
        if len(self._block) < self._size and not sample.faults:
            return None
        whole = replace(sample, seq=self._seq, missed=self._missed, paused=self._paused)
        if not sample.faults:
            t_mid_ns = sum(member.t_mid_ns for member in self._block) // len(self._block)
            whole = replace(whole, r1_ohm=self._mean("r1_ohm"), r2_ohm=self._mean("r2_ohm"), t_mid_ns=t_mid_ns)
        self._block, self._missed, self._paused, self._seq = [], 0, False, self._seq + 1
        return whole

    def _mean(self, name: str) -> float:
        return fmean(getattr(sample, name) for sample in self._block)


def _is_reachable(before: tuple[float, float], after: tuple[float, float], periods: int) -> bool:
    most = periods * math.log1p(MAX_CHANGE)
    return all(abs(math.log(now / then)) <= most for then, now in zip(before, after, strict=True))


class ShearSkin:
    """Source and DAQ of one skin. Run `watch_source` next to `batches`: without it every sample has a fault."""

    def __init__(self, source: Keithley6430, daq: Daq, gauge_ohm: float = GAUGE_OHM, averaged: int = 1) -> None:
        self._source = source
        self._daq = daq
        self._validator = SampleValidator(source.current_a, source.period_s, daq.period_s, gauge_ohm)
        self._averager = SampleAverager(averaged)
        self._latest: SourceReading | None = None

    async def watch_source(self) -> None:
        """Set the source up and read it until cancelled; then switch its output off."""
        async with contextlib.aclosing(self._source.readings()) as readings:
            async for reading in readings:
                self._latest = reading

    async def batches(self) -> AsyncGenerator[Sequence[SkinSample]]:
        """Yield the samples that each read completes, often none, without end; all that was read is in their state.

        Iterate within `contextlib.aclosing`.
        """
        async with contextlib.aclosing(self._daq.batches()) as batches:
            async for readings in batches:
                averaged = (self._averager.add(self._validator.sample(reading, self._latest)) for reading in readings)
                yield [sample for sample in averaged if sample is not None]

    @property
    def state(self) -> dict[str, object]:
        """The objects that the next samples depend on; only a converter board's parser has a past."""
        parser = {"parser": self._daq.parser} if isinstance(self._daq, AdcBoard) else {}
        return {**parser, "validator": self._validator, "averager": self._averager, "latest": self._latest}

    def restart_average(self) -> None:
        """Average only readings from now on, for a tare."""
        self._averager.restart()

    def diagnostics(self) -> Diagnostics:
        """Return the values of voltages and gauges for `health`; counts are since the process began."""
        found = dict(self._daq.diagnostics())
        errors = found.get("errors")
        return {
            **found,
            "errors": {**(errors if isinstance(errors, Mapping) else {}), **self._validator.faults},
            "expected_hz": 1.0 / self._daq.period_s,
            "samples": self._validator.samples,
            "missed": self._validator.missed,
        }

    def source_diagnostics(self) -> Diagnostics:
        """Return the values of the current source for `health`."""
        return self._source.diagnostics()
