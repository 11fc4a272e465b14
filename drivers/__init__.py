"""Drivers, a module or a package for each device; `shearloop.emulators` plays the same devices byte for byte."""
