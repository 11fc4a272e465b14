"""`shearloop ports`: list the serial ports with their serial numbers."""

import argparse


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `ports`."""
    parser.add_argument("--json", action="store_true", help="print them as JSON")
    parser.epilog = "Shows for each port the `device` for the configuration, which is found in any socket."


def run(args: argparse.Namespace) -> int:
    """List the ports without opening them."""
    import json
    from dataclasses import asdict

    from shearloop.daemon.serial_ports import list_serial_ports

    ports = list_serial_ports()
    if args.json:
        print(json.dumps([{**asdict(port), "named_by": port.named_by} for port in ports], ensure_ascii=False))
        return 0
    if not ports:
        print("there is no serial port: plug a board in, then look at `sudo dmesg | tail`")
    for port in ports:
        print(port.path, port.usb, port.likely or port.description, sep="  ")
        print(f"    device: {port.named_by}")
        if not port.serial_number:
            print("    it has no serial number: leave it in the same socket")
        if port.error:
            print(f"    {port.error}")
    return 0
