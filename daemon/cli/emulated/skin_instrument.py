"""What `emulate skin-source` and `emulate skin-daq` share: one instrument, with the gauges of a skin that is pushed."""

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulated import skin_place

if TYPE_CHECKING:
    from shearloop.drivers.emulators.skin import Circuit, Played

EPILOG = (
    "Prints the port's path or address, again each time it is there. On standard input: `shear N` and `normal N` push "
    "the skin; `open`, `short`, `reversed` 1 or 2, `swapped`, `drift 1|2 SHARE_PER_S`, `leads OHM`, `mend` befall the "
    "circuit; "
)


def configure(parser: argparse.ArgumentParser, link_help: str, port_help: str, faults: str) -> None:
    """Add the arguments of one instrument."""
    parser.epilog = EPILOG + faults
    skin_place.add_place(parser, "", link_help, port_help)
    skin_place.add_common(parser)


def play_instrument(args: argparse.Namespace, make: "Callable[[Circuit, argparse.Namespace], Played]") -> int:
    """Play the instrument that is made around a circuit, until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.cli.emulated.skin_push import PushedSkin
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.skin import Circuit

    skin_place.check_speed(args.speed)
    pushed = PushedSkin(args.seed)
    circuit = Circuit(pushed.resistances_ohm)
    instrument = make(circuit, args)

    def on_command(line: str) -> None:
        if pushed.told(line):
            return
        try:
            Circuit(circuit, line, time.monotonic())
        except ValueError:
            instrument.command(line)

    try:
        play(instrument.run(), on_command)
    except* OSError as errors:
        raise UserError(f"it cannot be played: {errors.exceptions[0]}; choose another port or bind address") from None
    return 0


print_port = partial(print, flush=True)
