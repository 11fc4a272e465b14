"""The serial ports, their USB serial numbers, and whether the user may open them."""

import os
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
BY_SERIAL = Path("/dev/shearloop")


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
            stable_name=_stable_name(port.device, port.serial_number),
            error=access_error(port.device),
        )
        for port in ports
    ]


def access_error(path: str) -> str:
    """Return why this user may not open a port, and the cure; empty if allowed."""
    if os.access(path, os.R_OK | os.W_OK):
        return ""
    try:
        group = Path(path).group()
    except (OSError, KeyError):
        group = "dialout"
    return f"you may not open it; `sudo usermod -aG {group} $USER`, then log in again"


def _stable_name(device: str, serial_number: str | None) -> str:
    """Return a link that survives swapped cables: ours by serial number, or udev's; empty without one."""
    folders = (Path("/dev/serial/by-id"), Path("/dev/serial/by-path"))
    links = [link for folder in folders if folder.is_dir() for link in sorted(folder.iterdir())]
    for link in (BY_SERIAL / (serial_number or "-"), *links):
        if link.exists() and os.path.realpath(link) == os.path.realpath(device):
            return str(link)
    return ""
