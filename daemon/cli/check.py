"""`shearloop check`: say whether a configuration and the files it names are in order."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shearloop.daemon.config import CurveConfig, DaemonConfig, SkinConfig
    from shearloop.daemon.sensing.opening import AnyEstimator


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    parser.add_argument("config", type=Path, metavar="CONFIG", help="a YAML file such as config/demo.yaml")
    parser.add_argument("--json", action="store_true", help="print what it says as JSON")
    parser.epilog = "Opens no device: `shearloop doctor CONFIG` does, and listens to them."


def run(args: argparse.Namespace) -> int:
    """Load everything that `run` would load, and open no device."""
    import json

    from shearloop.daemon.cli.run import checked_emulators
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.rig_check import checked_experiment
    from shearloop.daemon.sensing.opening import open_both, open_estimator
    from shearloop.daemon.sensing.torque_sources import torque_sources

    config = load_daemon_config(args.config)
    checked_emulators(config.emulators, args.config)
    told = {}
    if config.curve is not None:
        told["keys"] = f"{_clients(config.curve)} may connect"
    estimators = {name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()}
    for name, fingertip in config.fingertips.items():
        grids = estimators[name].grids
        torque = _torque(estimators[name], calibrated=fingertip.calibration is not None)
        bank = "no bank" if grids is None else f"bank {fingertip.bank} of {grids[0].size} × {grids[1].size} cells"
        told[name] = f"{bank}, {torque}"
    both = open_both(config.both, config.fingertips) if config.both is not None else None
    if both is not None:
        told["both"] = f"{' and '.join(both.sides)} together, {_torque(both, calibrated=True)}"
    if config.skin is not None:
        told["skin"] = _skin(config.skin)
    told.update(_rig(config))
    experiment = checked_experiment(config, torque_sources(config, estimators, both))
    if experiment is not None:
        told["experiment"] = f"{experiment.name!r}, {len(experiment.steps)} steps, driven by {experiment.drive}"
    if args.json:
        print(json.dumps({"config": str(args.config), "told": told}, ensure_ascii=False))
        return 0
    for name, what in told.items():
        print(f"{name}: {what}")
    print(f"{args.config} is in order")
    return 0


def _torque(estimator: "AnyEstimator", *, calibrated: bool) -> str:
    from shearloop.daemon.sensing.opening import on_word

    if estimator.measures_torque:
        return f"with torque{on_word(estimator)}"
    why = "its calibration is of diameters alone" if calibrated else "no calibration is configured"
    return f"without torque: {why}"


def _rig(config: "DaemonConfig") -> dict[str, str]:
    """Return what is told of load cell, gripper and robot."""
    from shearloop.daemon.rig import gripper_calibration, load_cell_calibration
    from shearloop.drivers.ur.settings import read_settings

    told = {}
    if config.load_cell is not None:
        own = config.load_cell.calibration
        load_cell_calibration(config.load_cell)
        told["load_cell"] = "torques in N·m as the board sends them" if own is None else f"calibration {own}"
    if config.gripper is not None:
        own = config.gripper.calibration
        gripper_calibration(config.gripper)
        told["gripper"] = "widths by the maker's figures" if own is None else f"calibration {own}"
    if config.robot is not None:
        told["robot"] = f"{read_settings(config.robot).host}, limits of {config.robot}"
    return told


def _clients(curve: "CurveConfig") -> str:
    from shearloop.daemon.messaging.keys import admitted_clients, load_server_keys

    load_server_keys(curve.server_key)
    return ", ".join(sorted(admitted_clients(curve.clients).values()))


def _skin(config: "SkinConfig") -> str:
    """Return what is told of the skin: its calibration, and what its calibration cannot tell."""
    import math

    from shearloop.bank.skin.calibration_file import load_calibration
    from shearloop.daemon.sensing.skin_estimator import MAX_CHANGE
    from shearloop.daemon.sensing.skin_task import check_circuit

    calibration = load_calibration(config.calibration)
    check_circuit(config, calibration)
    radius = "without torque: no tool_radius_mm" if config.tool_radius_mm is None else "with torque"
    told = (
        f"calibration {config.calibration} to {calibration.tension_n[0]:+.1f} … {calibration.tension_n[-1]:+.1f} N, "
        f"± {calibration.prediction_half_width_n:.3f} N, {radius}"
    )
    if abs(math.log(calibration.rest_ohm[0] / calibration.rest_ohm[1])) < MAX_CHANGE:
        told += "; its gauges are too much alike at rest for swapped wires to be noticed: see the sign of a push"
    return told
