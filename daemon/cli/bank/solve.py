"""`shearloop bank solve`: the 896 voltages of one conductivity."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.bank.build import MODELS


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "--mesh", type=Path, required=True, metavar="FILE", help="a mesh (.npz, EIDORS .mat) or a fingertip (.yaml)"
    )
    parser.add_argument("--model", required=True, metavar="M", help=f"basis model: {MODELS}")
    parser.add_argument("--k", type=float, required=True, metavar="K", help="the model's first parameter")
    parser.add_argument("--sigma", type=float, required=True, metavar="S", help="the model's second parameter")
    parser.add_argument("--out", type=Path, required=True, metavar="V.npy", help="file for the 896 float64 voltages")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    """Solve, and write the voltages only when there is a solution."""
    import json

    import numpy as np

    from shearloop.bank.eit.forward import ForwardModel
    from shearloop.bank.eit.models import conductivity
    from shearloop.bank.errors import ConductivityError
    from shearloop.daemon.bank_config import load_geometry
    from shearloop.daemon.cli.options import check_overwrite
    from shearloop.daemon.errors import UserError
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
    if args.json:
        print(json.dumps({"path": str(args.out), "voltages": len(voltages), "norm": norm}))
    else:
        print(f"{args.out}: 896 voltages, norm {norm:.9g}")
    return 0
