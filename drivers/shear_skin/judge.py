"""From two voltages and a current to two resistances, or to what is wrong, by name. No I/O; times are passed in."""

import math
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

from shearloop.drivers.shear_skin.daq import Voltages
from shearloop.drivers.shear_skin.source import SourceReading


class SkinFault(StrEnum):
    """What can be wrong with the circuit; the text is for the person at the bench."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class CircuitLimits:
    """What the circuit can be like. The resistances are those of the paper's gauges and five newtons of shear."""

    resistance_ohm: float = 25.0
    # A gauge at rest may be made 40 % smaller than nominal; a stretched one has at most this many times its resistance.
    least_share: float = 0.6
    most_share: float = 2.0
    # Below this share of its resistance it is a short, above this many times an open circuit.
    short_share: float = 0.1
    open_times: float = 4.0
    # Of the current that was set.
    current_share: float = 0.01
    # Leads and contacts in series with the gauges, and what the load may change between source reading and scan.
    lead_ohm: float = 5.0
    sum_share: float = 0.1
    # Older than this many of its periods, the source's reading says nothing of the present.
    source_stale_periods: float = 4.0
    # Relative change of a resistance from one reading to the next: three newtons within a tenth of a second.
    most_change: float = 0.25
    settle_readings: int = 3
    # The noise of a live converter moves its last digit.
    stuck_after: int = 50


