"""`shearloop check`: check a configuration and the files it names, or an experiment, and print its plan."""

import argparse
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import add_option
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig
    from shearloop.tools.check import Parts

# The part that says why a rehearsal is refused.
REHEARSAL = "rehearsal"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `check`."""
    add_option(parser, "config", Path, "FILE", "a configuration such as config/demo.yaml, or an experiment")
    text = "check the experiment FILE against the devices of this configuration"
    add_option(parser, "--config", Path, "RIG", text, dest="rig")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.epilog = (
        "Prints what an experiment does, step by step, and what is refused. Opens no device; `shearloop doctor CONFIG` "
        "does. With --json, `torque_nm` is null if the tool turns by an angle, and its torque is not known before."
    )


def run(args: argparse.Namespace) -> int:
    """Load everything that `run` loads, without opening a device."""
    from shearloop.tools.check import OF_REAL_DEVICES
    from shearloop.yaml_files import read_yaml

    content = read_yaml(args.config, UserError, "file")
    _refuse_no_section(content, args.config)
    is_experiment = _is_experiment(content)
    if args.rig is not None and not is_experiment:
        cure = "leave --config out"
        with suppress(UserError):
            if _is_experiment(read_yaml(args.rig, UserError)):
                cure = f"write `shearloop check {args.rig} --config {args.config}`"
        raise UserError(f"{args.config}: this file is a configuration, and --config goes with an experiment; {cure}")
    parts = _check_experiment(args.config, args.rig) if is_experiment else _check_configuration(args.config)
    plan_lines = [line for plan in parts.plans for line in plan.sentences()]
    # A rehearsal runs all the same, so the other parts are judged and shown as well.
    for_real = "\n".join(parts.mistakes.pop(part) for part in OF_REAL_DEVICES if part in parts.mistakes)
    if for_real and REHEARSAL in parts.texts:
        # Then nothing can run it.
        parts.mistakes[REHEARSAL] = f"a rehearsal is {parts.texts[REHEARSAL]}"
    if parts.mistakes:
        if is_experiment and plan_lines and not args.json:
            # A rehearsal shows where in the plan the refused steps are.
            print(*plan_lines, sep="\n", flush=True)
            if args.rig is not None and "experiment" not in parts.mistakes:
                print(f"{args.config} is in order, and {args.rig} is not", flush=True)
        raise UserError("\n".join(dict.fromkeys(filter(None, (*parts.mistakes.values(), for_real)))))
    sentences = [*(f"{name}: {text}" for name, text in parts.texts.items()), *plan_lines]
    plan = parts.plans[0].as_json() if parts.plans else None
    result = {"config": str(args.config), "parts": parts.texts, "open": for_real.splitlines(), "plan": plan}
    verdict = f"{args.config} is in order"
    if for_real:
        rehearsal = "a rehearsal (`shearloop run --emulate`)" if args.rig is None else f"a rehearsal of {args.rig}"
        verdict = f"{for_real}\n{verdict} for {rehearsal}; the real devices need the changes above"
    return print_result(result, [*sentences, verdict], as_json=args.json)


def _note_rehearsal(config: "DaemonConfig", path: Path, parts: "Parts") -> None:
    """Add why a rehearsal is refused, if it is. The real devices may run all the same."""
    from shearloop.cli.rehearsal import refuse_what_cannot_be_emulated

    try:
        refuse_what_cannot_be_emulated(config, path)
    except UserError as error:
        parts.texts[REHEARSAL] = f"refused: {error}"


def _refuse_no_section(content: object, path: Path) -> None:
    """Raise UserError for a file without keys, which is no experiment and no configuration."""
    if isinstance(content, dict):
        return
    if not isinstance(content, list):
        cure = "write keys and values such as `robot: ur.yaml`"
        raise UserError(f"{path}: this file is a text or a number, and no section with keys; {cure}")
    if any(isinstance(entry, dict) and "do" in entry for entry in content):
        cure = "write `name: …` and `steps:` above it"
        raise UserError(f"{path}: this file is a list of steps, and no whole experiment; {cure}")
    raise UserError(f"{path}: this file is a list, and no section with keys; take out the `-` before each key")


def _is_experiment(content: object) -> bool:
    """Return whether a file is meant as an experiment: by its steps, or by most of its keys where one is misspelt."""
    from shearloop.daemon.config import DaemonConfig
    from shearloop.daemon.control.experiment_schema import ExperimentFile

    if not isinstance(content, dict):
        return False
    if "steps" in content or get_close_matches("steps", map(str, content), n=1, cutoff=0.75):
        return True
    of_experiments, of_configurations = (
        sum(key in model.model_fields for key in content) for model in (ExperimentFile, DaemonConfig)
    )
    return of_experiments > of_configurations


def _check_configuration(path: Path) -> "Parts":
    """Return the parts of a configuration; the mistakes of an invalid one hide none of the files that it names."""
    from shearloop.cli.emulator_processes import check_emulators
    from shearloop.daemon.config import load_daemon_config
    from shearloop.tools.check import Parts, check_parts

    parts = Parts()
    with parts.of("configuration"):
        config = load_daemon_config(path)
        parts = check_parts(config, path, check_emulators)
        _note_rehearsal(config, path, parts)
    if "configuration" in parts.mistakes:
        _check_named_files(path, parts)
    return parts


def _check_experiment(path: Path, rig: Path | None) -> "Parts":
    """Return the plan of an experiment, alone or on the devices of a configuration."""
    from shearloop.cli.emulator_processes import check_emulators
    from shearloop.daemon.config import load_daemon_config
    from shearloop.tools.check import Parts, check_experiment_alone, check_parts

    if rig is None:
        return check_experiment_alone(path)
    parts = Parts()
    with parts.of("configuration"):
        config = load_daemon_config(rig)
        if config.robot is None:
            raise UserError(f"{rig}: an experiment needs a robot: add `robot: ur.yaml`")
        parts = check_parts(config.model_copy(update={"experiment": path}), rig, check_emulators)
        _note_rehearsal(config, rig, parts)
    if "configuration" in parts.mistakes:
        _check_named_files(rig, parts, path)
    return parts


def _check_named_files(path: Path, parts: "Parts", experiment: Path | None = None) -> None:
    """Add the mistakes in the files that an invalid configuration names, or of another `experiment`."""
    from shearloop.daemon.rig import robot_settings
    from shearloop.tools.check import named_file, read_experiment
    from shearloop.yaml_files import read_yaml

    content: object = None
    # The mistakes of the configuration are named already.
    with suppress(UserError):
        content = read_yaml(path, UserError)
    given = content if isinstance(content, dict) else {}
    folder = path.resolve().parent
    robot, own = (named_file(given.get(key), folder) for key in ("robot", "experiment"))
    for key, file, read in (("robot", robot, robot_settings), ("experiment", experiment or own, read_experiment)):
        if file is not None:
            with parts.of(key):
                read(file)
