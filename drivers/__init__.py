"""Drivers, one module per device; `shearloop.drivers.emulators` plays the same devices byte for byte."""
