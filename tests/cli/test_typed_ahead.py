"""What was typed before a question does not answer it: a second `move` would allow the next motion unseen."""

import asyncio
import io
import os
import pty
import sys
from collections.abc import Iterator

import pytest

from shearloop.cli import terminal
from shearloop.cli.commission import Terminal
from shearloop.cli.terminal import Operator, forget_typed_ahead


class Keyboard:
    """A terminal at standard input; it types `then` when a question is shown."""

    def __init__(self, then: str) -> None:
        self.master, self.slave = pty.openpty()
        self._then = then
        self.shown = io.StringIO()

    def type(self, text: str) -> None:
        os.write(self.master, text.encode())

    def write(self, text: str) -> int:
        if text.strip():
            self.type(self._then)
        return self.shown.write(text)

    def flush(self) -> None:
        """Everything is shown at once."""


@pytest.fixture
def keyboard(monkeypatch) -> Iterator[Keyboard]:
    keyboard = Keyboard("no\n")
    with open(keyboard.slave, encoding="utf-8", closefd=False) as typed:
        monkeypatch.setattr(terminal, "STDIN", keyboard.slave)
        monkeypatch.setattr(sys, "stdin", typed)
        yield keyboard
    os.close(keyboard.master)
    os.close(keyboard.slave)


def test_a_word_typed_before_the_question_does_not_allow_a_motion(keyboard):
    keyboard.type("move\nmove\n")
    assert Terminal(keyboard, "").answer("MOTION: the fingers close").strip() == "no"
    assert keyboard.shown.getvalue() == "MOTION: the fingers close\n"


async def test_an_enter_typed_before_the_question_does_not_answer_it(keyboard, capsys):
    with Operator() as operator:
        keyboard.type("\n\n")
        await turns()
        asking = asyncio.create_task(operator.ask("Hold the object, then press Enter."))
        await turns()
        assert "Hold the object" in capsys.readouterr().out
        assert not asking.done()
        keyboard.type("\n")
        await asking


async def turns() -> None:
    """Let the event loop read what is there."""
    for _ in range(20):
        await asyncio.sleep(0)


def test_a_script_is_read_line_by_line(tmp_path):
    path = tmp_path / "answers"
    path.write_text("one\ntwo\n")
    with path.open() as file:
        assert not forget_typed_ahead(file.fileno())
        assert file.readline() == "one\n"
