"""`shearloop emulate eit-kit`: a recording, or frames synthesised from a bank, as the board would send them."""

import argparse
import math
from collections.abc import Iterator
from functools import partial
from importlib import resources
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulated.link import add_link, checked_link

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shearloop.bank.eit.mesh import Mesh
    from shearloop.daemon.synthetic import Signals

DEMO_BANK = Path(str(resources.files("shearloop"))) / "config" / "banks" / "demo.yaml"
# Where the paper's method finds its screwdriver: σ at rest and at the largest torque of the slices, in N·m.
K_CM = 3.25
SIGMA_AT_REST_CM, SIGMA_AT_LARGEST_CM, LARGEST_TORQUE_NM = 1.85, 1.25, 0.14


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate eit-kit`."""
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input befalls the next "
        "frame: cut-line, wrong-count, not-a-number, nan, negative, zero, garbage, flood, repeat, silence [SECONDS], "
        "unplug [SECONDS]. A silence without a number lasts until the board is started again."
    )
    frames = parser.add_argument_group("what is played")
    frames.add_argument("--recording", type=Path, metavar="FILE", help="a recorded stream (.mat)")
    frames.add_argument("--side", choices=("left", "right"), help="which fingertip, if the file holds both")
    frames.add_argument(
        "--bank",
        type=Path,
        metavar="FILE",
        help="synthesise twists from this bank's signals (default, without --recording: the demo's fingertip, solved)",
    )
    frames.add_argument("--k", type=float, default=K_CM, help="k of the synthetic twists (default: %(default)s)")
    frames.add_argument(
        "--sigma",
        type=float,
        nargs=2,
        default=(SIGMA_AT_REST_CM, SIGMA_AT_LARGEST_CM),
        metavar=("REST", "LARGEST"),
        help=f"sigma at no torque and at {LARGEST_TORQUE_NM} N·m (default: {SIGMA_AT_REST_CM} {SIGMA_AT_LARGEST_CM})",
    )
    frames.add_argument("--seed", type=int, default=0, help="of noise and garbage (default: %(default)s)")
    frames.add_argument("--once", action="store_true", help="play the recording once, then be silent")
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="N", help="times the board's 1.85 frames per second"
    )
    add_link(parser)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[:SECONDS]@FRAME",
        help="a fault that befalls a frame, counted from 0; may be given several times",
    )


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.cli.emulated.console import play
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.eit_kit import FRAME_PERIOD_S
    from shearloop.drivers.emulators.boards import EitKitBoard, parse_fault

    if not (math.isfinite(args.speed) and args.speed > 0):
        raise UserError(f"--speed {args.speed:g} is not above 0")
    link = checked_link(args.link)
    faults = dict(_fault_at(text) for text in args.fault)
    board = EitKitBoard(
        _frames(args, FRAME_PERIOD_S),
        period_s=FRAME_PERIOD_S / args.speed,
        link=link,
        faults=faults,
        on_port=partial(print, flush=True),
        seed=args.seed,
    )
    play(board.run(), lambda line: board.inject(parse_fault(line)))
    return 0


def _fault_at(text: str) -> tuple[int, "Fault"]:
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.boards import parse_fault

    name, _, frame = text.partition("@")
    if not frame.isdecimal():
        raise UserError(f"--fault {text} names no frame; write NAME@FRAME, for instance cut-line@20")
    try:
        return int(frame), parse_fault(name)
    except ValueError as error:
        raise UserError(f"--fault {text}: {error}") from None


def _frames(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    from shearloop.daemon.errors import UserError

    if args.recording is not None and args.bank is not None:
        raise UserError("give either --recording FILE to play a recording or --bank FILE to synthesise frames")
    if args.recording is None:
        if args.once:
            raise UserError("--once is for a recording; synthetic frames have no end")
        return _synthetic(args, period_s)
    from shearloop.daemon.recording.matlab_streams import read_stream

    lines = read_stream(args.recording, args.side).lines
    return iter(lines) if args.once else cycle(lines)


def _synthetic(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.synthetic import Synthesiser, TwistProgramme, solved_signals, twist_frames

    rest, largest = args.sigma

    def sigma_of_torque(torque_nm: float) -> float:
        return float(rest + (largest - rest) * torque_nm / LARGEST_TORQUE_NM)

    if args.bank is not None:
        signals: Signals = Bank.open(args.bank)
    else:
        signals = solved_signals(_demo_mesh(), args.k, min(rest, largest), max(rest, largest))
    synthesiser = Synthesiser(signals, seed=args.seed)
    # What cannot be synthesised is said before a port appears.
    for torque_nm in (0.0, LARGEST_TORQUE_NM):
        synthesiser.signal(args.k, sigma_of_torque(torque_nm))
    frames = twist_frames(synthesiser, TwistProgramme(), k=args.k, sigma_of_torque=sigma_of_torque, period_s=period_s)
    return (frame.line for frame in frames)


def _demo_mesh() -> "Mesh":
    """Return the mesh of the demo's bank; raises UserError where the project's `config/` is not beside its code."""
    from shearloop.daemon.bank_config import load_bank_plan
    from shearloop.daemon.errors import UserError

    if not DEMO_BANK.is_file():
        raise UserError(f"{DEMO_BANK} is not there; give --recording FILE to play, or --bank FILE to synthesise from")
    return load_bank_plan(DEMO_BANK).mesh
