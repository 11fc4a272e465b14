"""`shearloop recording replay REC`: process a recording again and publish it as if live."""

import argparse
import asyncio
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import add_json, add_option
from shearloop.cli.terminal import print_result
from shearloop.daemon.messaging.addresses import PUBLISH_ADDRESS
from shearloop.errors import UserError
from shearloop.words import counted

if TYPE_CHECKING:
    import zmq.asyncio

    from shearloop.daemon.clock import Clock
    from shearloop.daemon.config import DaemonConfig
    from shearloop.daemon.messaging.publisher import Publisher
    from shearloop.tools.recordings.replay import RecordedRun, ReplayComparison, ReplayPace


# A free port: a comparison needs no subscriber, and a daemon may have the usual address.
UNPUBLISHED = "tcp://127.0.0.1:*"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recording", Path, "REC", "made by `shearloop run --record` or imported")
    add_option(parser, "--speed", _speed, "N", "factor, or max for no waiting (default: %(default)s)", default="1")
    text = f"publish here (default: {PUBLISH_ADDRESS}; with --check, nowhere)"
    add_option(parser, "--publish", str, "ADDRESS", text)
    add_option(parser, "--config", Path, "FILE", "instead of the configuration in the recording")
    parser.add_argument("--wait", action="store_true", help="begin with the first subscriber")
    printed = parser.add_mutually_exclusive_group()
    printed.add_argument("--show", action="store_true", help="print the estimates")
    add_json(printed)
    text = "exit with status 1 unless all estimates equal the recorded ones, bit for bit"
    parser.add_argument("--check", action="store_true", help=text)


def run(args: argparse.Namespace) -> int:
    """Replay to the end and print the comparison with the recorded estimates."""
    from shearloop.daemon.config import load_daemon_config
    from shearloop.daemon.recorder.schema import code_digest
    from shearloop.tools.recordings.replay import RecordedRun

    run = RecordedRun(args.recording)
    with nullcontext(load_daemon_config(args.config)) if args.config else run.configuration() as config:
        comparison, pace = asyncio.run(_replay(run, config, args))
    same_code = run.metadata.get("code_sha256") == code_digest()
    made_by = "" if same_code else run.metadata.get("software", "of an unknown version")
    if not args.check:
        print(f"{run.path}: replayed {counted(sum(run.counts.values()), 'recorded message')}.", file=sys.stderr)
    if pace.is_behind:
        print(
            f"The replay was {pace.reached:.3g} times as fast as the recording, not {pace.asked:g} times: this "
            "computer was too slow or too busy; choose a lower --speed.",
            file=sys.stderr,
        )
    for line in (*_other_keys_text(run, made_by), *_comparison_text(comparison, made_by)):
        print(line, file=sys.stderr)
    if args.json:
        counts = {"compared": comparison.compared, "different": comparison.different}
        before_state = {f"{topic}.{source}": count for (topic, source), count in comparison.before_state.items()}
        others = {
            "before_state": before_state,
            "without_state": comparison.without_state,
            "unrecorded": comparison.unrecorded,
            "examples": comparison.examples,
            "dropped_at_opening": comparison.dropped_at_opening,
            "same_code": same_code,
            "not_recorded": run.not_recorded,
            "differing": run.differing,
            "left_out": run.left_out,
            "lost_in_repair": run.lost,
            "left_out_topics": run.unknown_topics,
        }
        print_result(counts | others, (), as_json=True)
    return 1 if args.check and not comparison.passed else 0


def _speed(text: str) -> float:
    with suppress(ValueError):
        if (speed := float("inf" if text == "max" else text)) > 0:
            return speed
    raise argparse.ArgumentTypeError(f"{text} is not a number above 0, or max")


