"""What reaches a terminal: characters that control it, or that it cannot show, are spelt, from every command."""

import io
import json
import os
import re
import subprocess
import sys

import pytest
import structlog

from shearloop.cli import main
from shearloop.cli.registry import COMMANDS
from shearloop.cli.terminal import StatusLine, print_estimate
from shearloop.daemon.logs import CLEAR_LINE, logging_to_stderr
from shearloop.daemon.messaging.messages import TOPICS, decode, encode, wire_map
from shearloop.daemon.run_summary import RunSummary
from shearloop.printable import PrintableStream, encodable, printable
from tests.sample_messages import sample
from tests.tools.recordings.every_message import made

# Clears the screen, in seven and in eight bits; a title; text from right to left; a new line of another program.
HOSTILE = "a\x1b[2Jb\x9b2Jc\x1b]0;t\x07d\u202ee\rf\x00g\x7f"
CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]")


def streams(monkeypatch, encoding: str) -> tuple[io.BytesIO, io.BytesIO]:
    """Give the process an output with this encoding, and return its bytes."""
    both = io.BytesIO(), io.BytesIO()
    for name, taken in zip(("stdout", "stderr"), both, strict=True):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(taken, encoding=encoding, write_through=True))
    return both


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize(
    "arguments", [["--help"], *([name, "--help"] for name in COMMANDS)], ids=lambda words: words[0]
)
def test_every_help_is_shown_by_every_terminal(arguments, encoding, monkeypatch):
    out, _ = streams(monkeypatch, encoding)
    with pytest.raises(SystemExit, match="0"):
        main(arguments)
    assert b"usage:" in out.getvalue()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_results_and_mistakes_are_shown_by_every_terminal(encoding, config, tmp_path, monkeypatch):
    one = made(tmp_path)
    odd = tmp_path / "µ…\udcff\U0001f600.yaml"
    out, err = streams(monkeypatch, encoding)
    assert main(["recording", "info", str(one.path)]) == 0
    assert main(["recording", "info", str(one.path), "--json"]) == 0
    assert main(["schema", "configuration"]) == 0
    main(["check", str(config())])
    main(["doctor", str(config())])
    assert main(["check", str(odd)]) == 2
    assert rb"\u2026\udcff\ud83d\ude00.yaml" in err.getvalue()
    (line,) = (line for line in out.getvalue().splitlines() if line.startswith(b'{"path"'))
    assert json.loads(line)["path"] == str(one.path)


@pytest.mark.parametrize(
    "settings", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}]
)
def test_a_process_in_another_locale_ends_well(settings, tmp_path):
    command = [sys.executable, "-m", "shearloop", "check", str(tmp_path / "µ.yaml")]
    ended = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, check=False)
    assert ended.returncode == 2
    assert b"Traceback" not in ended.stderr
    assert rb"\u00b5.yaml" in ended.stderr or b"\\udcc2\\udcb5.yaml" in ended.stderr


def test_a_file_says_nothing_to_the_terminal(tmp_path, ran, mistake):
    one = made(tmp_path)
    said = ran("recording", "info", one.path).out + mistake(
        "recording", "info", f"{tmp_path}/{HOSTILE.replace(chr(0), '')}"
    )
    assert not CONTROLS.search(said)
    assert r"\u001b[2J" in said


@pytest.mark.parametrize("as_json", [False, True])
def test_listen_shows_no_control_character_of_a_message(as_json, monkeypatch, capsys):
    texts = {
        "eit.estimate": {"reason": HOSTILE, "valid": False},
        "daemon.end": {"summary": HOSTILE},
        "loop.state": {"reasons": HOSTILE},
    }
    received = []
    for topic, changes in texts.items():
        message = sample(TOPICS[topic], source=HOSTILE, **changes)
        received.append((topic, decode(encode(wire_map(message, 1.5, 0)))))
    monkeypatch.setattr("shearloop.daemon.messaging.client.receive_messages", lambda *_: iter(received))
    assert main(["listen", *(["--json"] if as_json else [])]) == 0
    said = capsys.readouterr().out
    assert said.count(r"\u202e") >= len(texts)
    assert not CONTROLS.search(said)
    if as_json:
        assert [json.loads(line)["source"] for line in said.splitlines()] == [HOSTILE] * len(texts)


def test_log_status_line_estimates_and_summary_show_no_control_character(capsys):
    with logging_to_stderr(json_lines=False):
        structlog.get_logger().warning(HOSTILE, source=HOSTILE)
        try:
            raise ValueError(HOSTILE)
        except ValueError:
            structlog.get_logger().exception("failed")
    out = io.StringIO()
    estimate = decode(encode(wire_map(sample(TOPICS["eit.estimate"], valid=False, reason=HOSTILE), 1.5, 0)))
    print_estimate(out, "eit.estimate", estimate)
    with StatusLine(out) as line:
        line("eit.estimate", estimate)
    summary = RunSummary(out)
    for phase in ("running", "stopped"):
        state = sample(TOPICS["loop.state"], phase=phase, experiment=HOSTILE, activity=HOSTILE)
        summary("loop.state", wire_map(state, 1.5, 0))
    said = out.getvalue().replace(CLEAR_LINE, "") + capsys.readouterr().err
    assert r"\u001b[2J" in said
    assert "What happened" in said
    assert "ValueError" in said
    assert not CONTROLS.search(said)


def test_a_stream_escapes_what_is_not_the_programs_own():
    stream = PrintableStream(taken := io.StringIO())
    stream.write("\x1b[1mµ\t\n")
    stream.own.write("\r\x1b[K")
    assert taken.getvalue() == "\\u001b[1mµ\t\n\r\x1b[K"
    assert printable("plain µ\n") == "plain µ\n"
    assert encodable("N·m \U0001f600", "ascii") == r"N\u00b7m \ud83d\ude00"
    assert json.loads(f'"{encodable(chr(0x1F600), "ascii")}"') == "\U0001f600"


@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        (">&-", 0, ""),
        ("<&-", 0, ""),
        ("2>&-", 0, ""),
        (">/dev/full", 2, "shearloop: the output cannot be written: No space left on device\n"),
        (">/dev/full 2>&-", 2, ""),
    ],
)
def test_a_closed_or_full_output_is_no_crash(redirection, status, said):
    command = ["sh", "-c", f'exec "$@" {redirection}', "sh", sys.executable, "-m", "shearloop", "schema", "experiment"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (status, said)
