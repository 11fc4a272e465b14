"""`shearloop bank info`: check a bank's checksums and say what it is of."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("path", type=Path, metavar="PATH", help="the bank file")
    parser.add_argument("--json", action="store_true", help="print it as JSON")


def run(args: argparse.Namespace) -> int:
    """Read the whole bank, compare its checksums, and print what it is of."""
    import numpy as np

    from shearloop.bank.eit.bank_file import FORMAT_VERSION, Bank
    from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH

    bank = Bank.open(args.path, verify=True)
    facts = {
        "path": str(args.path),
        "format_version": FORMAT_VERSION,
        "identity": bank.identity,
        "model": bank.model,
        "variation": asdict(bank.definition.variation),
        "geometry_hash": bank.geometry_hash,
        "channel_table_hash": CHANNEL_TABLE_HASH,
        "signals_sha256": bank.signals_sha256,
        "shape": list(bank.signals.shape),
        "k": {"low": bank.k_grid[0], "high": bank.k_grid[-1], "count": len(bank.k_grid), "unit": bank.k_unit},
        "sigma": {
            "low": bank.sigma_grid[0],
            "high": bank.sigma_grid[-1],
            "count": len(bank.sigma_grid),
            "unit": bank.sigma_unit,
        },
        "cells": bank.valid.size,
        "valid_cells": int(bank.valid.sum()),
        "not_positive_cells": int((bank.min_conductivity <= 0).sum()),
        "homogeneous_norm": float(np.linalg.norm(bank.homogeneous)),
        "bytes": args.path.stat().st_size,
    }
    print(json.dumps(facts) if args.json else _sentences(facts))
    return 0


def _sentences(facts: dict[str, object]) -> str:
    def shown(value: object) -> str:
        if isinstance(value, dict) and "count" not in value:
            return ", ".join(f"{name} {one:g}" for name, one in value.items())
        if isinstance(value, dict):
            return f"{value['count']} values from {value['low']:g} to {value['high']:g} ({value['unit']})"
        if isinstance(value, list):
            return " × ".join(map(str, value))
        return f"{value:.6g}" if isinstance(value, float) else str(value)

    lines = [f"{name.replace('_', ' '):<20}{shown(value)}" for name, value in facts.items()]
    return "\n".join([*lines, "all checksums agree"])