async def _replay(
    run: "RecordedRun", config: "DaemonConfig", args: argparse.Namespace
) -> "tuple[ReplayComparison, ReplayPace]":
    import zmq.asyncio

    from shearloop.cli.terminal import print_estimate, shown_topics
    from shearloop.tools.outputs import progress_bar
    from shearloop.tools.recordings.replay import Replay, ReplayClock

    clock = ReplayClock()
    with ExitStack() as opened:
        publisher = _publisher(opened.enter_context(zmq.asyncio.Context()), args, clock)
        opened.callback(publisher.close)
        replay = Replay(run, config, publisher, clock)
        if args.show:
            publisher.add_listener(partial(print_estimate, sys.stdout, topics=shown_topics(config)), raises=True)
        while args.wait and not publisher.has_subscribers():  # noqa: ASYNC110 - the publisher has no event
            await asyncio.sleep(0.05)
        progress = opened.enter_context(progress_bar(run.path.name, sum(run.counts.values()), "message"))
        pace = await replay.play(args.speed, progress)
        # The last messages are still being sent.
        await asyncio.sleep(0.1)
    return replay.comparison, pace


def _publisher(context: "zmq.asyncio.Context", args: argparse.Namespace, clock: "Clock") -> "Publisher":
    """Return the publisher of a replay; raises UserError, with the cure, for an address that it cannot have."""
    from shearloop.daemon.messaging.publisher import Publisher

    alone = args.check and not args.wait
    address = args.publish or (UNPUBLISHED if alone else PUBLISH_ADDRESS)
    try:
        return Publisher(context, address, clock)
    except UserError as error:
        raise UserError(
            f"{error}: give another one with `--publish`, such as --publish tcp://127.0.0.1:7771"
        ) from error


def _other_keys_text(run: "RecordedRun", made_by: str) -> list[str]:
    """Return the lines on topics and keys of a recording that differ from this version's."""

    def named(topics: Mapping[str, Sequence[str]]) -> str:
        return "; ".join(f"{', '.join(keys)} of {topic}" for topic, keys in topics.items())

    other = f"Other code (shearloop {made_by}) made the recording"
    lines = [f"{other} without {named(run.not_recorded)}: no value is sent there."] if run.not_recorded else []
    recorded = [f"{key} of {topic} {how}" for topic, keys in run.differing.items() for key, how in keys.items()]
    if recorded:
        lines.append(f"{other} with {'; '.join(recorded)}: no value is sent there.")
    if run.left_out:
        lines.append(f"{other} with {named(run.left_out)}: this version does not have that, and leaves it out.")
    if run.unknown_topics:
        topics = ", ".join(run.unknown_topics)
        lines.append(f"{other} with the topics {topics}: this version does not have them, and leaves them out.")
    if run.lost:
        lost = ", ".join(f"{count} of {topic}" for topic, count in run.lost.items())
        lines.append(f"The recording is a repaired copy, and {lost} are lost: what follows from them is different.")
    return lines


def _comparison_text(comparison: "ReplayComparison", made_by: str) -> list[str]:
    """Return what to print of a comparison; `made_by`: the version of the other code that made the recording."""
    lines = [
        f"Nothing of {source} was compared: the recording has no state of it." for source in comparison.without_state
    ]
    if not comparison.compared:
        return lines or ["Nothing was compared: the recording has no estimates with raw input."]
    if comparison.before_state and not lines:
        early = counted(comparison.before_state.total(), "message follows", "messages follow")
        lines.append(f"Not compared: {early} from inputs before this recording.")
    for topic, count in sorted(comparison.compared.items()):
        different = comparison.different[topic]
        lines.append(f"{topic}: {count - different} of {count} equal the recorded ones, bit for bit")
    lines += comparison.examples
    if comparison.unrecorded:
        computed = counted(comparison.unrecorded, "computed message is", "computed messages are")
        lines.append(
            f"{computed} not in the recording: of its last inputs, which the daemon did not publish any more, or of "
            "topics that it did not record; --check does not count them."
        )
    if comparison.different and made_by:
        lines.append(f"The recording was made by other code (shearloop {made_by}), so its results may differ.")
        if comparison.dropped_at_opening:
            early = counted(comparison.dropped_at_opening, "line")
            lines.append(
                f"{early} may have waited in a port before it was opened: this code drops such lines, and earlier code "
                "counted them."
            )
    return lines
