"""`shearloop bank build`: solve every cell of a grid and write the bank."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, Self

from daemon.cli import EXIT_INTERRUPTED
from daemon.cli.cluster import add_cluster
from daemon.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tqdm import tqdm

    from bank.bank_file import BankDefinition
    from bank.journal import BankRow
    from bank.mesh import Mesh
    from daemon.bank_config import GridConfig


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="what the bank is of (YAML)")
    parser.add_argument("--out", type=Path, required=True, metavar="PATH", help="the bank file to write")
    add_overrides(parser)
    parser.add_argument("--jobs", type=int, metavar="N", help="threads that solve (default: one per core)")
    add_cluster(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add the options that take the place of what the configuration says."""
    parser.add_argument("--model", metavar="M", help="basis model, in place of the configured one")
    parser.add_argument("--k", metavar="LO:HI:N", help="N values of k from LO to HI, in place of the configured ones")
    parser.add_argument("--sigma", metavar="LO:HI:N", help="N values of sigma from LO to HI, likewise")


def run(args: argparse.Namespace) -> int:
    """Build the bank, telling how far it is on stderr."""
    try:
        return _build(args)
    except KeyboardInterrupt:
        kept = args.out.with_name(f"{args.out.name}.part")
        rest = f"its finished rows are in {kept}, and the same command goes on from there" if kept.exists() else ""
        print(f"shearloop bank: interrupted: {args.out} was not written; {rest or 'nothing is left'}", file=sys.stderr)
        return EXIT_INTERRUPTED


def _build(args: argparse.Namespace) -> int:
    from bank.bank_file import Bank
    from bank.build import build_bank, solve_row
    from daemon.bank_config import load_bank_plan
    from daemon.workers import workers

    jobs = len(os.sched_getaffinity(0)) if args.jobs is None else args.jobs
    if jobs < 1:
        raise UserError(f"--jobs must be 1 or more, not {jobs}")
    model, k, sigma = overrides(args)
    plan = load_bank_plan(args.config, model=model, k=k, sigma=sigma)
    with _Progress(args.out.name) as progress, workers(args.cluster, jobs) as pool:

        def on_cluster(
            mesh: "Mesh", definition: "BankDefinition", rows: "Sequence[int]"
        ) -> "Iterator[tuple[int, BankRow]]":
            for number, cells in pool.map(solve_row, (mesh, definition), rows):
                yield rows[number], cells

        build_bank(
            plan.mesh,
            plan.model,
            plan.k_grid,
            plan.sigma_grid,
            args.out,
            jobs=jobs,
            elsewhere=on_cluster if args.cluster is not None else None,
            on_row=progress.show,
            on_notice=lambda sentence: print(sentence, file=sys.stderr),
        )
    bank = Bank.open(args.out)
    result = {
        "path": str(args.out),
        "identity": bank.identity,
        "model": bank.model,
        "shape": list(bank.signals.shape),
        "valid_cells": int(bank.valid.sum()),
        "cells": bank.valid.size,
        "bytes": args.out.stat().st_size,
    }
    if args.json:
        print(json.dumps(result))
    else:
        print(f"{args.out}: {result['valid_cells']} of {bank.valid.size} cells valid, identity {bank.identity[:12]}")
    return 0


def overrides(args: argparse.Namespace) -> "tuple[str | None, GridConfig | None, GridConfig | None]":
    """Return the model and the grids given on the command line, None where the configuration's hold."""
    from bank.models import model_named

    if args.model is not None:
        model_named(args.model)
    return args.model, _grid("--k", args.k), _grid("--sigma", args.sigma)


def _grid(option: str, text: str | None) -> "GridConfig | None":
    from pydantic import ValidationError

    from daemon.bank_config import GridConfig
    from daemon.config_file import mistakes

    if text is None:
        return None
    try:
        low, high, count = text.split(":")
        return GridConfig(low=float(low), high=float(high), count=int(count))
    except ValidationError as error:
        raise UserError(f"{option} {text}: {mistakes(error, GridConfig)}") from error
    except ValueError as error:
        raise UserError(f"{option} must be LO:HI:N such as 0.01:4.4:100, not {text!r}") from error


class _Progress:
    """The rows done, on stderr where that is a terminal."""

    def __init__(self, name: str) -> None:
        """Say what is in progress."""
        self._name = name
        self._bar: tqdm[NoReturn] | None = None

    def __enter__(self) -> Self:
        """Show nothing yet."""
        return self

    def show(self, done: int, total: int) -> None:
        """Show that `done` of `total` rows are on the disk."""
        from tqdm import tqdm

        if self._bar is None:
            # Rows taken over from an interrupted build say nothing about how fast this one is.
            self._bar = tqdm(total=total, initial=done, unit="row", desc=self._name, disable=None)
        else:
            self._bar.update(done - self._bar.n)

    def __exit__(self, *_: object) -> None:
        """Leave the last state on the screen."""
        if self._bar is not None:
            self._bar.close()
