"""`shearloop init DIR`: write a commented configuration and experiments to start from."""

import argparse
import shlex
from contextlib import ExitStack
from importlib import resources
from pathlib import Path

from shearloop.cli.options import add_option
from shearloop.errors import UserError
from shearloop.tools.outputs import new_folder, writing

# Files and folders of the package's `config`.
STARTERS = ("rig.yaml", "ur.yaml", "experiments", "banks", "fingertips", "schemas", "foxglove.json")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `init`."""
    add_option(parser, "folder", Path, "DIR", "folder for the files; created if missing")
    parser.epilog = (
        "Writes rig.yaml, ur.yaml, experiments, banks, fingertips and a layout for Foxglove. Existing files are never "
        "changed."
    )


def run(args: argparse.Namespace) -> int:
    """Write the files, and print the next steps."""
    files = {path: text for path, text in packaged_files().items() if path.parts[0] in STARTERS}
    if present := [args.folder / path for path in files if (args.folder / path).exists()]:
        raise UserError(f"{present[0]} exists: nothing was written; choose another folder")
    write_files(args.folder, files)
    rig, settings = args.folder / "rig.yaml", args.folder / "ur.yaml"
    described, bank = args.folder / "banks" / "paper.yaml", args.folder / "paper.bank"
    build = shlex.join(["shearloop", "bank", "build", "--config", str(described), "--out", str(bank)])
    print(f"{rig}: name your boards, and take out what you do not have")
    print(f"{settings}: enter the robot's address, the workspace and the tool; a real robot does not run before")
    print(f"Then build the bank that rig.yaml names, which takes some seconds: `{build}`")
    print(f"Then check all files: `{shlex.join(['shearloop', 'check', str(rig)])}`")
    return 0


def packaged_files() -> dict[Path, bytes]:
    """Return the files of the package's `config` by their paths below it."""
    with resources.as_file(resources.files("shearloop") / "config") as config:
        return {path.relative_to(config): path.read_bytes() for path in sorted(config.rglob("*")) if path.is_file()}


def write_files(folder: Path, files: dict[Path, bytes]) -> None:
    """Write new files below a folder; raises UserError where that fails, and then none of them is left."""
    with ExitStack() as folders, ExitStack() as undone:
        for path, content in files.items():
            with writing(folder / path, "the file"):
                folders.enter_context(new_folder((folder / path).parent))
                undone.callback((folder / path).unlink, missing_ok=True)
                (folder / path).write_bytes(content)
        undone.pop_all()
