"""`shearloop emulate eit-kit` and `shearloop emulate hx711`: the boards of fingertip and load cell."""

import argparse
import math
from collections.abc import Iterator
from itertools import count, cycle
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulate import console
from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from shearloop.bank.eit.mesh import Mesh
    from shearloop.daemon.synthetic import Signals
    from shearloop.drivers.emulators.boards import BoardFault, EmulatedBoard

DEMO_BANK = Path(__file__).resolve().parents[3] / "config" / "banks" / "demo.yaml"
# The paper's screwdriver: σ at rest and at the largest torque of its peak samples, in N·m.
K_CM = 3.25
SIGMA_AT_REST_CM, SIGMA_AT_LARGEST_CM, LARGEST_TORQUE_NM = 1.85, 1.25, 0.14
SWEEP_PERIOD_LINES = 218
LEVER_ARM_M, STANDARD_GRAVITY = 0.035, 9.80665


def _configure_eit_kit(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input applies to the "
        "next frame: cut-line, wrong-count, not-a-number, nan, negative, zero, garbage, flood, repeat, silence "
        "[SECONDS], unplug [SECONDS]. A silence without a number lasts until the board is started again."
    )
    frames = parser.add_argument_group("frames")
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
    console.add_link(parser)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="NAME[:SECONDS]@FRAME",
        help="a fault of one frame, counted from 0; may be given several times",
    )


def _run_eit_kit(args: argparse.Namespace) -> int:
    from shearloop.drivers.eit_kit import FRAME_PERIOD_S
    from shearloop.drivers.emulators.boards import EitKitBoard

    console.check_positive(args, "speed")
    link = console.checked_link(args.link)
    fault_at: dict[int, BoardFault] = {}
    for text in args.fault:
        name, _, frame = text.partition("@")
        if not frame.isdecimal():
            raise UserError(f"--fault {text} names no frame; write NAME@FRAME, for instance cut-line@20")
        fault_at[int(frame)] = _parse_fault(text, name, EitKitBoard)
    board = EitKitBoard(
        _frames(args, FRAME_PERIOD_S),
        period_s=FRAME_PERIOD_S / args.speed,
        link=link,
        fault_at=fault_at,
        on_port=console.print_port,
        seed=args.seed,
    )
    console.play(board.run(), board.command)
    return 0


def _parse_fault(argument: str, name: str, board: "type[EmulatedBoard]") -> "BoardFault":
    from shearloop.drivers.emulators.boards import parse_fault

    try:
        return parse_fault(name, board.faults)
    except ValueError as error:
        raise UserError(f"--fault {argument}: {error}") from None


def _frames(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    if args.recording is not None and args.bank is not None:
        raise UserError("give either --recording FILE to play a recording or --bank FILE to synthesise frames")
    if args.recording is None:
        if args.once:
            raise UserError("--once is for a recording; synthetic frames have no end")
        return _synthetic(args, period_s)
    from shearloop.daemon.recording.matlab import read_stream

    lines = read_stream(args.recording, args.side).values
    return iter(lines) if args.once else cycle(lines)


def _synthetic(args: argparse.Namespace, period_s: float) -> Iterator["NDArray[np.float64]"]:
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.synthetic import Synthesiser, TwistProgramme, solve_signals, twist_frames

    rest, largest = args.sigma

    def sigma_of_torque(torque_nm: float) -> float:
        return float(rest + (largest - rest) * torque_nm / LARGEST_TORQUE_NM)

    if args.bank is not None:
        signals: Signals = Bank.open(args.bank)
    else:
        signals = solve_signals(_demo_mesh(), args.k, min(rest, largest), max(rest, largest))
    synthesiser = Synthesiser(signals, seed=args.seed)
    # Report a wrong sigma before a port appears.
    for torque_nm in (0.0, LARGEST_TORQUE_NM):
        synthesiser.signal(args.k, sigma_of_torque(torque_nm))
    return twist_frames(synthesiser, TwistProgramme(), k=args.k, sigma_of_torque=sigma_of_torque, period_s=period_s)


def _demo_mesh() -> "Mesh":
    from shearloop.daemon.bank_config import load_bank_plan

    if not DEMO_BANK.is_file():
        raise UserError(f"{DEMO_BANK} is not there; give --recording FILE to play, or --bank FILE to synthesise from")
    return load_bank_plan(DEMO_BANK).mesh


def _configure_hx711(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Prints the port's path, again each time it is plugged in. A fault's name on standard input applies to the "
        "next line: garbage, spike, torn; or to what follows: silence [SECONDS], saturation [SECONDS], stuck "
        "[SECONDS], unplug [SECONDS], jump NM. `torque NM` sets the torque, `mass G` that of a mass on the lever."
    )
    parser.add_argument("--torque-nm", type=float, default=0.0, metavar="NM", help="the torque (default: %(default)s)")
    parser.add_argument("--sweep-nm", type=float, default=0.0, metavar="NM", help="add a slow sine of this height")
    parser.add_argument("--paper-sketch", action="store_true", help="send N·m, as the paper's board did, not counts")
    parser.add_argument("--seed", type=int, default=0, help="of noise and garbage (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the board's 10.9 lines per second")
    console.add_link(parser)
    parser.add_argument("--fault", action="append", default=[], metavar="NAME[:AMOUNT]", help="a fault from the start")


def _run_hx711(args: argparse.Namespace) -> int:
    from shearloop.drivers.emulators.boards import LOAD_PERIOD_S, PAPER_SKETCH, Hx711Board, Sketch

    console.check_positive(args, "speed")
    if not (math.isfinite(args.torque_nm) and math.isfinite(args.sweep_nm)):
        raise UserError("--torque-nm and --sweep-nm must be finite")
    held_nm, lines = args.torque_nm, count()

    def torque_nm() -> float:
        return float(held_nm + args.sweep_nm * math.sin(2 * math.pi * next(lines) / SWEEP_PERIOD_LINES))

    board = Hx711Board(
        torque_nm,
        PAPER_SKETCH if args.paper_sketch else Sketch(),
        period_s=LOAD_PERIOD_S / args.speed,
        link=console.checked_link(args.link),
        on_port=console.print_port,
        seed=args.seed,
    )
    for text in args.fault:
        board.inject(_parse_fault(text, text, Hx711Board))

    def on_command(line: str) -> None:
        nonlocal held_nm
        match line.split():
            case ["torque", number]:
                held_nm = _finite(number)
            case ["mass", number]:
                held_nm = _finite(number) * 1e-3 * STANDARD_GRAVITY * LEVER_ARM_M
            case _:
                board.command(line)

    console.play(board.run(), on_command)
    return 0


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


DEVICES = {
    "eit-kit": console.Device("the EIT board of a fingertip, on a pseudo-terminal", _configure_eit_kit, _run_eit_kit),
    "hx711": console.Device("the load cell's board, on a pseudo-terminal", _configure_hx711, _run_hx711),
}
