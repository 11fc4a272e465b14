"""`shearloop command`: ask a running daemon to do something."""

import argparse
from pathlib import Path

from daemon.addresses import COMMAND_ADDRESS, needs_keys, stop_address
from daemon.cli.connection import add_connection, client_keys

COMMANDS = {
    "tare": "take the zero of every torque sensor anew, nothing gripped and no experiment running",
    "status": "how each task is",
    "start": "begin an experiment",
    "pause": "stand still until `resume`",
    "resume": "go on",
    "stop": "end the experiment and stand still; where none is running, end the daemon",
    "unlock": "let robot and gripper move again after a stop, once it is safe",
    "set": "change what may change while it runs: --heatmap",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `command`."""
    parser.add_argument(
        "name",
        choices=COMMANDS,
        help="; ".join(f"{name}: {what}" for name, what in COMMANDS.items()),
    )
    parser.add_argument("--source", help="the fingertip to tare or to set, or `skin`; all by default")
    parser.add_argument(
        "--heatmap", choices=("always", "on_request"), help="what to set: whether heatmaps wait for a subscriber"
    )
    parser.add_argument(
        "--experiment", type=Path, metavar="FILE", help="what to start; else what the daemon's configuration names"
    )
    add_connection(parser, COMMAND_ADDRESS)
    parser.add_argument(
        "--timeout", type=float, default=2.0, metavar="S", help="how long to wait (default: %(default)s s)"
    )
    parser.add_argument("--json", action="store_true", help="print the reply as JSON")


def run(args: argparse.Namespace) -> int:
    """Send one command and print its reply; status 1 when the daemon refused it."""
    import json
    import sys

    from daemon.request import request
    from daemon.subscriber import checked_timeout_s

    arguments = {} if args.source is None else {"source": args.source}
    if args.heatmap is not None:
        arguments["heatmap"] = args.heatmap
    if args.experiment is not None:
        # The daemon may run in another folder.
        arguments["experiment"] = str(args.experiment.resolve())
    address, keys = args.connect, None
    if args.name in ("stop", "status") and args.key is None and not needs_keys(address):
        # Where the daemon's commands need keys, these two do not.
        address = stop_address(address)
    else:
        keys = client_keys(args)
    reply = request(address, {"command": args.name, **arguments}, checked_timeout_s(args.timeout), keys)
    accepted = bool(reply.pop("ok", False))
    if args.json:
        print(json.dumps({"ok": accepted, **reply}, ensure_ascii=False))
    elif accepted:
        print(f"{args.name}: done" if not reply else f"{args.name}: {json.dumps(reply, ensure_ascii=False, indent=2)}")
    else:
        print(f"shearloop command: {args.name} was refused: {reply.get('why')}", file=sys.stderr)
    return 0 if accepted else 1
