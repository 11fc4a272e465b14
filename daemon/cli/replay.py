"""`shearloop replay REC`: a recording through the same parsers and estimators again, published as if live."""

import argparse
import asyncio
import math
import sys
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.output import print_result
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig
    from shearloop.daemon.recording.recorded_run import RecordedRun
    from shearloop.daemon.recording.replay import Comparison


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("recording", type=Path, metavar="REC", help="made by `shearloop run --record` or imported")
    # Of a folder with two recordings, `recordings/first/*.mcap` names both.
    parser.add_argument("more", nargs="*", type=Path, help=argparse.SUPPRESS)
    parser.add_argument(
        "--speed", default="1", metavar="N", help="times as fast as it happened, or max (default: %(default)s)"
    )
    parser.add_argument("--publish", default=PUBLISH_ADDRESS, metavar="ADDRESS", help="where to (default: %(default)s)")
    parser.add_argument("--config", type=Path, metavar="FILE", help="instead of the configuration in the recording")
    parser.add_argument("--wait", action="store_true", help="begin when somebody subscribes")
    printed = parser.add_mutually_exclusive_group()
    printed.add_argument("--show", action="store_true", help="print the estimates as they come")
    add_json(printed)
    parser.add_argument(
        "--check",
        action="store_true",
        help="exit with status 1 where an estimate is not the recorded one, bit for bit, and where there is none",
    )


def run(args: argparse.Namespace) -> int:
    """Replay to the end, and say whether it came to the same."""
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.recording.identity import code_digest
    from shearloop.daemon.recording.recorded_run import RecordedRun

    speed = parsed_speed(args.speed)
    if args.more:
        raise UserError(
            f"one recording is replayed at a time, and {1 + len(args.more)} were named; name one, as {args.recording}"
        )
    run = RecordedRun(args.recording)
    with nullcontext(load_daemon_config(args.config)) if args.config else run.configuration() as config:
        comparison = asyncio.run(_replayed(run, config, speed, args))
    same_code = run.metadata.get("code_sha256") == code_digest()
    for line in _told(comparison, same_code):
        print(line, file=sys.stderr)
    if args.json:
        counts = {"compared": dict(comparison.compared), "different": dict(comparison.different)}
        print_result(
            {**counts, "unrecorded": comparison.unrecorded, "examples": comparison.examples, "same_code": same_code},
            (),
            as_json=True,
        )
    return 1 if args.check and (comparison.different or not comparison.compared) else 0


def parsed_speed(text: str) -> float:
    """Return a speed; UserError for what is neither a number above 0 nor max."""
    from shearloop.daemon.errors import UserError

    if text == "max":
        return math.inf
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0 < speed < math.inf:
        raise UserError(f"--speed must be a number above 0, or max, not {text!r}")
    return speed


async def _replayed(run: "RecordedRun", config: "DaemonConfig", speed: float, args: argparse.Namespace) -> "Comparison":
    import zmq.asyncio

    from shearloop.daemon.cli.message_lines import EstimatePrinter
    from shearloop.daemon.cli.output import progress_bar
    from shearloop.daemon.messaging.publisher import Publisher
    from shearloop.daemon.recording.replay import Replay, ReplayClock
    from shearloop.daemon.recording.replay_pipeline import ReplayPipeline

    clock = ReplayClock()
    with ExitStack() as opened:
        publisher = Publisher(opened.enter_context(zmq.asyncio.Context()), args.publish, clock)
        opened.callback(publisher.close)
        replay = Replay(run, ReplayPipeline(config, run.asides(), publisher), publisher, clock)
        if args.show:
            publisher.listen(EstimatePrinter(sys.stdout))
        while args.wait and not publisher.subscribed:  # noqa: ASYNC110 - it is told when it is asked
            await asyncio.sleep(0.05)
        progress = opened.enter_context(progress_bar(run.path.name, run.messages, "message"))
        await replay.play(speed, progress)
        # What was sent last is still on its way.
        await asyncio.sleep(0.1)
    return replay.comparison


def _told(comparison: "Comparison", same_code: bool) -> list[str]:
    if not comparison.compared:
        return ["Nothing was compared: the recording has no estimates with the bytes that they were made from."]
    lines = []
    for topic, count in sorted(comparison.compared.items()):
        different = comparison.different[topic]
        lines.append(f"{topic}: {count - different} of {count} are the same as recorded, bit for bit")
    lines += comparison.examples
    if comparison.unrecorded:
        lines.append(f"{comparison.unrecorded} messages were made that are not in the recording.")
    if comparison.different and not same_code:
        lines.append("The recording was made by other code than this, whose results may be others.")
    return lines
