"""The shear skin as a device: a current source, two voltages, and what they say of the two gauges."""

import contextlib
from collections.abc import AsyncGenerator, Mapping

from shearloop.drivers.shear_skin.daq import Daq
from shearloop.drivers.shear_skin.judge import CircuitLimits, SampleValidator, SkinSample
from shearloop.drivers.shear_skin.source import Keithley6430, SourceReading


class ShearSkin:
    """Source and DAQ of one skin. Run `watch_source` beside `samples`: without it every sample says so."""

    def __init__(self, source: Keithley6430, daq: Daq, limits: CircuitLimits | None = None) -> None:
        """Take both instruments; nothing is opened yet."""
        self._source = source
        self._daq = daq
        self._judge = SampleValidator(source.current_a, source.period_s, daq.period_s, limits)
        self._latest: SourceReading | None = None
        self._samples = 0

    @property
    def period_s(self) -> float:
        """How often a sample is to be expected."""
        return self._daq.period_s

    async def watch_source(self) -> None:
        """Set the source up and read it, until cancelled; then its output is switched off."""
        async with contextlib.aclosing(self._source.readings()) as readings:
            async for reading in readings:
                self._latest = reading

    async def samples(self) -> AsyncGenerator[SkinSample]:
        """Yield a sample for every reading of the voltages, for ever, whatever becomes of the instruments meanwhile.

        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        async with contextlib.aclosing(self._daq.readings()) as readings:
            async for voltages in readings:
                self._samples += 1
                yield self._judge.sample(voltages, self._latest)

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the voltages; counts are since the process began."""
        facts = dict(self._daq.facts())
        errors = facts.get("errors")
        if isinstance(errors, Mapping):
            facts["errors"] = {**errors, **self._judge.faults}
        facts["expected_hz"] = self._judge.expected_hz
        return {**facts, "samples": self._samples, "missed": self._judge.missed}

    def source_facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the current source."""
        return self._source.facts()
