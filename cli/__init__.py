"""The command line, `shearloop COMMAND …`: reads its words and runs one of the commands of `registry.py`."""

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from shearloop.cli.registry import COMMANDS, GROUPS, OTHER_SPELLINGS, command_module
from shearloop.daemon.errors import USER_ERRORS
from shearloop.daemon.messaging.deadlines import boot_ns
from shearloop.daemon.process import interrupt_status, raise_ending_signals
from shearloop.errors import UserError
from shearloop.printable import OutputError, open_closed_streams, printable_output, silence

# Our products are small: a BLAS with one thread is faster. Must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Colours are control characters, which the output escapes (help of Python 3.14, log outside of `logging_to_stderr`).
os.environ.setdefault("NO_COLOR", "1")

# A person typed the command before the process loaded this module.
_LOADED_NS = boot_ns()
EXIT_OK, EXIT_USAGE = 0, 2
# Exit statuses of `run` with `stop_when_done`: a fault, or a person, stopped the experiment.
EXIT_UNFINISHED, EXIT_STOPPED = 3, 4

_FIRST_STEPS = """First steps without devices: `shearloop demo`.
With your own: `shearloop init DIR` writes a configuration, `shearloop ports` shows the devices' names,
`shearloop check CONFIG` checks the configuration, `shearloop doctor CONFIG` finds faults of cables and devices."""


class Parser(argparse.ArgumentParser):
    """Reports a mistake in one sentence and names the help; takes a list's values from between options too."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # So that argparse raises its errors, with the argument, and does not print them.
        self.exit_on_error = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        """Return the arguments, with a list's later values in the list; nothing is left over.

        argparse ends a list of positional arguments at the first option: in `NAME --out DIR REC`, REC is left over.
        """
        try:
            found, extras = super().parse_known_args(args, namespace)
            lists = [action for action in self._actions if not action.option_strings and action.nargs in ("*", "+")]
            # A word after an unknown option may be its value.
            if lists and not any(text.startswith("-") for text in extras):
                more = [self._get_value(lists[-1], text) for text in extras]
                setattr(found, lists[-1].dest, [*getattr(found, lists[-1].dest), *more])
                extras = []
        except argparse.ArgumentError as error:
            if error.argument_name is None:
                self.error(error.message)
            # The types of options begin their sentence with the value.
            of_type = isinstance(error.__context__, argparse.ArgumentTypeError)
            self._refuse(f"{error.argument_name}{'' if of_type else ':'} {error.message}")
        if extras:
            from shearloop.cli.argument_mistakes import unknown_arguments

            self._refuse(unknown_arguments(extras, self._option_string_actions))
        for action in self._actions:
            # The types of options that name an output look at the inputs.
            if (check := getattr(action.type, "check", None)) is not None:
                check(action, self._actions, found)
        return found, []

    def error(self, message: str) -> NoReturn:
        """Raise UserError with argparse's sentence, and with the choices for each missing word that it names."""
        from shearloop.cli.argument_mistakes import missing_arguments

        self._refuse(missing_arguments(message, self._actions))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a value that is not among the choices, with the nearest one."""
        if action.choices is not None and value not in action.choices:
            from shearloop.cli.argument_mistakes import unknown_choice

            self._refuse(unknown_choice(action, value))

    def _refuse(self, sentence: str) -> NoReturn:
        raise UserError(f"{sentence}; see `{self.prog} --help`")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; print a user's mistake as one sentence on stderr and return status 2."""
    open_closed_streams()
    with printable_output():
        try:
            try:
                return _run(argv)
            finally:
                sys.stdout.flush()
        except BrokenPipeError:
            # The reader of our output (`| head`) has closed the pipe; that is no error.
            silence(sys.stdout)
            return EXIT_OK
        except OutputError as error:
            silence(sys.stdout)
            with contextlib.suppress(OSError):
                print(f"shearloop: the output cannot be written: {error.strerror}", file=sys.stderr)
            return EXIT_USAGE


def _run(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    # With words that are given, it is called from a longer process.
    began_ns = _LOADED_NS if argv is None else boot_ns()
    if arguments[:1] in ([], ["help"]):
        arguments = [*arguments[1:2], "--help"]
    program, interrupt_is_end = "shearloop", False
    if (words := OTHER_SPELLINGS.get(arguments[0])) is not None:
        with contextlib.suppress(OSError):
            print(f"`shearloop {arguments[0]}` is `shearloop {' '.join(words)}`", file=sys.stderr)
        arguments = [*words, *arguments[1:]]
    try:
        name = _overview().parse_args(arguments[:1]).command
        interrupt_is_end = COMMANDS[name].ended_by_interrupt
        program, module = f"shearloop {name}", command_module(name)
        parser = Parser(prog=program, description=COMMANDS[name].summary)
        module.configure(parser)
        parser.set_defaults(began_ns=began_ns)
        expand = getattr(module, "expand_default_command", list)
        args = parser.parse_args(expand(arguments[1:]))
        with raise_ending_signals():
            status: int = module.run(args)
            return status
    except USER_ERRORS as error:
        print(f"{program}: {_with_notes(str(error), error)}", file=sys.stderr)
        return EXIT_USAGE
    except MemoryError as error:
        cure = "close other programs, or ask for less at a time"
        print(f"{program}: not enough memory: {str(error) or 'none is left'}; {cure}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt as interrupt:
        if not interrupt_is_end:
            # A closed terminal accepts no output.
            with contextlib.suppress(OSError):
                said = _with_notes("interrupted before it was done", interrupt)
                print(f"{program}: {said}", file=sys.stderr)
        return interrupt_status(interrupt)


def _with_notes(sentence: str, error: BaseException) -> str:
    for note in getattr(error, "__notes__", ()):
        sentence = f"{sentence}{'' if sentence.endswith(('.', '?')) else '.'} {note}"
    return sentence


def _overview() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    listing = "\n\n".join(
        "\n".join([f"{group}:", *(f"  {name:<{width}}  {command.summary}" for name, command in commands.items())])
        for group, commands in GROUPS.items()
    )
    parser = Parser(
        prog="shearloop",
        description="Closed-loop twisting with soft shear-sensing skins.",
        epilog=f"{listing}\n\n`shearloop COMMAND --help` explains one. {_FIRST_STEPS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="one of the commands below")
    return parser


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(version("shearloop"))
        parser.exit()
