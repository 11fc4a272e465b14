"""`shearloop emulate hx711`: the load cell's board, with a torque that is held, swept or recorded."""

import argparse
import math
from functools import partial
from itertools import count

from shearloop.daemon.cli.emulated.link import add_link, checked_link


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate hx711`."""
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input befalls the next "
        "line: garbage, spike, torn; or what follows: silence [SECONDS], saturation [SECONDS], stuck [SECONDS], "
        "unplug [SECONDS], jump NM. `torque NM` sets the torque, `mass G` what that many grams on the lever arm make."
    )
    parser.add_argument("--torque-nm", type=float, default=0.0, metavar="NM", help="the torque (default: %(default)s)")
    parser.add_argument("--sweep-nm", type=float, default=0.0, metavar="NM", help="add a slow sine of this height")
    parser.add_argument("--paper-sketch", action="store_true", help="send N·m, as the paper's board did, not counts")
    parser.add_argument("--seed", type=int, default=0, help="of noise and garbage (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the board's 10.9 lines per second")
    add_link(parser)
    parser.add_argument("--fault", action="append", default=[], metavar="NAME[:AMOUNT]", help="a fault from the start")


SWEEP_PERIOD_LINES = 218
LEVER_ARM_M, STANDARD_GRAVITY = 0.035, 9.80665


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.boards import LOAD_PERIOD_S, PAPER_SKETCH, Hx711Board, Sketch, parse_fault

    if not (math.isfinite(args.speed) and args.speed > 0):
        raise UserError(f"--speed {args.speed:g} is not above 0")
    if not (math.isfinite(args.torque_nm) and math.isfinite(args.sweep_nm)):
        raise UserError("--torque-nm and --sweep-nm must be finite")
    torque = _Torque(args.torque_nm, args.sweep_nm)
    board = Hx711Board(
        torque.next,
        PAPER_SKETCH if args.paper_sketch else Sketch(),
        period_s=LOAD_PERIOD_S / args.speed,
        link=checked_link(args.link),
        on_port=partial(print, flush=True),
        seed=args.seed,
    )
    for text in args.fault:
        try:
            board.inject(parse_fault(text))
        except ValueError as error:
            raise UserError(f"--fault {text}: {error}") from None

    def on_command(line: str) -> None:
        if not torque.told(line):
            board.inject(parse_fault(line))

    play(board.run(), on_command)
    return 0


class _Torque:
    def __init__(self, held_nm: float, sweep_nm: float) -> None:
        self._held_nm = held_nm
        self._sweep_nm = sweep_nm
        self._lines = count()

    def next(self) -> float:
        return self._held_nm + self._sweep_nm * math.sin(2 * math.pi * next(self._lines) / SWEEP_PERIOD_LINES)

    def told(self, line: str) -> bool:
        """Take a line that sets the torque; return whether it did."""
        match line.split():
            case ["torque", number]:
                self._held_nm = _finite(number)
            case ["mass", number]:
                self._held_nm = _finite(number) * 1e-3 * STANDARD_GRAVITY * LEVER_ARM_M
            case _:
                return False
        return True


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value
