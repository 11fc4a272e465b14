"""`shearloop doctor`: checks the computer, files and devices, and names the next step for each fault."""

import asyncio
import ctypes
import os
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import BankError
from shearloop.daemon.config import CurveConfig, DaemonConfig, FingertipConfig, GripperConfig, load_daemon_config
from shearloop.daemon.motion_cap import knows_tool
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.rig import configured_settings, gripper_elsewhere
from shearloop.daemon.running_rig import EMULATED
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.library import missing_library
from shearloop.errors import UserError
from shearloop.tools.check import OPEN_KEYS, CheckEmulators, check_parts, why_not_recorded
from shearloop.tools.doctor.devices import (
    DAEMON_TIMEOUT_S,
    ask_status,
    check_daemon,
    check_devices,
    differing_keys,
    listen_for_frames,
)
from shearloop.tools.doctor.findings import Finding, from_error, from_file, good, note, trouble
from shearloop.tools.doctor.robot_values import check_example_addresses, check_robot_values
from shearloop.tools.running_daemon import whose_daemon
from shearloop.tools.serial_ports import HiddenBoard, has_brltty, list_hidden_boards, list_serial_ports
from shearloop.yaml_files import read_yaml

__all__ = ["Finding", "examine"]

# An hour of recording takes some 80 MB.
LOW_DISK_BYTES, NO_DISK_BYTES = 2e9, 2e8
# An earlier time means that the clock was never set.
FIRST_SANE_UNIX_S = 1_704_067_200
# adjtimex(2): the clock is not synchronised.
_TIME_ERROR = 5


class GivenGeometry(NamedTuple):
    """The file of a geometry, and the digest of its mesh."""

    path: Path
    digest: str

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the file; raises UserError or BankError for one that is no geometry."""
        from shearloop.tools.bank_config import load_geometry

        return cls(path, load_geometry(path).mesh.digest)


def examine(
    config_path: Path | None, seconds: float, check_emulators: CheckEmulators, geometry: Path | None = None
) -> Iterator[Finding]:
    """Yield one finding after another; listen to all devices at once for `seconds`.

    Raises UserError or BankError, before the first one, for a given file that is not YAML or no geometry.
    """
    if config_path is not None:
        read_yaml(config_path, UserError)
    own = None if geometry is None else GivenGeometry.read(geometry)
    yield from check_computer()
    yield from check_ports()
    if config_path is None:
        yield check_disk(Path())
        yield note("configuration", "not given", "files and devices were not checked", "`shearloop doctor CONFIG`")
        return
    try:
        config = load_daemon_config(config_path)
    except UserError as error:
        yield from_file("configuration", str(error), "the daemon does not start")
        return
    yield good("configuration", f"{config_path} is in order")
    if config.emulated:
        yield good(EMULATED, "every device of this configuration is emulated: nothing here is said of real ones")
    yield check_disk(Path()) if config.recording is None else check_recording(config.recording.folder)
    yield from check_files(config, config_path, check_emulators, own)
    if not config.emulated:
        yield from check_example_addresses(config)
    if config.robot is not None and not config.emulated:
        yield from check_robot_values(config.robot)
        yield from check_cap(config)
    if config.gripper is not None and not config.emulated:
        yield from check_gripper_address(config)
        yield from check_gripper_model(config, config.gripper)
    yield from check_daemon_and_devices(config, config_path, seconds)


def check_daemon_and_devices(config: DaemonConfig, config_path: Path, seconds: float) -> Iterator[Finding]:
    """Examine the devices, through the daemon that has them if it is this configuration's."""
    reply = ask_status(config.commands)
    differing = differing_keys(config, reply) if reply else []
    if reply and not differing:
        holds = f"answers at {config.commands}: {whose_daemon(reply)}; it holds the devices and reports on them"
        yield good("daemon", holds)
        received = {} if "publish" in config.network_addresses else listen_for_frames(config.publish, seconds)
        yield from check_daemon(config, reply.get("tasks", {}), received)
        return
    if reply is None:
        yield good("daemon", "not running with this configuration: the devices are free")
    elif reply.get("ok") is False:
        what, _, cure = str(reply.get("reason")).partition(": ")
        yield trouble("daemon", what, "no daemon starts meanwhile, and the robot may move", cure)
        return
    elif not reply:
        found = f"a daemon has the address {config.commands} and does not answer within {DAEMON_TIMEOUT_S:g} s"
        means = "it hangs, or the computer is too busy; it may be this configuration's, and have the devices"
        yield trouble("daemon", found, means, "look at its log; end it, then run the doctor again")
    else:
        keys = ", ".join(f"`{key}`" for key in differing)
        means = f"this configuration's daemon cannot start while it runs; the two differ in {keys}"
        cure = (
            "end it, or restart it if the file has changed since its start; to run both, give one of them other "
            "values of `publish` and `commands`"
        )
        found = f"a daemon of another configuration answers at {config.commands}: {whose_daemon(reply)}"
        yield trouble("daemon", found, means, cure)
    if config.emulators:
        means = "they exist only while the daemon runs"
        cure = f"`shearloop run {shlex.quote(str(config_path))}`, then run the doctor again"
        yield note("devices", "the configuration emulates them", means, cure)
    else:
        yield from asyncio.run(check_devices(config, seconds))


