"""One module per device; `drivers.emulators` plays the same devices byte for byte."""
