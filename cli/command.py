"""`shearloop command`: send a command to a running daemon."""

import argparse
import json
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shearloop.cli.connection import MissingKeyError, add_connection, client_keys, with_connection
from shearloop.cli.options import TIMEOUT_S, add_option
from shearloop.daemon.messaging import addresses, stop_client
from shearloop.daemon.messaging.bound_requests import TYPED_WITHIN_S, LateRequestError, meant_for
from shearloop.daemon.messaging.callers import caller
from shearloop.daemon.messaging.deadlines import NEVER_LATE, boot_ns
from shearloop.daemon.running_rig import EMULATED, EMULATED_HEADING
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.messaging.keys import ClientKeys

DAEMON_COMMANDS = {
    "tare": "set the zero of the torque sensors, with nothing gripped and no experiment running",
    "status": "show the experiment and the state of each task",
    "experiments": "list the experiments that `start` may name",
    "start": "start an experiment; --yes where it lets a held tool go",
    "pause": "hold the arm until `resume`; moving fingers finish their move",
    "resume": "continue after `pause`",
    "stop": "stop the experiment and the arm; without an experiment, stop the daemon",
    "release": "open the gripper: a tool drops; or let a clamped one's angle count from 0; needs --yes",
    "unlock": "allow motion again after a stop, when no person is within reach; --yes where it opens the gripper",
}
# `stop` is never refused, and the others change nothing.
_ACTS_ON_NOTHING_SHOWN = ("stop", *addresses.READ_ONLY)
# The option for each argument of a request, and the commands that have it.
OPTIONS = {
    "source": ("--source", ("tare",)),
    "experiment": ("--experiment", ("start",)),
    "confirmed": ("--yes", ("tare", "start", "unlock", "release")),
}
# Their replies are shown as tables.
_TABLES = ("status", "experiments")

EPILOG = """
examples:
  shearloop command tare --source right
  shearloop command start --experiment config/experiments/loosen.yaml
  shearloop command stop
  shearloop command release --yes

Exit status: 0 done, 1 refused, 2 no answer. On the daemon's own machine `stop` and
`status` need no key. `shearloop listen` prints the daemon's messages.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `command`."""
    parser.description = "Send a command to a running daemon and print the reply."
    width = max(map(len, DAEMON_COMMANDS))
    parser.epilog = (
        "commands:\n" + "".join(f"  {name:<{width}}  {what}\n" for name, what in DAEMON_COMMANDS.items()) + EPILOG
    )
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("name", choices=DAEMON_COMMANDS, metavar="COMMAND", help="one of the commands below")
    parser.add_argument("--source", metavar="NAME", help="for tare: name of the sensor (default: all)")
    add_option(parser, "--experiment", Path, "FILE", "for start (default: that of the configuration)")
    yes = "for start, release and unlock: the tool may drop, or is another one; for tare: nothing is held"
    parser.add_argument("--yes", action="store_true", help=yes)
    add_connection(parser, addresses.COMMAND_ADDRESS, "the daemon's command address")
    default = f"{addresses.COMMAND_TIMEOUT_S:g} s, for {', '.join(addresses.SLOW)} {addresses.UNLOCK_TIMEOUT_S:g} s"
    add_option(parser, "--timeout", TIMEOUT_S, "S", f"time to wait for the reply (default: {default})")
    parser.add_argument("--json", action="store_true", help="print the reply as JSON")


def run(args: argparse.Namespace) -> int:
    """Send one command and print its reply; status 1 if the daemon refused it."""
    request = _request(args)
    reply = _asked(args, request)
    if reply.get("idle"):
        # Nothing moves. Only a stop that names its age ends the daemon, and its first one waited for no clock.
        with suppress(LateRequestError):
            reply = _asked(args, request | meant_for(reply, _age_s(args), TYPED_WITHIN_S))
    return _told(args, reply)


