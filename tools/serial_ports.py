"""The serial ports, their USB serial numbers, and whether the user may open them."""

import getpass
import grp
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

# USB vendor numbers, as in systemd/60-shearloop.rules.
BOARDS = {
    0x16C0: "EIT-kit (Teensy)",
    0x2341: "load cell (Arduino)",
    0x2A03: "load cell (Arduino)",
    0x1A86: "load cell (CH340)",
    0x0403: "gripper's Modbus adapter (FTDI)",
}
# The links of systemd/60-shearloop.rules: by serial number, or by socket.
OWN_LINKS = Path("/dev/shearloop")
UDEV_LINKS = {name: Path("/dev/serial", name) for name in ("by-id", "by-path")}
# Groups that distributions and our rules give serial ports to. Others, as root or tty, open far more than ports.
PORT_GROUPS = ("dialout", "uucp", "plugdev", "shearloop")
USB_DEVICES, PROCESSES = Path("/sys/bus/usb/devices"), Path("/proc")
UDEV_RULES = tuple(Path(root, "udev/rules.d") for root in ("/etc", "/run", "/usr/lib", "/lib"))


@dataclass(frozen=True, slots=True)
class SerialPortInfo:
    """One port. Unknown texts are empty; `error` says why the user may not open it."""

    path: str
    serial_number: str
    usb: str
    description: str
    likely: str
    stable_name: str
    error: str

    @property
    def named_by(self) -> str:
        """The `device` that a configuration names it by."""
        if self.serial_number:
            return f'{{serial_number: "{self.serial_number}"}}'
        return f"{{path: {self.stable_name or self.path}}}"


def list_serial_ports() -> list[SerialPortInfo]:
    """Return all USB ports and other ports with a driver."""
    from serial.tools import list_ports

    # Every computer lists several ttyS, mostly without a plug.
    ports = [port for port in sorted(list_ports.comports()) if port.vid is not None or "ttyS" not in port.device]
    return [
        SerialPortInfo(
            path=port.device,
            serial_number=port.serial_number or "",
            usb="" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            description=port.description if port.description != "n/a" else "",
            likely=BOARDS.get(port.vid or 0, ""),
            stable_name=stable_name_of(port.device, port.serial_number),
            error=access_error(port.device),
        )
        for port in ports
    ]


def access_error(path: str) -> str:
    """Return why this user may not open a port, and the cure; empty if allowed."""
    if os.access(path, os.R_OK | os.W_OK):
        return ""
    try:
        status = os.stat(path)
    except OSError as error:
        return f"it cannot be opened ({error.strerror}); unplug the board and plug it in again"
    try:
        group = grp.getgrgid(status.st_gid)
    except KeyError:
        return access_cure(str(status.st_gid), status.st_mode, joined=False)
    return access_cure(group.gr_name, status.st_mode, joined=getpass.getuser() in group.gr_mem)


def access_cure(group: str, mode: int, *, joined: bool) -> str:
    """Return why a port of this group and mode may not be opened, and the cure; `joined`: the user is in the group."""
    if group not in PORT_GROUPS or mode & 0o060 != 0o060:
        return (
            f"you may not open it (group {group}, mode {mode & 0o777:o}); `sudo shearloop install` gives the boards to "
            "the group shearloop, which you join with `sudo usermod -aG shearloop $USER`; then log in again"
        )
    if joined:
        return f"you joined the group {group} after this login; log out and in again"
    return f"you may not open it; `sudo usermod -aG {group} $USER`, then log in again"


@dataclass(frozen=True, slots=True)
class HiddenBoard:
    """A USB board without a serial port: its numbers, as 1a86:7523, and its likely kind."""

    usb: str
    likely: str


def list_hidden_boards(devices: Path = USB_DEVICES) -> list[HiddenBoard]:
    """Return the boards on the USB bus without a serial port."""
    found = []
    for device in sorted(devices.iterdir()) if devices.is_dir() else []:
        try:
            vendor, product = ((device / name).read_text().strip() for name in ("idVendor", "idProduct"))
        except OSError:
            # An interface, or a device that has just gone.
            continue
        likely = BOARDS.get(int(vendor, 16), "")
        if likely and not any(device.glob("*/tty*")):
            found.append(HiddenBoard(f"{vendor}:{product}", likely))
    return found


def has_brltty(processes: Path = PROCESSES, rules: Sequence[Path] = UDEV_RULES) -> bool:
    """Return whether brltty runs, or udev starts it for boards that are plugged in."""
    if any(list(folder.glob("*brltty*.rules")) for folder in rules):
        return True
    for comm in processes.glob("[0-9]*/comm"):
        try:
            if comm.read_text().startswith("brltty"):
                return True
        except OSError:
            continue
    return False


def stable_name_of(device: str, serial_number: str | None) -> str:
    """Return a link that survives swapped cables: ours, or udev's; empty without one.

    Two boards without a serial number can have the same name by identity; by socket they differ.
    """
    folders = [OWN_LINKS, UDEV_LINKS["by-path"]]
    if serial_number:
        folders.insert(1, UDEV_LINKS["by-id"])
    links = [link for folder in folders if folder.is_dir() for link in sorted(folder.iterdir())]
    for link in (OWN_LINKS / (serial_number or "-"), *links):
        if link.exists() and os.path.realpath(link) == os.path.realpath(device):
            return str(link)
    return ""
