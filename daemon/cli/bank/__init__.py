"""`shearloop bank`: solve, build, inspect and draw banks of simulated signals."""

import argparse
import sys
from pathlib import Path

from shearloop.daemon.cli.bank import build
from shearloop.daemon.cli.bank.build import MODEL_NAMES, add_overrides, overrides
from shearloop.daemon.cli.options import add_json, check_overwrite
from shearloop.daemon.cli.terminal import print_result
from shearloop.daemon.errors import UserError

_ACTIONS = {
    "build": "build a bank, or resume an interrupted build",
    "design": "design the smallest bank that a recording's noise asks for, as a configuration for `build`",
    "info": "check a bank's checksums and print its definition",
    "plot": "draw a bank's signals, and the conductivities of the five models",
    "solve": "solve for the 896 voltages of one conductivity",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the actions and their arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    added = {name: actions.add_parser(name, help=text, description=text) for name, text in _ACTIONS.items()}
    build.configure(added["build"])

    design = added["design"]
    design.add_argument("recording", type=Path, metavar="RECORDING", help="a recording (.mcap) or a folder of slices")
    design.add_argument(
        "--fingertip", type=Path, metavar="FILE", help="the fingertip's measures (default: the paper's)"
    )
    design.add_argument("--side", metavar="SIDE", help="side of the recording to design for (default: its first)")
    design.add_argument("--out", type=Path, metavar="FILE", help="write the YAML there (default: print it)")

    info = added["info"]
    info.add_argument("path", type=Path, metavar="PATH", help="the bank file")
    add_json(info)

    plot = added["plot"]
    plot.add_argument("path", type=Path, nargs="?", metavar="PATH", help="a bank whose signals are drawn")
    plot.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a bank's configuration (YAML): its models are drawn, and without PATH its signals, solved for the plot",
    )
    plot.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory for the PNG and SVG files")
    add_overrides(plot)

    solve = added["solve"]
    solve.add_argument(
        "--mesh", type=Path, required=True, metavar="FILE", help="a mesh (.npz, EIDORS .mat) or a fingertip (.yaml)"
    )
    solve.add_argument("--model", required=True, metavar="M", help=f"basis model: {MODEL_NAMES}")
    solve.add_argument("--k", type=float, required=True, metavar="K", help="the model's first parameter")
    solve.add_argument("--sigma", type=float, required=True, metavar="S", help="the model's second parameter")
    solve.add_argument("--out", type=Path, required=True, metavar="V.npy", help="file for the 896 float64 voltages")
    add_json(solve)


def run(args: argparse.Namespace) -> int:
    """Run one action and return the exit status."""
    actions = {"build": build.run, "design": _design, "info": _info, "plot": _plot, "solve": _solve}
    return actions[args.action](args)


def _design(args: argparse.Namespace) -> int:
    from shearloop.daemon.analysis.bank_design import design_yaml, designed_for, doubts

    if args.out is not None:
        check_overwrite(args.out, "a configuration")
    fingertip, design = designed_for(args.recording, args.fingertip, args.side)
    text = design_yaml(design, fingertip, args.recording)
    for sentence in doubts(design):
        print(f"shearloop bank: {sentence}", file=sys.stderr)
    if args.out is None:
        print(text, end="")
        return 0
    try:
        args.out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{args.out}: the design cannot be written: {error.strerror}") from error
    print(f"Build it: shearloop bank build --config {args.out} --out FILE", file=sys.stderr)
    return 0


def _info(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    import numpy as np

    from shearloop.bank.eit.bank_file import FORMAT_VERSION, Bank
    from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH
    from shearloop.bank.eit.models import MODELS

    bank = Bank.open(args.path, verify=True)
    model = MODELS[bank.model]
    grids = ("k", bank.k_grid, model.k_unit), ("sigma", bank.sigma_grid, model.sigma_unit)
    facts: dict[str, object] = {
        "path": str(args.path),
        "format_version": FORMAT_VERSION,
        "identity": bank.identity,
        "model": bank.model,
        "variation": asdict(bank.definition.variation),
        "geometry_hash": bank.geometry_hash,
        "channel_table_hash": CHANNEL_TABLE_HASH,
        "signals_sha256": bank.signals_sha256,
        "shape": list(bank.signals.shape),
        **{name: {"low": grid[0], "high": grid[-1], "count": len(grid), "unit": unit} for name, grid, unit in grids},
        "cells": bank.valid.size,
        "valid_cells": int(bank.valid.sum()),
        "not_positive_cells": int((bank.min_conductivity <= 0).sum()),
        "homogeneous_norm": float(np.linalg.norm(bank.homogeneous)),
        "bytes": args.path.stat().st_size,
    }
    lines = [f"{name.replace('_', ' '):<20}{_text(value)}" for name, value in facts.items()]
    print_result(facts, [*lines, "all checksums agree"], as_json=args.json)
    return 0


def _text(value: object) -> str:
    if isinstance(value, dict) and "count" in value:
        return f"{value['count']} values from {value['low']:g} to {value['high']:g} ({value['unit']})"
    if isinstance(value, dict):
        return ", ".join(f"{name} {one:g}" for name, one in value.items())
    if isinstance(value, list):
        return " × ".join(map(str, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _plot(args: argparse.Namespace) -> int:
    if args.path is None and args.config is None:
        raise UserError("give a bank's PATH, or --config FILE, or both")
    try:
        from shearloop.daemon.cli.bank import figures
    except ModuleNotFoundError as error:
        raise UserError(f"drawing needs {error.name}: install shearloop with the extra `plot`") from error
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.daemon.bank_config import load_bank_plan

    drawn = {}
    replaced = overrides(args)
    plan = load_bank_plan(args.config, *replaced) if args.config is not None else None
    if args.path is not None:
        drawn["bank_signals"] = figures.signal_figure(figures.grid_of_bank(Bank.open(args.path)))
    elif plan is not None:
        drawn["bank_signals"] = figures.signal_figure(figures.grid_of_plan(plan))
    if plan is not None:
        drawn["models"] = figures.models_figure(plan.mesh)
    try:
        for name, figure in drawn.items():
            for path in figures.save_figure(figure, args.out, name):
                print(path)
    except OSError as error:
        raise UserError(
            f"{args.out}: the pictures cannot be written: {error.strerror}; choose another --out"
        ) from error
    return 0


def _solve(args: argparse.Namespace) -> int:
    import numpy as np

    from shearloop.bank.eit.forward import ForwardModel
    from shearloop.bank.eit.models import conductivity
    from shearloop.bank.errors import ConductivityError
    from shearloop.daemon.bank_config import load_geometry
    from shearloop.files import replace_file

    check_overwrite(args.out, "an array of NumPy", np.lib.format.MAGIC_PREFIX)
    mesh = load_geometry(args.mesh)
    try:
        voltages = ForwardModel(mesh).voltages(conductivity(mesh, args.model, args.k, args.sigma))
    except ConductivityError as error:
        raise UserError(f"--model {args.model} --k {args.k:g} --sigma {args.sigma:g}: {error}") from error
    try:
        with replace_file(args.out) as file:
            np.save(file, voltages)
    except OSError as error:
        raise UserError(
            f"{args.out}: the voltages cannot be written: {error.strerror}; choose another --out"
        ) from error
    norm = float(np.linalg.norm(voltages))
    result = {"path": str(args.out), "voltages": len(voltages), "norm": norm}
    print_result(result, [f"{args.out}: 896 voltages, norm {norm:.9g}"], as_json=args.json)
    return 0
