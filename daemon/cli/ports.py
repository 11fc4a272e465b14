"""`shearloop ports`: the serial ports of this computer, with the serial numbers that a configuration names them by."""

import argparse


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `ports`."""
    parser.add_argument("--json", action="store_true", help="print them as JSON")
    parser.epilog = "Says of each what to write as `device` in the configuration, so that it is found in any socket."


def run(args: argparse.Namespace) -> int:
    """List the ports; none is opened."""
    import json
    from dataclasses import asdict

    from shearloop.daemon.ports import ports_there

    ports = ports_there()
    if args.json:
        print(json.dumps([{**asdict(port), "named_by": port.named_by} for port in ports], ensure_ascii=False))
        return 0
    if not ports:
        print("no serial port is there: plug a board in; `sudo dmesg | tail` tells whether the system has noticed it")
    for port in ports:
        print(port.path, port.usb, port.likely or port.description, sep="  ")
        print(f"    device: {port.named_by}")
        if not port.serial_number:
            print("    it has no serial number of its own: named like this, it must stay in the same socket")
        if port.trouble:
            print(f"    {port.trouble}")
    return 0
