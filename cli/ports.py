"""`shearloop ports`: list the serial ports with their serial numbers."""

import argparse
from dataclasses import asdict

from shearloop.cli.terminal import print_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `ports`."""
    parser.add_argument("--json", action="store_true", help="print them as JSON")
    parser.epilog = "Shows for each port the `device` for the configuration, which is found in any socket."


def run(args: argparse.Namespace) -> int:
    """List the ports without opening them."""
    from shearloop.tools.serial_ports import list_serial_ports

    ports = list_serial_ports()
    sentences = [] if ports else ["there is no serial port: plug a board in, then look at `sudo dmesg | tail`"]
    for port in ports:
        sentences += [f"{port.path}  {port.usb}  {port.likely or port.description}", f"    device: {port.named_by}"]
        sentences += [] if port.serial_number else ["    it has no serial number: leave it in the same socket"]
        sentences += [f"    {port.error}"] if port.error else []
    result = [{**asdict(port), "named_by": port.named_by} for port in ports]
    return print_result(result, sentences, as_json=args.json)
