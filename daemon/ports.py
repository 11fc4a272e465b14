"""The serial ports of this computer: what is plugged in, under which serial number, and whether it may be opened."""

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

# USB vendor numbers, as in systemd/60-shearloop.rules.
BOARDS = {
    0x16C0: "EIT-kit (Teensy)",
    0x2341: "load cell (Arduino)",
    0x2A03: "load cell (Arduino)",
    0x1A86: "load cell (CH340)",
    0x0403: "gripper's Modbus adapter (FTDI)",
}
BY_SERIAL = Path("/dev/shearloop")


@dataclass(frozen=True, slots=True)
class PortThere:
    """One port; empty texts where the system tells nothing."""

    path: str
    serial_number: str
    usb: str
    description: str
    likely: str
    stable_name: str
    trouble: str

    @property
    def named_by(self) -> str:
        """What a configuration names it by."""
        if self.serial_number:
            return f'{{serial_number: "{self.serial_number}"}}'
        return f"{{path: {self.stable_name or self.path}}}"


def ports_there() -> list[PortThere]:
    """Return the ports that are there: those on USB, and others that a driver stands behind."""
    found = []
    for port in sorted(list_ports.comports()):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else ""
        if not usb and "ttyS" in port.device:
            # Every computer lists a row of these, mostly without a plug.
            continue
        found.append(
            PortThere(
                path=port.device,
                serial_number=port.serial_number or "",
                usb=usb,
                description=port.description if port.description != "n/a" else "",
                likely=BOARDS.get(port.vid or 0, ""),
                stable_name=_stable_name(port.device, port.serial_number),
                trouble=access_trouble(port.device),
            )
        )
    return found


def access_trouble(path: str) -> str:
    """Return why this user may not open a port, and the cure; empty where nothing stands against it."""
    if os.access(path, os.R_OK | os.W_OK):
        return ""
    try:
        group = Path(path).group()
    except (OSError, KeyError):
        group = "dialout"
    return f"you may not open it; `sudo usermod -aG {group} $USER`, then log in anew"


def _stable_name(device: str, serial_number: str | None) -> str:
    """Return a name that stays when cables are swapped: udev's own, or ours by serial number."""
    ours = BY_SERIAL / (serial_number or "-")
    folders = (Path("/dev/serial/by-id"), Path("/dev/serial/by-path"))
    candidates = [ours, *(link for folder in folders if folder.is_dir() for link in sorted(folder.iterdir()))]
    for link in candidates:
        if link.exists() and os.path.realpath(link) == os.path.realpath(device):
            return str(link)
    return ""
