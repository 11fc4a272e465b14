"""`shearloop bank`: solve, design, build and inspect banks of simulated signals."""

import argparse
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shearloop.cli.options import add_action, add_cluster, add_json, add_option, positive, run_action
from shearloop.cli.output_paths import output_path
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError
from shearloop.tools.outputs import YAML_KEYS, check_overwrite, progress_bar, writing
from shearloop.tools.parallel import processors

if TYPE_CHECKING:
    from shearloop.bank.bank_file import Bank

run = run_action

# As text: `--help` imports no large library.
MODEL_NAMES = "step, linear, cut_linear, gaussian_derivative or modulated_gaussian"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the actions and their arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    build = add_action(actions, "build", "build a bank", _build)
    add_option(build, "--config", Path, "FILE", "the bank's configuration (YAML)", required=True)
    add_option(build, "--out", output_path, "PATH", "the bank file to write", required=True)
    text = "threads, or workers of a cluster of this machine (default: one per core)"
    add_option(build, "--jobs", positive(int), "N", text)
    add_cluster(build)
    add_json(build)
    summary = "design the smallest bank that a recording's noise asks for, as a configuration for `build`"
    design = add_action(actions, "design", summary, _design)
    add_option(design, "recording", Path, "RECORDING", "a recording (.mcap) or a folder of slices")
    add_option(design, "--fingertip", Path, "FILE", "the fingertip's measures (default: the paper's)")
    design.add_argument("--side", metavar="SIDE", help="side of the recording to design for (default: its first)")
    add_option(design, "--out", output_path, "FILE", "write the YAML there (default: print it)")
    info = add_action(actions, "info", "check a bank's checksums and print its definition", _info)
    add_option(info, "path", Path, "PATH", "the bank file")
    add_json(info)
    solve = add_action(actions, "solve", "solve for the voltages of one conductivity", _solve)
    add_option(solve, "--mesh", Path, "FILE", "a mesh (.npz, EIDORS .mat) or a fingertip (.yaml)", required=True)
    solve.add_argument("--model", required=True, metavar="M", help=f"basis model: {MODEL_NAMES}")
    add_option(solve, "--k", float, "K", "the model's first parameter", required=True)
    add_option(solve, "--sigma", float, "S", "the model's second parameter", required=True)
    add_option(
        solve,
        "--out",
        output_path,
        "V.npy",
        "file for the float64 voltages, in the order of the channels",
        required=True,
    )
    add_json(solve)


def _build(args: argparse.Namespace) -> int:
    from shearloop.bank.bank_file import BANK_MAGIC, Bank
    from shearloop.bank.build import build_bank, solve_row
    from shearloop.tools.bank_config import load_bank_plan
    from shearloop.tools.parallel import open_executor

    jobs = args.jobs or processors()
    plan = load_bank_plan(args.config)
    check_overwrite(args.out, "a bank", BANK_MAGIC)
    rows = len(plan.definition.k_grid)
    with open_executor(args.cluster, jobs) as pool, progress_bar(args.out.name, rows, "row") as show:
        build_bank(
            *plan,
            args.out,
            jobs=jobs,
            elsewhere=None if args.cluster is None else pool.map(solve_row, plan, range(rows)),
            on_row=show,
        )
    result = _result(args.out, Bank.open(args.out))
    line = f"{args.out}: {result['valid_cells']} of {result['cells']} cells valid, identity {result['identity'][:12]}"
    return print_result(result, [line], as_json=args.json)


def _result(path: Path, bank: "Bank") -> dict[str, Any]:
    return {
        "path": str(path),
        "identity": bank.identity,
        "model": bank.model,
        "shape": list(bank.signals.shape),
        "valid_cells": int(bank.valid.sum()),
        "cells": bank.valid.size,
        "bytes": path.stat().st_size,
    }


def _design(args: argparse.Namespace) -> int:
    from shearloop.tools.bank_design import design_yaml, designed_for, doubts, scene_of_recording

    if args.out is not None:
        check_overwrite(args.out, "a configuration", YAML_KEYS)
    if args.recording.is_dir():
        from shearloop.studies.slices.scene import scene_of_folder

        scene = scene_of_folder(args.recording, args.side)
    else:
        scene = scene_of_recording(args.recording, args.side)
    fingertip, design = designed_for(scene, args.fingertip)
    text = design_yaml(design, fingertip, args.recording)
    for sentence in doubts(design):
        print(f"shearloop bank: {sentence}", file=sys.stderr)
    if args.out is None:
        print(text, end="")
        return 0
    with writing(args.out, "the design"):
        args.out.write_text(text, encoding="utf-8")
    print(f"Build it: shearloop bank build --config {shlex.quote(str(args.out))} --out FILE", file=sys.stderr)
    return 0


def _info(args: argparse.Namespace) -> int:
    import numpy as np

    from shearloop.bank.bank_file import FORMAT_VERSION, Bank
    from shearloop.bank.models import MODELS

    bank = Bank.open(args.path)
    model = MODELS[bank.model]
    grids = ("k", bank.k_grid, model.k_unit), ("sigma", bank.sigma_grid, model.sigma_unit)
    facts: dict[str, object] = {
        **_result(args.path, bank),
        "format_version": FORMAT_VERSION,
        "geometry_hash": bank.geometry_hash,
        "channels": bank.table.n_channels,
        "channel_table_hash": bank.table.digest,
        "signals_sha256": bank.signals_sha256,
        **{name: {"low": grid[0], "high": grid[-1], "count": len(grid), "unit": unit} for name, grid, unit in grids},
        "not_positive_cells": int((bank.min_conductivity <= 0).sum()),
        "homogeneous_norm": float(np.linalg.norm(bank.homogeneous)),
    }
    lines = [f"{name.replace('_', ' '):<20}{_text(value)}" for name, value in facts.items()]
    return print_result(facts, [*lines, "all checksums agree"], as_json=args.json)


def _text(value: object) -> str:
    if isinstance(value, dict):
        return f"{value['count']} values from {value['low']:g} to {value['high']:g} ({value['unit']})"
    if isinstance(value, list):
        return " × ".join(map(str, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _solve(args: argparse.Namespace) -> int:
    import numpy as np

    from shearloop.bank.errors import ConductivityError
    from shearloop.bank.forward import ForwardModel
    from shearloop.bank.models import conductivity
    from shearloop.files import replace_file
    from shearloop.tools.bank_config import load_geometry

    check_overwrite(args.out, "an array of NumPy", np.lib.format.MAGIC_PREFIX)
    mesh, table = load_geometry(args.mesh)
    try:
        voltages = ForwardModel(mesh, table).voltages(conductivity(mesh, args.model, args.k, args.sigma))
    except ConductivityError as error:
        raise UserError(f"--model {args.model} --k {args.k:g} --sigma {args.sigma:g}: {error}") from error
    with writing(args.out, "the voltages"), replace_file(args.out) as file:
        np.save(file, voltages)
    norm = float(np.linalg.norm(voltages))
    result = {"path": str(args.out), "voltages": len(voltages), "norm": norm}
    return print_result(result, [f"{args.out}: {len(voltages)} voltages, norm {norm:.9g}"], as_json=args.json)
