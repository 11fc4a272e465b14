"""The daemon's configuration for the emulated rig, as the benches that run both have it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

# What supervises the torques is out of the way: two estimates that differ are no fault here.
_LOOP = {"disagreement_nm": 1.0, "jump_nm": 1.0}


def write_configuration(
    folder: Path,
    bank: Path,
    calibration: Path | None,
    host: str,
    *,
    robot: Mapping[str, Any] | None = None,
    fingertip: Mapping[str, Any] | None = None,
    load_cell: Mapping[str, Any] | None = None,
    loop: Mapping[str, Any] | None = None,
) -> Path:
    """Write what runs the rig that is played in a folder and at a host, and return its path.

    One fingertip, the load cell, the shipped robot's settings and the gripper; what is given besides is added to them.
    """
    shipped = yaml.safe_load(Path("config/ur.yaml").read_text())
    (folder / "ur.yaml").write_text(yaml.safe_dump({**shipped, "host": host, **(robot or {})}))
    content = {
        "publish": f"ipc://{folder}/publish",
        "commands": f"ipc://{folder}/commands",
        "fingertips": {
            "right": {
                "device": {"path": "eit-right"},
                "bank": str(bank.resolve()),
                "calibration": None if calibration is None else str(calibration.resolve()),
                "matching": "zero_lag",
                **(fingertip or {}),
            }
        },
        "load_cell": {"device": {"path": "load-cell"}, **(load_cell or {})},
        "robot": "ur.yaml",
        "gripper": {"socket": {"host": host}},
        "loop": {**_LOOP, **(loop or {})},
    }
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(content))
    return path