def _asked(args: argparse.Namespace, request: dict[str, Any]) -> dict[str, Any]:
    """Send a request, a `stop` or `status` by the stop socket where that can be; return the reply."""
    reply = None
    on_this_computer = not addresses.needs_keys(args.connect) or stop_client.is_here(args.connect)
    if args.name in ("stop", "status") and args.key is None and on_this_computer:
        # These two need no key on the daemon's own machine.
        timeout_s = args.timeout or addresses.COMMAND_TIMEOUT_S
        try:
            reply = stop_client.send_to_stop_socket(args.connect, request, timeout_s)
        except stop_client.StopSocketTakenError as error:
            print(f"shearloop command: {error}; `{args.name}` is sent to the command address instead", file=sys.stderr)
        except TimeoutError:
            # The daemon may have stopped the motion by now. A second `stop` must not end the daemon.
            request = {**request, "spare_daemon": True}
    return _sent(args, request, _keys(args)) if reply is None else reply


def _keys(args: argparse.Namespace) -> "ClientKeys | None":
    """Return the keys for the daemon; a `stop` on its own machine is tried without them too."""
    try:
        return client_keys(args)
    except MissingKeyError:
        if args.name != "stop" or addresses.needs_keys(args.connect):
            raise
        return None


def _age_s(args: argparse.Namespace) -> float:
    """Return how long ago the program began. Ctrl-Z or a suspended computer may have held it up."""
    return float(boot_ns() - args.began_ns) / 1e9


def _request(args: argparse.Namespace) -> dict[str, Any]:
    """Return the request that the arguments stand for."""
    request: dict[str, Any] = {"command": args.name, "by": caller("shearloop command")}
    if args.name == "stop":
        # It may be sent again, for want of an answer or with its time, and is one stop.
        request["request_id"] = f"{os.getpid()}-{args.began_ns}"
    if args.source is not None:
        request["source"] = args.source
    if args.yes:
        request["confirmed"] = True
    if args.experiment is not None:
        # The daemon may run in another folder.
        request["experiment"] = str(args.experiment.resolve())
    for argument, (option, commands) in OPTIONS.items():
        # Nothing may keep a stop back.
        if argument in request and args.name not in (*commands, "stop"):
            raise UserError(f"{option} is for {', '.join(commands)}; leave it out of `{args.name}`")
    return request


def _sent(args: argparse.Namespace, request: dict[str, Any], keys: "ClientKeys | None") -> dict[str, Any]:
    """Send a request to the command address and return the reply; raises UserError without one.

    One that acts is meant for the daemon that runs now, and for a short time. An unlock is meant for the stop that now
    waits there.
    """
    # It imports too much for a `stop` on a busy computer.
    from shearloop.daemon.messaging.client import send_command

    timeout_s = args.timeout
    acknowledged = ""
    if timeout_s is None:
        timeout_s = addresses.UNLOCK_TIMEOUT_S if args.name in addresses.SLOW else addresses.COMMAND_TIMEOUT_S
    if args.name not in _ACTS_ON_NOTHING_SHOWN:
        # By default, a missing daemon is reported without a long timeout.
        status_s = args.timeout or addresses.COMMAND_TIMEOUT_S
        status = send_command(args.connect, {"command": "status"}, status_s, keys)
        if not status.get("ok"):
            return status
        request |= meant_for(status, 0.0 if args.name in NEVER_LATE else _age_s(args), TYPED_WITHIN_S)
        if args.name == "unlock":
            loop = status.get("loop", {})
            acknowledged = loop.get("stop_causes", "")
            if "stop" in loop:
                request["stop"] = loop["stop"]
    reply = send_command(args.connect, request, timeout_s, keys)
    if acknowledged and reply.get("ok"):
        print(f"unlock acknowledged the stop: {acknowledged}.", file=sys.stderr)
    return reply


