"""`shearloop check`: check a configuration and the files it names."""

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.options import add_option
from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.config import CurveConfig, DaemonConfig, SkinConfig
    from shearloop.daemon.sensing.estimators import FrameEstimator


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    add_option(parser, "config", Path, "CONFIG", "a YAML file such as config/demo.yaml")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.epilog = "Opens no device; `shearloop doctor CONFIG` does."


def run(args: argparse.Namespace) -> int:
    """Load everything that `run` loads, without opening a device."""
    from shearloop.bank.errors import BankError
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.rig import read_experiment
    from shearloop.drivers.errors import DriverError

    config = load_daemon_config(args.config)
    try:
        parts = _parts(config, args.config)
    except (BankError, DriverError) as error:
        # A bank that is not built yet does not hide the mistakes of the experiment.
        try:
            if config.experiment is not None:
                read_experiment(config.experiment)
        except UserError as mistakes:
            raise UserError(f"{error}\n{mistakes}") from error
        raise
    if args.json:
        print(json.dumps({"config": str(args.config), "parts": parts}, ensure_ascii=False))
        return 0
    for name, text in parts.items():
        print(f"{name}: {text}")
    print(f"{args.config} is in order")
    return 0


def _parts(config: "DaemonConfig", path: Path) -> dict[str, str]:
    """Return a sentence on each part of the configuration in this file."""
    from shearloop.daemon.cli.emulated_devices import check_emulators
    from shearloop.daemon.rig import check_experiment
    from shearloop.daemon.sensing.estimators import open_combined, open_estimator, torque_sources

    check_emulators(config.emulators, path)
    parts = {}
    if config.curve is not None:
        parts["keys"] = f"{_clients(config.curve)} may connect"
    estimators = {name: open_estimator(fingertip, name) for name, fingertip in config.fingertips.items()}
    for name, fingertip in config.fingertips.items():
        grids = estimators[name].grids
        torque = _torque(estimators[name], calibrated=fingertip.calibration is not None)
        bank = "no bank" if grids is None else f"bank {fingertip.bank} of {grids[0].size} × {grids[1].size} cells"
        parts[name] = f"{bank}, {torque}"
    combined = open_combined(config.combined, config.fingertips) if config.combined is not None else None
    if combined is not None:
        parts["combined"] = f"{' and '.join(combined.calibration.sides)} together, {_torque(combined, calibrated=True)}"
    if config.skin is not None:
        parts["skin"] = _skin(config.skin)
    parts |= _rig(config)
    sources = torque_sources(config, estimators, combined)
    experiment = check_experiment(config, sources)
    if experiment is not None:
        steps = f"{len(experiment.steps)} steps, driven by {experiment.torque_source}"
        parts["experiment"] = f"{experiment.name!r}, {steps}"
        if warm_up_s := max((one.warm_up_s for one in sources.values() if one.measures_torque), default=0.0):
            parts["experiment"] += f"; after a grip it waits up to {warm_up_s:.0f} s for the first torques"
    return parts


def _torque(estimator: "FrameEstimator", *, calibrated: bool) -> str:
    if estimator.measures_torque:
        return f"with torque{estimator.assumptions}"
    reason = "its calibration has diameters only" if calibrated else "no calibration is configured"
    return f"without torque: {reason}"


def _rig(config: "DaemonConfig") -> dict[str, str]:
    from shearloop.daemon.rig import gripper_calibration, load_cell_calibration, robot_settings

    parts = {}
    if (cell := config.load_cell) is not None:
        load_cell_calibration(cell)
        parts["load_cell"] = f"calibration {cell.calibration}" if cell.calibration else "torques in N·m from the board"
    if (hand := config.gripper) is not None:
        gripper_calibration(hand)
        own = f"calibration {hand.calibration}" if hand.calibration else "widths by the manufacturer's figures"
        parts["gripper"] = own
    if config.robot is not None:
        parts["robot"] = f"{robot_settings(config.robot).host}, limits of {config.robot}"
    return parts


def _clients(curve: "CurveConfig") -> str:
    from shearloop.daemon.messaging.keys import check_allowed_clients, load_server_keys

    load_server_keys(curve.server_key)
    return ", ".join(sorted(check_allowed_clients(curve.clients).values()))


def _skin(config: "SkinConfig") -> str:
    from shearloop.bank.skin.calibration import load_calibration
    from shearloop.daemon.sensing.skin_estimator import MAX_CHANGE
    from shearloop.daemon.sensing.skin_task import check_circuit

    calibration = load_calibration(config.calibration)
    check_circuit(config, calibration)
    radius = "without torque: no tool_radius_mm" if config.tool_radius_mm is None else "with torque"
    text = (
        f"calibration {config.calibration} to {calibration.tension_n[0]:+.1f} … {calibration.tension_n[-1]:+.1f} N, "
        f"± {calibration.prediction_half_width_n:.3f} N, {radius}"
    )
    if abs(math.log(calibration.rest_ohm[0] / calibration.rest_ohm[1])) < MAX_CHANGE:
        text += "; its gauges are too similar at rest to detect swapped wires: check the sign of a push"
    return text
