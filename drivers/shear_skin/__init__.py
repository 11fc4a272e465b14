"""The microfluidic shear skin: two gauges in series with a current source, and two voltages."""

from shearloop.drivers.shear_skin.instruments import AdcBoard, Daq, Keithley6430, ScpiScanner, SourceReading, Voltages
from shearloop.drivers.shear_skin.skin import SampleValidator, ShearSkin, SkinFault, SkinSample

__all__ = [
    "AdcBoard",
    "Daq",
    "Keithley6430",
    "SampleValidator",
    "ScpiScanner",
    "ShearSkin",
    "SkinFault",
    "SkinSample",
    "SourceReading",
    "Voltages",
]