def check_computer() -> Iterator[Finding]:
    """Check the clock and the robot's library."""
    yield check_clock(time.time(), clock_state())
    version = ".".join(map(str, sys.version_info[:2]))
    if reason := missing_library():
        cause, _, cure = reason.partition(": ")
        yield note("robot's library", cause, "everything but the robot works", cure)
    else:
        yield good("robot's library", f"ur-rtde is installed, Python {version}")


def clock_state() -> int:
    """Return adjtimex(2)'s answer: 5 when the clock is not synchronised, -1 when it cannot be asked."""
    # struct timex takes 208 bytes on 64-bit Linux; `modes` 0 changes nothing.
    try:
        return int(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512)))
    except (OSError, AttributeError):
        return -1


def check_clock(unix_s: float, state: int) -> Finding:
    """Check the system clock's time and adjtimex's answer."""
    today = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(unix_s))
    if unix_s < FIRST_SANE_UNIX_S:
        cure = "set it: `sudo timedatectl set-ntp true`"
        return trouble("clock", f"it says {today}", "recordings and messages carry a wrong time", cure)
    if state == _TIME_ERROR:
        means = "times in messages and recordings drift against other computers; the loop uses another clock"
        cure = "`sudo timedatectl set-ntp true`, if the network allows it"
        return note("clock", f"it says {today} and is not synchronised", means, cure)
    return good("clock", f"it says {today}" + (" and is synchronised" if state >= 0 else ""))


def check_disk(folder: Path) -> Finding:
    """Check the space for recordings in a folder, or in its nearest existing parent."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(existing).free
    found = f"{free / 1e9:.1f} GB are free in {existing}"
    if not os.access(existing, os.W_OK):
        return note("disk", f"you may not write in {existing}", "recordings fail there", "choose another folder")
    if free < NO_DISK_BYTES:
        return trouble("disk", found, "recordings fail and experiments do not start", "free some space")
    if free < LOW_DISK_BYTES:
        return note("disk", found, "enough for a day of recordings at most", "free some space before a long experiment")
    return good("disk", found)


def check_recording(folder: Path) -> Finding:
    """Check that the daemon can record in a folder, and that its disk has space."""
    if reason := why_not_recorded(folder):
        return trouble("disk", reason.cause, "the daemon does not start", reason.cure)
    return check_disk(folder)


def check_ports() -> Iterator[Finding]:
    """List the USB serial ports with their serial numbers, and the boards that have none."""
    ports, hidden = list_serial_ports(), list_hidden_boards()
    yield from map(_explain_hidden, hidden)
    if not ports:
        if not hidden:
            means = "no board is plugged in, or the system has not noticed it"
            yield note("USB serial ports", "none", means, "plug the boards in; look at `sudo dmesg | tail`")
        return
    shown = ", ".join(f"{port.path} ({port.serial_number or 'without a serial number'})" for port in ports)
    denied = "; ".join(f"{port.path}: {port.error}" for port in ports if port.error)
    if denied:
        yield note("USB serial ports", shown, denied, "see `shearloop ports`")
    else:
        yield good("USB serial ports", shown)


def _explain_hidden(board: HiddenBoard) -> Finding:
    subject = f"USB {board.usb}"
    found = f"likely the {board.likely}; it is plugged in and has no serial port"
    if has_brltty():
        means = "brltty, which serves Braille displays, takes boards with such a converter"
        cure = "`sudo apt remove brltty` if this computer needs no Braille display; then plug the board in again"
        return trouble(subject, found, means, cure)
    means = "the kernel's driver for it is missing, or another program has taken the board"
    modules = "`sudo apt install linux-modules-extra-$(uname -r)`"
    cure = f"look at `sudo dmesg | tail`; on Ubuntu {modules}, then plug it in again"
    return trouble(subject, found, means, cure)


def check_files(
    config: DaemonConfig, path: Path, check_emulators: CheckEmulators, geometry: GivenGeometry | None
) -> Iterator[Finding]:
    """Check every file of the configuration in `path`; `geometry` is the fingertip that its bank must match."""
    banks = [check_bank(name, fingertip, geometry) for name, fingertip in config.fingertips.items()]
    yield from banks
    parts = check_parts(config, path, check_emulators)
    for name, text in parts.texts.items():
        if name != "keys":
            yield good(f"files of {name}", text)
    # Other findings name these.
    elsewhere = ("keys", "recording", OPEN_KEYS)
    for name, mistake in parts.mistakes.items():
        kind = from_file if "\n" in mistake else from_error
        finding = kind(f"files of {name}", mistake, "the daemon does not start")
        if name not in elsewhere and finding.found not in [bank.found for bank in banks]:
            yield finding
    yield check_keys(config.curve, config.network_addresses)


def check_cap(config: DaemonConfig) -> Iterator[Finding]:
    """Say which cap holds for the robot, and why."""
    try:
        settings = configured_settings(config)
        commissioning = commissioning_of(config, settings) if settings is not None else None
    except (DriverError, UserError):
        # The mistakes are among the findings on files.
        return
    if commissioning is None or commissioning.cap is None:
        return
    if commissioning.counts:
        yield good("commissioning", commissioning.sentence)
    else:
        cap = commissioning.cap
        yield note("commissioning", cap.cause, "an experiment that asks for more is refused", cap.cure)


def check_gripper_address(config: DaemonConfig) -> Iterator[Finding]:
    """Name a gripper whose socket is not at its robot's address."""
    try:
        settings = configured_settings(config)
    except (DriverError, UserError):
        # The mistakes are among the findings on files.
        return
    if settings is not None and (elsewhere := gripper_elsewhere(config, settings)) is not None:
        yield trouble("gripper's address", elsewhere.cause, "the daemon does not start", elsewhere.cure)


