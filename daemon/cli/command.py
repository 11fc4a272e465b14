"""`shearloop command`: ask a running daemon to do something."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.connection import add_connection, client_keys
from shearloop.daemon.messaging.addresses import (
    COMMAND_ADDRESS,
    COMMAND_TIMEOUT_S,
    UNLOCK_TIMEOUT_S,
    needs_keys,
    stop_address,
)

COMMANDS = {
    "tare": "take the zero of the torque sensors anew: nothing gripped, no experiment running",
    "status": "how each task is",
    "start": "begin an experiment",
    "pause": "the arm stands still until `resume`; fingers that move go on to their end",
    "resume": "go on",
    "stop": "end the experiment and stand still; where none is running, end the daemon",
    "unlock": "let robot and gripper move again after a stop, once nobody is in reach of them",
    "set": "change what may change while it runs: --heatmap",
}


EPILOG = """
examples:
  shearloop command tare --source right
  shearloop command start --experiment config/experiments/loosen.yaml
  shearloop command stop

Exit status: 0 done, 1 refused (and why), 2 nobody answered. On the daemon's own
machine `stop` and `status` need no key. `shearloop listen` prints what it publishes.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `command`."""
    parser.description = "Ask a running daemon to do something, and print what it answers."
    width = max(map(len, COMMANDS))
    parser.epilog = (
        "what it can be asked:\n" + "".join(f"  {name:<{width}}  {what}\n" for name, what in COMMANDS.items()) + EPILOG
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("name", choices=COMMANDS, metavar="WHAT", help="one of those below")
    parser.add_argument(
        "--source", metavar="NAME", help="for tare and set: which sensor, as the configuration names it (default: all)"
    )
    parser.add_argument(
        "--heatmap",
        choices=("always", "on_request"),
        help="for set: whether heatmaps are computed always, or while somebody subscribes to them",
    )
    parser.add_argument(
        "--experiment", type=Path, metavar="FILE", help="for start (default: the one that the configuration names)"
    )
    add_connection(parser, COMMAND_ADDRESS, "where the daemon takes commands")
    parser.add_argument(
        "--timeout",
        type=float,
        metavar="S",
        help=f"how long to wait for the answer (default: {COMMAND_TIMEOUT_S:g} s, for unlock {UNLOCK_TIMEOUT_S:g} s)",
    )
    parser.add_argument("--json", action="store_true", help="print the reply as JSON")


def run(args: argparse.Namespace) -> int:
    """Send one command and print its reply; status 1 when the daemon refused it."""
    import json
    import sys

    from shearloop.daemon.messaging.client import check_timeout_s, send_command

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
    timeout_s = COMMAND_TIMEOUT_S if args.timeout is None else check_timeout_s(args.timeout)
    if args.name == "unlock" and args.timeout is None:
        # That nobody is there is said at once all the same.
        send_command(address, {"command": "status"}, COMMAND_TIMEOUT_S, keys)
        timeout_s = UNLOCK_TIMEOUT_S
    reply = send_command(address, {"command": args.name, **arguments}, timeout_s, keys)
    accepted = bool(reply.pop("ok", False))
    if args.json:
        print(json.dumps({"ok": accepted, **reply}, ensure_ascii=False))
    elif accepted:
        print(f"{args.name}: done" if not reply else f"{args.name}: {json.dumps(reply, ensure_ascii=False, indent=2)}")
    else:
        print(f"shearloop command: {args.name} was refused: {reply.get('reason')}", file=sys.stderr)
    return 0 if accepted else 1
