"""The microfluidic shear skin: two gauges in series with a current source, and two voltages."""