@dataclass(frozen=True, slots=True)
class SkinSample:
    """The two gauges at one time: resistances in Ω where nothing is wrong, else None and what it is.

    Every reading of the voltages becomes one. `missed` readings are missing right before it; `seq` counts from 0.
    """

    r1_ohm: float | None
    r2_ohm: float | None
    v1_v: float
    v2_v: float
    current_a: float | None
    t_mid_ns: int
    t_arrival_ns: int
    seq: int
    missed: int = 0
    faults: tuple[SkinFault, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.faults

    @property
    def why(self) -> str:
        """What speaks against it, in sentences."""
        return "; ".join(self.faults)


class SampleValidator:
    """Judges reading by reading; knows what came before, and nothing of clocks or ports."""

    def __init__(
        self, current_a: float, source_period_s: float, daq_period_s: float, limits: CircuitLimits | None = None
    ) -> None:
        """Take the current that was set, and how often source and voltages are read."""
        self.faults: Counter[str] = Counter()
        self.missed = 0
        self._current_a = current_a
        self._limits = limits or CircuitLimits()
        self._stale_ns = round(self._limits.source_stale_periods * source_period_s * 1e9)
        self.expected_hz = 1.0 / daq_period_s
        self._period_ns = round(daq_period_s * 1e9)
        self._seq = 0
        self._last: Voltages | None = None
        self._repeats = [1, 1]
        self._good: tuple[float, float] | None = None
        self._candidates: list[tuple[float, float]] = []
        # What was last wrong with the source, and since when it is right again.
        self._without_source = SkinFault.SOURCE_LOST
        self._source_since_ns: int | None = None

    def sample(self, voltages: Voltages, source: SourceReading | None) -> SkinSample:
        """Return what a reading of the voltages says, with the latest reading of the source."""
        missed = self._missed_before(voltages)
        faults = self._faults(voltages, source)
        r1_ohm = r2_ohm = None
        if not faults and source is not None:
            pair = voltages.v1_v / source.current_a, voltages.v2_v / source.current_a
            if self._is_spike(pair, missed):
                faults = [SkinFault.SPIKE]
            else:
                r1_ohm, r2_ohm = pair
        self.faults.update(fault.name.lower() for fault in faults)
        sample = SkinSample(
            r1_ohm=r1_ohm,
            r2_ohm=r2_ohm,
            v1_v=voltages.v1_v,
            v2_v=voltages.v2_v,
            current_a=source.current_a if source is not None and source.output_on else None,
            t_mid_ns=voltages.t_mid_ns,
            t_arrival_ns=voltages.t_arrival_ns,
            seq=self._seq,
            missed=missed,
            faults=tuple(faults),
        )
        self._seq += 1
        return sample

    def _missed_before(self, voltages: Voltages) -> int:
        last, self._last = self._last, voltages
        if last is None:
            return 0
        for i, same in enumerate((voltages.v1_v == last.v1_v, voltages.v2_v == last.v2_v)):
            self._repeats[i] = self._repeats[i] + 1 if same else 1
        missed = max(round((voltages.t_mid_ns - last.t_mid_ns) / self._period_ns) - 1, 0)
        self.missed += missed
        return missed

    def _faults(self, voltages: Voltages, source: SourceReading | None) -> list[SkinFault]:
        if source is None or voltages.t_arrival_ns - source.t_ns > self._stale_ns:
            self._without_source, self._source_since_ns = SkinFault.SOURCE_LOST, None
            return [SkinFault.SOURCE_LOST]
        if not source.output_on:
            self._without_source, self._source_since_ns = SkinFault.SOURCE_OFF, None
            return [SkinFault.SOURCE_OFF]
        if self._source_since_ns is None:
            self._source_since_ns = source.t_ns
        if voltages.t_mid_ns < self._source_since_ns:
            # Measured before the current is known to have flowed: without it, sound gauges look like shorts.
            return [self._without_source]
        gauges = self._of_gauges(voltages)
        if source.compliance:
            # In compliance the circuit is what is wrong; where the voltage lies tells which part of it.
            return [SkinFault.COMPLIANCE, *(fault for fault in gauges if fault in (SkinFault.OPEN_1, SkinFault.OPEN_2))]
        if abs(source.current_a - self._current_a) > self._limits.current_share * self._current_a:
            return [SkinFault.CURRENT, *gauges]
        if gauges:
            return gauges
        stuck = [
            fault
            for fault, repeats in zip((SkinFault.STUCK_1, SkinFault.STUCK_2), self._repeats, strict=True)
            if repeats >= self._limits.stuck_after
        ]
        return stuck or self._of_sum(voltages, source)

    def _of_gauges(self, voltages: Voltages) -> list[SkinFault]:
        limits, nominal_v = self._limits, self._limits.resistance_ohm * self._current_a
        values = (voltages.v1_v, voltages.v2_v)
        overranges = (voltages.over_1, voltages.over_2)
        is_open = [over or abs(v) > limits.open_times * nominal_v for v, over in zip(values, overranges, strict=True)]
        found = []
        for i, (v, over) in enumerate(zip(values, overranges, strict=True)):
            dead_elsewhere = abs(values[1 - i]) < limits.short_share * nominal_v
            if is_open[i] and dead_elsewhere:
                # Without a current nothing lies across the other gauge, and all of the compliance across this one.
                found.append((SkinFault.OPEN_1, SkinFault.OPEN_2)[i])
            elif over:
                found.append((SkinFault.OVERRANGE_1, SkinFault.OVERRANGE_2)[i])
            elif abs(v) < limits.short_share * nominal_v:
                if not is_open[1 - i]:
                    found.append((SkinFault.SHORT_1, SkinFault.SHORT_2)[i])
            elif v < 0:
                found.append((SkinFault.REVERSED_1, SkinFault.REVERSED_2)[i])
            elif not limits.least_share * nominal_v <= v <= limits.most_share * nominal_v:
                found.append((SkinFault.IMPLAUSIBLE_1, SkinFault.IMPLAUSIBLE_2)[i])
        return found

    def _of_sum(self, voltages: Voltages, source: SourceReading) -> list[SkinFault]:
        limits = self._limits
        across_v = voltages.v1_v + voltages.v2_v
        slack_v = limits.sum_share * across_v
        leads_v = limits.lead_ohm * self._current_a
        return [] if -slack_v <= source.voltage_v - across_v <= leads_v + slack_v else [SkinFault.SUM]

    def _is_spike(self, pair: tuple[float, float], missed: int) -> bool:
        """Tell a disturbance from a load: readings that agree with each other become the new level after a few."""
        if self._good is None or self._reachable(self._good, pair, missed):
            self._good, self._candidates = pair, []
            return False
        if self._candidates and not self._reachable(self._candidates[-1], pair, missed):
            self._candidates.clear()
        self._candidates.append(pair)
        if len(self._candidates) < self._limits.settle_readings:
            return True
        self._good, self._candidates = pair, []
        return False

    def _reachable(self, before: tuple[float, float], after: tuple[float, float], missed: int) -> bool:
        most = (1 + missed) * math.log1p(self._limits.most_change)
        return all(abs(math.log(now / then)) <= most for then, now in zip(before, after, strict=True))