def check_gripper_model(config: DaemonConfig, gripper: GripperConfig) -> Iterator[Finding]:
    """Name a model that no measurement confirms: measured widths of another model are refused."""
    try:
        settings = configured_settings(config)
        commissioning = commissioning_of(config, settings) if settings is not None else None
    except (DriverError, UserError):
        commissioning = None
    if not knows_tool(None, config, commissioning):
        found = f"a {gripper.model}, by the configuration alone"
        means = "of another model every width and every force is wrong, and no gripper says which model it is"
        yield note("gripper's model", found, means, "compare its type plate, or run `shearloop calibrate gripper`")


def check_bank(name: str, fingertip: FingertipConfig, geometry: GivenGeometry | None = None) -> Finding:
    """Check a bank's checksums and channel table, and its geometry if one is given."""
    subject = f"bank of {name}"
    if fingertip.bank is None:
        return note(subject, "not configured", "there are no heatmaps, no k and no sigma", "add `bank:` to get them")
    try:
        bank = Bank.open(fingertip.bank)
    except BankError as error:
        return from_error(subject, error, "no frame can be matched, and the daemon does not start")
    found = (
        f"{fingertip.bank} is intact, {int(bank.valid.sum())} of {bank.valid.size} cells valid, channel table "
        f"{bank.table.digest[:12]} with {bank.table.n_channels} channels, geometry {bank.geometry_hash[:12]}"
    )
    if geometry is None:
        return good(subject, found)
    if geometry.digest != bank.geometry_hash:
        means = "the bank belongs to another fingertip or another mesh; estimates are wrong"
        cure = "build it again with `shearloop bank build`, or give the geometry it was built from"
        return trouble(subject, f"{found}; {geometry.path} is {geometry.digest[:12]}", means, cure)
    return good(subject, f"{found}, which is {geometry.path}")


def check_keys(curve: CurveConfig | None, network: dict[str, str]) -> Finding:
    """Say who may connect from the network, and check that the secret key is secret."""
    from shearloop.daemon.messaging.keys import check_allowed_clients, load_server_keys, server_key_file

    if curve is None:
        return good("keys", "not needed: every address is on this computer")
    try:
        load_server_keys(curve.server_key)
        clients = check_allowed_clients(curve.clients)
    except UserError as error:
        return from_error("keys", error, "the daemon does not start")
    path = server_key_file(curve.server_key)
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        means = "a reader of this key can pose as the daemon"
        cure = f"`chmod 600 {shlex.quote(str(path))}`; make new keys if another user may have read it"
        return trouble("keys", f"others can read {path} (mode {mode:o})", means, cure)
    if clients.unusable:
        means = "its client cannot connect; the others can"
        return note("keys", "; ".join(clients.unusable), means, f"remove it from {curve.clients}")
    if not network:
        means = "no other computer can connect"
        cure = "set `publish` and `commands` to tcp://0.0.0.0:PORT to let others connect"
        return note("keys", "there are keys, but every address is on this computer", means, cure)
    return good("keys", f"{', '.join(sorted(clients.names.values()))} may connect to {' and '.join(network.values())}")