def _told(args: argparse.Namespace, reply: dict[str, Any]) -> int:
    """Print a reply; return the exit status."""
    accepted = bool(reply.pop("ok", False))
    label = f"{EMULATED}: " if reply.get("emulated") else ""
    if args.json:
        print(json.dumps({"ok": accepted, **reply}, ensure_ascii=False))
    elif accepted:
        shown = {key: value for key, value in reply.items() if key != "emulated"}
        lines = _lines(args.name, shown)
        # A table keeps its columns.
        lines = [EMULATED_HEADING, *lines] if label and args.name in _TABLES else [f"{label}{lines[0]}", *lines[1:]]
        print(with_connection("\n".join(lines), args, addresses.COMMAND_ADDRESS))
    else:
        reason = with_connection(str(reply.get("reason")), args, addresses.COMMAND_ADDRESS)
        if args.experiment is not None and not (addresses.needs_keys(args.connect) or args.experiment.exists()):
            # The daemon does not say it: it may see more than this user.
            reason = f"there is no file {args.experiment} on this computer; {reason}"
        print(f"shearloop command: {label}{args.name} was refused: {reason}", file=sys.stderr)
        if reply.get("invalid") and args.experiment is not None:
            for line in mistakes_of(args.experiment.resolve()).splitlines():
                # The reason has the first one already.
                if line not in reason:
                    print(line, file=sys.stderr)
    return 0 if accepted else 1


def mistakes_of(experiment: Path) -> str:
    """Return the mistakes of an experiment as lines, because the daemon's reply does not contain them.

    The daemon may read files that this user may not read. Empty if the file is only on the daemon's computer.
    """
    from shearloop.tools.check import read_experiment

    try:
        read_experiment(experiment)
    except UserError as error:
        return f"{error}\n"
    return ""


def _lines(name: str, reply: Mapping[str, Any]) -> list[str]:
    """Return an accepted reply as text: of `status` the experiment, and the tasks as a table."""
    if name == "status":
        from shearloop.cli.terminal import loop_line, table
        from shearloop.tools.task_row import task_row

        rows = [task_row(task, facts) for task, facts in reply["tasks"].items()]
        # The cause has a line of its own; `--json` has every reason.
        loop = [*loop_line(reply["loop"]).split("  ", 1), ""] if "loop" in reply else []
        cap = [f"{reply['cap'][0].upper()}{reply['cap'][1:]}.", ""] if reply.get("cap") else []
        return [*loop, *cap, *table(("task", "state", "rate", "notes"), rows)]
    if name == "experiments":
        from shearloop.cli.terminal import table

        own = reply["configured"]
        known = [
            (experiment["path"], experiment["name"], "configured" if experiment["path"] == own else "")
            for experiment in reply["experiments"]
        ]
        return [reply["unread"]] if reply.get("unread") else table(("file", "name", ""), known)
    if name == "tare":
        end = "`shearloop command status` shows its end, and `start` is refused until then"
        lost = reply.get("not_connected", ())
        are = "are" if len(lost) > 1 else "is"
        without = f"; NOT of {', '.join(lost)}, which {are} not connected" if lost else ""
        return [f"tare: the zero of {', '.join(reply['taring'])} is being taken{without}; {end}"]
    if name == "stop":
        if reply.get("ended"):
            return [f"stop: {stop_client.nothing_moved(reply)}; this stop ends the daemon"]
        if reply.get("held"):
            return [
                f"stop: {stop_client.nothing_moved(reply)}, and {reply['held']}. The daemon continues, so that "
                "`shearloop command release` can open them, and the next start waits for `shearloop command unlock`. "
                "Ctrl-C in its terminal ends the daemon, or `systemctl stop shearloop` on its computer."
            ]
        if reply.get("ended_by_itself"):
            return [f"stop: {stop_client.nothing_moved(reply)}; after 5 s, a further stop ends the daemon"]
        if reply.get("idle"):
            continues = "the daemon continues, because the stop came too late to end it"
            return [f"stop: {stop_client.nothing_moved(reply)}; {continues}. Send it again to end the daemon"]
        stopped = f"stopped {reply['stopped']}" if reply.get("stopped") else stop_client.nothing_moved(reply)
        return [f"stop: {stopped}"]
    values = {key: ", ".join(value) if isinstance(value, list) else value for key, value in reply.items()}
    return [f"{name}: {', '.join(f'{key} {value}' for key, value in values.items() if value) or 'done'}"]
