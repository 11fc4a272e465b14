"""Drivers, one module per device; `shearloop.emulators` plays the same devices byte for byte."""
