"""The pages name only commands, options, files and pages that there are."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from shearloop.daemon.cli import COMMANDS
from shearloop.daemon.cli.completion import full_parser

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"(?<!!)\[[^\]]*\]\(([^)#]+)[^)]*\)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_options_exist(page):
    parsers = next(action for action in full_parser()._actions if action.dest == "command").choices
    for text in re.findall(r"(?:^ {4}|`)(?:sudo )?(?:[./\w-]*/)?shearloop ([^`\n]*)", page.read_text(), re.MULTILINE):
        words = shlex.split(text.split(" #")[0].split(";")[0], comments=False) if text.count("'") % 2 == 0 else []
        if not words or not re.fullmatch(r"[a-z]+", words[0]):
            continue
        assert words[0] in COMMANDS, f"{page.name}: shearloop {text}"
        known = _options(parsers[words[0]])
        for word in words[1:]:
            if word.startswith("--"):
                assert word.rstrip(",.").split("=")[0] in known, f"{page.name}: shearloop {text}"


def test_the_readmes_recordings_are_ignored_by_git():
    folders = {Path(one).parts[0] for one in re.findall(r"--record (\S+)", (ROOT / "README.md").read_text())}
    assert folders
    assert {f"/{folder}/" for folder in folders} <= set((ROOT / ".gitignore").read_text().splitlines())


def program_texts() -> list[str]:
    """Return the string literals of the code, with `…` in place of each formatted value."""

    def text(node: ast.AST) -> str:
        match node:
            case ast.Constant(value=str(value)):
                return re.sub(r"\{\w+\}", "…", value)
            case ast.JoinedStr(values=parts):
                return "".join(text(part) for part in parts)
            case _:
                return "…"

    return [
        text(node)
        for folder in ("bank", "drivers", "daemon", "src")
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
    ]


def test_every_message_of_the_troubleshooting_page_exists_in_the_code():
    quoted = re.findall(r'^\| "(.*?)" \||\("(.*?)"\)', (ROOT / "docs/troubleshooting.md").read_text(), re.MULTILINE)
    messages = ["".join(pair) for pair in quoted]
    texts = program_texts()
    assert len(messages) >= 30
    assert [message for message in messages if not any(message in text for text in texts)] == []


def _options(parser) -> set[str]:
    found = set(parser._option_string_actions)
    for action in parser._actions:
        if hasattr(action, "_parser_class"):
            for below in action.choices.values():
                found |= _options(below)
    return found
