"""`shearloop bank plot`: draw a bank's signals, and the conductivities of the five models."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.bank.build import add_overrides, overrides
from shearloop.daemon.errors import UserError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("path", type=Path, nargs="?", metavar="PATH", help="a bank whose signals are drawn")
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a bank's configuration (YAML): its models are drawn, and without "
        "PATH its signals too, solved for the purpose",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory for the PNG and SVG files")
    add_overrides(parser)


def run(args: argparse.Namespace) -> int:
    """Draw what the arguments allow: the models need a mesh, which a bank file does not hold."""
    if args.path is None and args.config is None:
        raise UserError("give a bank's PATH, or --config FILE, or both")
    try:
        from shearloop.daemon.cli.bank.figures import (
            SignalGrid,
            models_figure,
            save_figure,
            signal_figure,
            solved_grid,
            spread,
        )
    except ModuleNotFoundError as error:
        raise UserError(f"drawing needs {error.name}: install shearloop with the extra `plot`") from error
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.bank_config import load_bank_plan

    figures = {}
    model, k, sigma = overrides(args)
    plan = load_bank_plan(args.config, model=model, k=k, sigma=sigma) if args.config is not None else None
    if args.path is not None:
        bank = Bank.open(args.path)
        rows, columns = spread(len(bank.k_grid)), spread(len(bank.sigma_grid))
        cells = (rows[:, None], columns)
        figures["bank_signals"] = signal_figure(
            SignalGrid(bank.model, bank.k_grid[rows], bank.sigma_grid[columns], bank.signals[cells], bank.valid[cells])
        )
    elif plan is not None:
        k_drawn, sigma_drawn = plan.k_grid[spread(len(plan.k_grid))], plan.sigma_grid[spread(len(plan.sigma_grid))]
        figures["bank_signals"] = signal_figure(solved_grid(plan.mesh, plan.model, k_drawn, sigma_drawn))
    if plan is not None:
        figures["models"] = models_figure(plan.mesh)
    try:
        for name, figure in figures.items():
            for path in save_figure(figure, args.out, name):
                print(path)
    except OSError as error:
        raise UserError(
            f"{args.out}: the pictures cannot be written: {error.strerror}; choose another --out"
        ) from error
    return 0
