"""`shearloop emulate skin-source`: the Keithley 6430 that feeds the shear skin."""

import argparse

from shearloop.daemon.cli.emulated import skin_instrument, skin_place


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate skin-source`."""
    skin_instrument.configure(
        parser,
        "a name for its RS-232 port",
        "listen on this port instead, 0 for a free one",
        "`silence [SECONDS]`, `unplug [SECONDS]`, `break-off` (the next answer ends half-way), `normal` befall its "
        "interface.",
    )


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.drivers.emulators.skin import play_source

    where = skin_place.place(args, "")
    return skin_instrument.play_instrument(
        args,
        lambda circuit, args: play_source(circuit, where, skin_instrument.print_port, speed=args.speed, seed=args.seed),
    )
