"""What the configuration names: banks, calibrations, the robot's settings, the experiment, keys."""

from collections.abc import Iterator
from pathlib import Path

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH, N_CHANNELS
from shearloop.bank.errors import BankError
from shearloop.daemon.config import CombinedConfig, CurveConfig, DaemonConfig, FingertipConfig
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.doctor.finding import Finding, from_file, from_sentence, good, note, trouble
from shearloop.daemon.errors import UserError
from shearloop.daemon.sensing.opening import on_word, open_both, open_estimator
from shearloop.daemon.sensing.tracking import TrackedEstimator
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import read_settings


def examine_files(config: DaemonConfig, geometry: Path | None) -> Iterator[Finding]:
    """Examine every file; `geometry` is the fingertip's own (YAML or mesh), to hold the banks against."""
    for name, fingertip in config.fingertips.items():
        yield bank_finding(name, fingertip, geometry)
        yield calibration_finding(name, fingertip)
    if config.both is not None:
        yield both_finding(config.both, config.fingertips)
    if config.skin is not None:
        yield _skin_finding(config.skin.calibration)
    if config.robot is not None:
        yield _settings_finding(config.robot)
    if config.experiment is not None:
        yield _experiment_finding(config.experiment)
    yield keys_finding(config.curve, config.network_addresses)


def bank_finding(name: str, fingertip: FingertipConfig, geometry: Path | None = None) -> Finding:
    """Hold a bank against its own checksums, the channel table, and the fingertip's geometry where that is given."""
    subject = f"bank of {name}"
    if fingertip.bank is None:
        return note(subject, "none is configured", "there are no heatmaps, no k and no sigma", "add `bank:` for them")
    try:
        bank = Bank.open(fingertip.bank, verify=True)
    except BankError as error:
        return from_sentence(subject, str(error), "no frame can be matched")
    found = (
        f"{fingertip.bank} is whole, {int(bank.valid.sum())} of {bank.valid.size} cells valid, of the channel table "
        f"{CHANNEL_TABLE_HASH[:12]} with {N_CHANNELS} channels, solved on the geometry {bank.geometry_hash[:12]}"
    )
    if geometry is None:
        return good(subject, found)
    from shearloop.daemon.bank_config import load_geometry

    try:
        digest = load_geometry(geometry).digest
    except (UserError, BankError) as error:
        return from_sentence(subject, str(error), "the bank cannot be held against it")
    if digest != bank.geometry_hash:
        return trouble(
            subject,
            f"{found}; {geometry} is {digest[:12]}",
            "the bank is of another fingertip, or of another mesh of this one; estimates will be wrong",
            "build it anew with `shearloop bank build`, or give the geometry that it was built from",
        )
    return good(subject, f"{found}, which is {geometry}")


def calibration_finding(name: str, fingertip: FingertipConfig) -> Finding:
    """Say whether the calibration is there and of this bank."""
    subject = f"calibration of {name}"
    if fingertip.calibration is None:
        return note(
            subject, "none is configured", "k and sigma are published, but no torque", "see docs/first-calibration.md"
        )
    try:
        estimator = open_estimator(fingertip, name)
    except (UserError, BankError) as error:
        return from_sentence(subject, str(error), "there is no torque")
    if isinstance(estimator, TrackedEstimator):
        found = f"{fingertip.calibration} is of the estimator {estimator.name} and this fingertip"
        return good(subject, found + on_word(estimator))
    return good(subject, f"{fingertip.calibration} belongs to this bank")


def both_finding(both: CombinedConfig, fingertips: dict[str, FingertipConfig]) -> Finding:
    """Say whether the calibration of several fingertips together is there and of these."""
    try:
        estimator = open_both(both, fingertips)
    except (UserError, BankError) as error:
        return from_sentence("calibration of both", str(error), "there is no estimate of both together")
    found = f"{both.calibration} is of {' and '.join(estimator.sides)}, {estimator.name}"
    return good("calibration of both", found + on_word(estimator))


def keys_finding(curve: CurveConfig | None, network: dict[str, str]) -> Finding:
    """Say who may connect from the network, and whether a secret key is one."""
    from shearloop.daemon.messaging.keys import admitted_clients, load_server_keys, server_key_file

    if curve is None:
        return good("keys", "none are needed: every address is of this machine alone")
    try:
        load_server_keys(curve.server_key)
        clients = admitted_clients(curve.clients)
    except UserError as error:
        return from_sentence("keys", str(error), "the daemon will not start")
    path = server_key_file(curve.server_key)
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        return trouble(
            "keys",
            f"{path} can be read by others (mode {mode:o})",
            "whoever read it can pose as the daemon",
            f"`chmod 600 {path}`; make new keys if somebody may have read it",
        )
    if not network:
        return note(
            "keys",
            "there are keys, but every address is of this machine alone",
            "nobody else can connect",
            "set `publish` and `commands` to tcp://0.0.0.0:PORT if others are to connect",
        )
    return good("keys", f"{', '.join(sorted(clients.values()))} may connect to {' and '.join(network.values())}")


def _skin_finding(path: Path) -> Finding:
    from shearloop.bank.skin.calibration_file import load_calibration

    try:
        calibration = load_calibration(path)
    except BankError as error:
        return from_sentence("calibration of the skin", str(error), "there is no shear force")
    return good("calibration of the skin", f"{path}, ± {calibration.prediction_half_width_n:.3f} N")


def _settings_finding(path: Path) -> Finding:
    try:
        host = read_settings(path).host
    except DriverError as error:
        return from_file("robot's settings", str(error), "the daemon will not start")
    return good("robot's settings", f"{path} are in order; the robot is {host}")


def _experiment_finding(path: Path) -> Finding:
    try:
        experiment = load_yaml_model(path, ExperimentFile)
    except UserError as error:
        return from_file("experiment", str(error), "it cannot be started")
    return good("experiment", f"{path}: {experiment.name}, {len(experiment.steps)} steps, driven by {experiment.drive}")
