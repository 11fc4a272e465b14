"""The microfluidic shear skin: two gauges in series with a current source, and two voltages.

`source` is the Keithley 6430 that feeds them, `scanner` and `adc_board` are two ways to read the voltages, `judge`
turns both into resistances and names what is wrong, `skin` ties them together.
"""
