"""`shearloop listen`: print what a daemon publishes."""

import argparse
import sys
from typing import TYPE_CHECKING, Final

from shearloop.cli.connection import add_connection, client_keys
from shearloop.cli.options import TIMEOUT_S, add_option, positive
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS
from shearloop.daemon.running_rig import EMULATED_HEADING

if TYPE_CHECKING:
    from shearloop.daemon.messaging.client import Subscriber

# A daemon sends `health` every second.
HEALTH_WITHIN_S: Final = 1.2

EPILOG = """
examples:
  shearloop listen eit.estimate load.torque
  shearloop listen health --count 1 --json

docs/messages.md lists the topics and their keys. Ctrl-C ends it.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `listen`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    text = "topics or their first part, such as eit (default: all)"
    add_option(parser, "topics", str, "TOPIC", text, nargs="*", default=[])
    add_connection(parser, PUBLISH_ADDRESS, "where the daemon publishes")
    parser.add_argument("--json", action="store_true", help="one JSON object per line, with arrays")
    add_option(parser, "--count", positive(int), "N", "stop after N messages")
    add_option(parser, "--timeout", TIMEOUT_S, "S", "stop with an error after S seconds without a message")


def run(args: argparse.Namespace) -> int:
    """Print messages until Ctrl-C, or up to `--count`."""
    from shearloop.cli.terminal import message_json, message_line
    from shearloop.daemon.messaging.client import Subscriber, prefix_of, receive_messages

    for topic in args.topics:
        prefix_of(topic)
    write = message_json if args.json else message_line

    def print_hint(sentence: str) -> None:
        print(f"shearloop listen: {sentence}", file=sys.stderr, flush=True)

    keys = client_keys(args)
    received = receive_messages(args.connect, args.topics, args.timeout, keys, print_hint)
    with Subscriber(args.connect, ("health",), keys=keys) as health:
        for number, (topic, content) in enumerate(received, start=1):
            if number == 1 and _is_emulated(health):
                # `health` says it in JSON.
                print(EMULATED_HEADING, file=sys.stderr if args.json else sys.stdout, flush=True)
            print(write(topic, content), flush=True)
            if number == args.count:
                break
    return 0


def _is_emulated(health: "Subscriber") -> bool:
    """Return whether a daemon that has just published says in `health` that its rig is emulated."""
    if not health.wait(HEALTH_WITHIN_S):
        return False
    _, content = next(health)
    return bool(content.get("emulated"))
