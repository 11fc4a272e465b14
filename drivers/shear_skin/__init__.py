"""The microfluidic shear skin: two gauges in series with a current source, and two voltages."""

from shearloop.drivers.shear_skin.instruments import (
    SOURCE_PERIOD_S,
    AdcBoard,
    Daq,
    Keithley6430,
    PairParser,
    ScpiScanner,
    SourceReading,
    Voltages,
    recorded_scanner,
    recorded_source,
)
from shearloop.drivers.shear_skin.scpi import RecordedInstrument
from shearloop.drivers.shear_skin.skin import SampleValidator, ShearSkin, SkinFault, SkinSample

__all__ = [
    "SOURCE_PERIOD_S",
    "AdcBoard",
    "Daq",
    "Keithley6430",
    "PairParser",
    "RecordedInstrument",
    "SampleValidator",
    "ScpiScanner",
    "ShearSkin",
    "SkinFault",
    "SkinSample",
    "SourceReading",
    "Voltages",
    "recorded_scanner",
    "recorded_source",
]
