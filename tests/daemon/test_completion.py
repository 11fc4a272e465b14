import subprocess
from pathlib import Path

from shearloop.daemon.cli import COMMANDS
from shearloop.daemon.cli.completion import full_parser


def completed(script: Path, *words: str) -> set[str]:
    """Return what bash would offer at the end of a command line."""
    line = " ".join(f"'{word}'" for word in words)
    program = (
        f'source "{script}"; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; '
        'complete -p shearloop >/dev/null || exit 9; _shtab_shearloop "$1"; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return set(done.stdout.split())


def test_bash_completes_commands_and_options(tmp_path, ran):
    script = tmp_path / "shearloop"
    script.write_text(ran("completion", "bash").out)
    assert set(COMMANDS) <= completed(script, "shearloop", "")
    assert completed(script, "shearloop", "do") == {"doctor"}
    assert "--geometry" in completed(script, "shearloop", "doctor", "--")
    assert {"server", "client", "allow", "revoke", "list"} <= completed(script, "shearloop", "keys", "")


def test_every_shell_has_its_script(ran):
    for shell in ("zsh", "tcsh"):
        assert "doctor" in ran("completion", shell).out


def test_file_arguments_complete_file_names():
    config = next(action for action in _command("check")._actions if action.dest == "config")
    assert getattr(config, "complete", None)


def _command(name: str):
    return next(action for action in full_parser()._actions if action.dest == "command").choices[name]
