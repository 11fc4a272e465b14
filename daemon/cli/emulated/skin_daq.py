"""`shearloop emulate skin-daq`: what reads the voltages of the shear skin's gauges."""

import argparse
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulated import skin_instrument, skin_place

if TYPE_CHECKING:
    from shearloop.drivers.emulators.skin import Circuit, Played


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate skin-daq`."""
    skin_instrument.configure(
        parser,
        "play a converter board under this name (without a place: under none)",
        "play a scanning multimeter on this port instead, 0 for a free one",
        "`silence [SECONDS]`, `unplug [SECONDS]`, `normal` befall its interface, `break-off` the scanner's "
        "next answer, and `missing`, `garbage`, `torn`, `stuck [SECONDS]` the board's lines.",
    )


def run(args: argparse.Namespace) -> int:
    """Play until told to stop; 5 mA flow all the time."""
    from shearloop.drivers.emulators.skin import play_daq

    where = skin_place.place(args, "")

    def make(circuit: "Circuit", args: argparse.Namespace) -> "Played":
        circuit.level_a, circuit.compliance_v, circuit.output_on = 5e-3, 1.0, True
        return play_daq(circuit, where, skin_instrument.print_port, speed=args.speed, seed=args.seed)

    return skin_instrument.play_instrument(args, make)
