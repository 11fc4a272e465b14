"""`shearloop bank build`: solve every cell of a grid and write the bank, or a folder of banks over more parameters."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shearloop.daemon.cli.options import add_cluster, add_json, check_overwrite
from shearloop.daemon.cli.terminal import progress_bar
from shearloop.daemon.errors import UserError
from shearloop.daemon.signals import report_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from shearloop.bank.eit.bank_file import BankDefinition
    from shearloop.bank.eit.build import BankRow
    from shearloop.bank.eit.mesh import Mesh
    from shearloop.daemon.bank_config import BankPlan, GridConfig

# As text: `--help` imports no large library.
MODEL_NAMES = "step, linear, cut_linear, gaussian_derivative or modulated_gaussian"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the bank's configuration (YAML)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="PATH", help="the bank file to write; with `over`, the folder"
    )
    add_overrides(parser)
    parser.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help="threads that solve, or workers of a cluster of this machine (default: one per core)",
    )
    add_cluster(parser)
    add_json(parser)


def add_overrides(parser: argparse.ArgumentParser) -> None:
    """Add the options that replace values of the configuration."""
    parser.add_argument("--model", metavar="M", help=f"basis model ({MODEL_NAMES}), in place of the configured one")
    parser.add_argument(
        "--k",
        metavar="LO:HI:N",
        help="N values of k from LO to HI, in place of the configured ones; --k=-5:-4:2 where LO is below 0",
    )
    parser.add_argument("--sigma", metavar="LO:HI:N", help="N values of sigma from LO to HI, likewise")


def run(args: argparse.Namespace) -> int:
    """Build the bank, with progress on stderr."""
    try:
        return _build(args)
    except KeyboardInterrupt as interrupt:
        kept = args.out if args.out.is_dir() else f"{args.out}.part"
        sentence = f"shearloop bank: interrupted: finished rows are in {kept}, and the same command resumes from there"
        return report_interrupt(sentence, interrupt)


def _build(args: argparse.Namespace) -> int:
    from shearloop.bank.eit.bank_file import BANK_MAGIC
    from shearloop.bank.eit.build import build_bank, solve_row
    from shearloop.bank.errors import EmptyBankError
    from shearloop.daemon.bank_config import load_bank_plans
    from shearloop.daemon.workers import open_executor

    jobs = len(os.sched_getaffinity(0)) if args.jobs is None else args.jobs
    if jobs < 1:
        raise UserError(f"--jobs must be 1 or more, not {jobs}")
    plans = load_bank_plans(args.config, *overrides(args))
    paths = _paths(args.out, list(plans))
    # In a folder the names are the banks' own, and an unusable bank is built again.
    if paths == [args.out]:
        check_overwrite(args.out, "a bank", BANK_MAGIC)
    built = []
    with open_executor(args.cluster, jobs) as pool:

        def on_cluster(
            mesh: "Mesh", definition: "BankDefinition", rows: "Sequence[int]"
        ) -> "Iterator[tuple[int, BankRow]]":
            for number, cells in pool.map(solve_row, (mesh, definition), rows):
                yield rows[number], cells

        for path, plan in zip(paths, plans.values(), strict=True):
            if len(paths) > 1 and _is_built(path, plan):
                built.append(path)
                continue
            try:
                with progress_bar(path.name, len(plan.definition.k_grid), "row") as show:
                    build_bank(
                        *plan,
                        path,
                        jobs=jobs,
                        elsewhere=on_cluster if args.cluster is not None else None,
                        on_row=lambda done, _: show(done),
                        on_notice=lambda sentence: print(sentence, file=sys.stderr),
                    )
                built.append(path)
            except EmptyBankError as error:
                # The other banks of a folder are usable; where all are empty, the last one fails.
                if path == paths[-1] and not built:
                    raise
                print(f"{error}. It is left out", file=sys.stderr)
    results = [_result(path) for path in built]
    if args.json:
        print(json.dumps(results[0] if args.out == paths[0] else {"banks": results}))
    else:
        for one in results:
            print(f"{one['path']}: {one['valid_cells']} of {one['cells']} cells valid, identity {one['identity'][:12]}")
    return 0


def _paths(out: Path, names: list[str]) -> list[Path]:
    """Return the banks' paths: `out` for a single one without a name, else files in the folder `out`."""
    if names == [""]:
        return [out]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: the banks need a folder there: {error.strerror}; choose another --out") from error
    return [out / f"{name}.bank" for name in names]


def _is_built(path: Path, plan: "BankPlan") -> bool:
    """Return whether an earlier build of a folder has finished this bank."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.errors import BankFileError

    if not path.exists():
        return False
    try:
        return Bank.open(path, verify=True).identity == plan.definition.identity
    except BankFileError:
        print(f"{path}: it cannot be used, and is built again", file=sys.stderr)
        return False


def _result(path: Path) -> dict[str, Any]:
    from shearloop.bank.eit.bank_file import Bank

    bank = Bank.open(path)
    return {
        "path": str(path),
        "identity": bank.identity,
        "model": bank.model,
        "shape": list(bank.signals.shape),
        "valid_cells": int(bank.valid.sum()),
        "cells": bank.valid.size,
        "bytes": path.stat().st_size,
    }


def overrides(args: argparse.Namespace) -> "tuple[str | None, GridConfig | None, GridConfig | None]":
    """Return the model and the grids of the command line, None where the configuration's hold."""
    from shearloop.bank.eit.models import model_named

    if args.model is not None:
        model_named(args.model)
    return args.model, _grid("--k", args.k), _grid("--sigma", args.sigma)


def _grid(option: str, text: str | None) -> "GridConfig | None":
    from shearloop.daemon.bank_config import GridConfig
    from shearloop.yaml_files import validated

    if text is None:
        return None
    try:
        low, high, count = text.split(":")
        grid = {"low": float(low), "high": float(high), "count": int(count)}
    except ValueError as error:
        raise UserError(f"{option} must be LO:HI:N such as 0.01:4.4:100, not {text!r}") from error
    return validated(grid, GridConfig, f"{option} {text}", UserError)
