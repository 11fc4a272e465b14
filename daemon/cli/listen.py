"""`shearloop listen`: print what a daemon publishes."""

import argparse
import sys

from shearloop.daemon.cli import EXIT_OK
from shearloop.daemon.cli.connection import add_connection, client_keys
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS
from shearloop.daemon.signals import interrupt_status

EPILOG = """
examples:
  shearloop listen eit.estimate load.torque
  shearloop listen health --count 1 --json

docs/messages.md says which topics there are and what is in them. Ends with Ctrl-C.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `listen`."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument(
        "topics", nargs="*", default=[], metavar="TOPIC", help="topics, or their beginnings (eit); all by default"
    )
    add_connection(parser, PUBLISH_ADDRESS, "where the daemon publishes")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, arrays included")
    parser.add_argument("--count", type=int, metavar="N", help="stop after N messages")
    parser.add_argument("--timeout", type=float, metavar="S", help="give up when nothing comes for S seconds")


def run(args: argparse.Namespace) -> int:
    """Print messages until interrupted, or until enough have come."""
    from shearloop.daemon.cli.message_lines import message_json, message_line
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.messaging.subscriber import QUIET_S, checked_timeout_s, messages
    from shearloop.daemon.messaging.topics import TOPICS

    for topic in args.topics:
        if not any(known.startswith(topic) for known in TOPICS):
            raise UserError(f"there is no topic {topic!r}; the topics are {', '.join(TOPICS)}")
    if args.count is not None and args.count < 1:
        raise UserError(f"--count {args.count} is not a number of messages; give 1 or more")
    if args.timeout is not None:
        checked_timeout_s(args.timeout)
    write = message_json if args.json else message_line

    def tell_quiet() -> None:
        print(
            f"shearloop listen: nothing has come from {args.connect} in {QUIET_S:g} s; waiting. Is a daemon running "
            f"there (`shearloop run CONFIG`), and does it publish {' or '.join(args.topics) or 'anything'}?",
            file=sys.stderr,
            flush=True,
        )

    try:
        heard = messages(args.connect, args.topics, args.timeout, client_keys(args), tell_quiet)
        for number, (topic, content) in enumerate(heard, start=1):
            print(write(topic, content), flush=True)
            if number == args.count:
                break
    except KeyboardInterrupt as interrupt:
        # That is how listening ends, and nothing to tell.
        return interrupt_status(interrupt)
    return EXIT_OK
