"""A slip in --out costs nobody a file: commands write over what is of their own kind, and over nothing else."""

import argparse
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.io import savemat

from shearloop.cli.completion import arguments_of, full_parser, parts_of
from shearloop.cli.options import path_of
from shearloop.cli.output_paths import output_path
from shearloop.errors import UserError
from shearloop.tools.commission.report import earlier_report
from shearloop.tools.outputs import YAML_KEYS, check_overwrite, check_place
from shearloop.tools.recordings.tables import RecordedTopics

MCAP = b"\x89MCAP0\r\n and what cannot be recorded again"


def matlab() -> bytes:
    file = io.BytesIO()
    savemat(file, {"LF2data": np.zeros((4, 4))})
    return file.getvalue()


# Each mistake must be told before anything else is looked at, or solved for minutes; so nothing that is named is there.
WRITERS = pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("calibrate no.mcap --out", "an estimator's calibration"),
        ("adapt no.cal no.mcap --out", "an estimator's calibration"),
        ("calibrate load --mass-g 100 --lever-arm-mm 35 --port no --out", "a calibration file"),
        ("calibrate gripper --model 2F-140 --diameter-mm 10 --diameter-mm 20 --port no --out", "a calibration file"),
        ("skin calibrate no.csv --out", "a calibration file"),
        ("bank build --config {bank} --out", "a bank"),
        ("bank solve --mesh no --model step --k 1 --sigma 1 --out", "an array of NumPy"),
        ("bank design no.mcap --out", "a configuration"),
        ("recording export no.mcap --format mat --out", "a MATLAB file"),
    ],
)
BANK = Path(__file__).parents[2] / "config" / "banks" / "demo.yaml"


@WRITERS
def test_no_command_overwrites_a_file_of_another_kind(command, kind, tmp_path, mistake):
    there = tmp_path / "precious"
    there.write_bytes(MCAP)
    assert f"{there} exists and is not {kind}: it was not changed" in mistake(*command.format(bank=BANK).split(), there)
    assert there.read_bytes() == MCAP


@WRITERS
@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("none/a.png", "none/a.png: there is no folder"),
        ("file/a.png", "file/a.png: there is no folder"),
        ("folder.png", "folder.png is a folder; give the name of a file in it"),
        ("new.png", "new.png: you may not write in the folder"),
    ],
)
def test_no_command_begins_with_a_place_where_it_can_write_no_file(
    command, kind, out, said, tmp_path, monkeypatch, mistake
):
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    if out == "new.png":
        monkeypatch.setattr("os.access", lambda *_: False)
    if kind == "a MATLAB file" and out == "folder.png":
        # It writes a file in the folder, so that it reads the recording.
        said = "no.mcap"
    assert said in mistake(*command.format(bank=BANK).split(), tmp_path / out)
    assert {one.name for one in tmp_path.iterdir()} == {"file", "folder.png"}


def test_a_file_that_cannot_be_replaced_in_its_folder_is_refused_before_the_work(tmp_path, monkeypatch, mistake):
    """A new file replaces it, so that the right to write the folder decides; over a link, that of the file's folder."""
    locked = tmp_path / "locked"
    locked.mkdir()
    calibration, link = locked / "load.yaml", tmp_path / "link.yaml"
    calibration.write_text("a: 1\n")
    link.symlink_to(calibration)
    monkeypatch.setattr("os.access", lambda path, _: Path(path) != locked)
    for out in (calibration, link):
        said = mistake(*["calibrate", "load", "--mass-g", "100", "--lever-arm-mm", "35", "--port", "no", "--out"], out)
        assert f"{out}: you may not write in the folder {locked}" in said
    # What is no file is written to, and not replaced.
    check_place(Path(os.devnull))


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("recording export no.mcap --format csv --fingertip f.yaml", "--fingertip is for --format rrd, which draws"),
        ("view --foxglove 0 --new-token", "--new-token is of the page, and --foxglove serves Foxglove instead"),
        ("view --foxglove 0 --port 0", "--port is of the page"),
        ("view --foxglove 0 --commands ipc://x", "--commands is of the page"),
        ("view --foxglove 0 --fingertip f.yaml", "--fingertip is of the page"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(command, said, mistake):
    assert said in mistake(*command.split())


@pytest.mark.parametrize("command", ["recording import mat no.mat", "recording repair no.mcap"])
def test_no_command_overwrites_a_recording(command, tmp_path, mistake):
    """It cannot be made again."""
    there = tmp_path / "precious.mcap"
    there.write_bytes(MCAP)
    if "import" in command:
        killed = tmp_path / "killed.mcap.partial"
        killed.write_bytes(MCAP)
        assert f"{killed} exists already" in mistake(*command.split(), "--out", tmp_path / "killed.mcap")
        assert killed.read_bytes() == MCAP
        unfinished = mistake(*command.split(), "--out", tmp_path / "new.mcap.partial")
        assert "is a name of unfinished recordings" in unfinished
    assert f"{there} exists already" in mistake(*command.split(), "--out", there)
    assert there.read_bytes() == MCAP


@pytest.mark.parametrize("content", [MCAP, b"PK\x03\x04\x14\0", matlab(), b"\x8eSHLBANK", "σ".encode()[:1] + b"x"])
def test_text_overwrites_only_text(content, tmp_path):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(UserError, match="is not a configuration"):
        check_overwrite(tmp_path / "file", "a configuration")


def test_same_kind_empty_and_special_files_may_be_overwritten(tmp_path):
    file = tmp_path / "file"
    check_overwrite(file, "a bank", b"BANK")
    file.touch()
    check_overwrite(file, "a bank", b"BANK")
    file.write_bytes(b"BANK of old")
    check_overwrite(file, "a bank", b"BANK")
    # The last character that is looked at lies half beyond the end.
    file.write_text("x" * 511 + "σ", encoding="utf-8")
    check_overwrite(file, "a configuration")
    os.mkfifo(tmp_path / "pipe")
    check_overwrite(tmp_path / "pipe", "a bank", b"BANK")


TABLE = "r1_ohm,r2_ohm,shear_n,normal_n\n1.0,2.0,0.1,1.0\n"


@pytest.mark.parametrize(
    ("begins", "is_one"),
    [
        ("a: 1\n", True),
        ("# a remark\n\n---\n'a' : 1\n", True),
        ("# a remark that is longer than what is looked at" * 20, True),
        (TABLE, False),
        ("# a remark\n" + TABLE, False),
        ("\n" * 600, True),
        ("- a\n- b\n", False),
    ],
)
def test_keys_overwrite_only_keys(begins, is_one, tmp_path):
    (tmp_path / "file").write_text(begins)
    if is_one:
        check_overwrite(tmp_path / "file", "a calibration file", YAML_KEYS)
    else:
        with pytest.raises(UserError, match="is not a calibration file: it was not changed"):
            check_overwrite(tmp_path / "file", "a calibration file", YAML_KEYS)


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("skin calibrate no.csv --out", "a calibration file"),
        ("bank design no.mcap --out", "a configuration"),
        ("evaluate {cal} no.mcap --estimates", "a table of estimates"),
        ("evaluate --leave-out twists no.mcap --estimates", "a table of estimates"),
    ],
)
def test_no_command_overwrites_another_table(command, kind, tmp_path, mistake):
    there = tmp_path / "precious.csv"
    there.write_text(TABLE)
    (tmp_path / "cal").touch()
    said = mistake(*command.format(cal=tmp_path / "cal").split(), there)
    assert f"{there} exists and is not {kind}: it was not changed" in said
    assert there.read_text() == TABLE


class Slip(NamedTuple):
    """A command whose option `writes` names the file of its argument `reads`."""

    words: tuple[str, ...]
    parser: argparse.ArgumentParser
    writes: argparse.Action
    reads: argparse.Action

    def typed(self, out: Path, source: Path) -> list[str]:
        """Return the words of the command line."""
        values = {id(self.writes): str(out), id(self.reads): str(source)}
        positional, options = [], []
        for action in arguments_of(self.parser):
            value = values.get(id(action)) or (_any_value(action) if action.required else None)
            if value is not None and action.option_strings:
                options += [action.option_strings[-1], value]
            elif value is not None:
                positional.append(value)
        return [*self.words, *positional, *options]


def _any_value(action: argparse.Action) -> str:
    return str(next(iter(action.choices))) if action.choices else "1"


def slips() -> Iterator[Slip]:
    """Yield every option of every command that names what is written, with every other path of that command."""

    def below(parser: argparse.ArgumentParser, words: tuple[str, ...]) -> Iterator[Slip]:
        for name, part in parts_of(parser).items():
            yield from below(part, (*words, name))
        paths = [action for action in arguments_of(parser) if action.type in (path_of, output_path)]
        for writes in paths:
            for reads in paths:
                if writes.type is output_path and reads is not writes:
                    yield Slip(words, parser, writes, reads)

    yield from below(full_parser(), ())


def _all_actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    yield from arguments_of(parser)
    for part in parts_of(parser).values():
        yield from _all_actions(part)


def test_every_option_that_writes_a_file_is_known_as_one():
    writes = re.compile(r"\bto write\b|\bwrite the\b|\bfigure to draw\b|\bdraw figures\b|\bappend\b")
    found = {action.dest for action in _all_actions(full_parser()) if action.type is output_path}
    assert {"out", "estimates", "truth", "token_file"} == found
    for action in _all_actions(full_parser()):
        if action.type is path_of:
            assert "--out" not in action.option_strings
            assert not writes.search(action.help or ""), action.option_strings


@pytest.mark.parametrize("way", ["its name", "relative", "symbolic link", "hard link"])
@pytest.mark.parametrize(
    "slip", list(slips()), ids=lambda one: "-".join([*one.words, one.writes.dest, one.reads.dest]).replace(" ", "")
)
def test_no_command_writes_over_what_it_reads(slip, way, tmp_path, monkeypatch, mistake):
    source = out = tmp_path / "source"
    source.write_text(TABLE)
    if way == "relative":
        monkeypatch.chdir(tmp_path)
        out = Path("source")
    elif way == "symbolic link":
        out = tmp_path / "link"
        out.symlink_to(source)
    elif way == "hard link":
        out = tmp_path / "link"
        out.hardlink_to(source)
    said = mistake(*slip.typed(out, source))
    assert "are the same file or folder: nothing was changed" in said
    assert source.read_text() == TABLE


def outputs() -> Iterator[Slip]:
    """Yield every option of every command that names what is written, once."""
    yield from {(one.words, one.writes.dest): one for one in slips()}.values()


@pytest.mark.parametrize("way", ["missing", "itself"])
@pytest.mark.parametrize("slip", list(outputs()), ids=lambda one: "-".join([*one.words, one.writes.dest]))
def test_no_command_writes_through_a_link_to_nothing(slip, way, tmp_path, mistake):
    source, link = tmp_path / "source", tmp_path / "link"
    source.write_text(TABLE)
    link.symlink_to("missing" if way == "missing" else "link")
    said = mistake(*slip.typed(link, source))
    target = "missing" if way == "missing" else "link"
    assert f"{link} is a link to {target}, which leads to no file: nothing was changed; remove the link" in said
    assert {path.name for path in tmp_path.iterdir()} == {"source", "link"}


@pytest.mark.parametrize("words", [("init", "{}"), ("init", "{}/rig"), ("demo", "--folder", "{}")])
def test_a_folder_that_is_a_link_to_nothing_is_named(words, tmp_path, mistake):
    link = tmp_path / "link"
    link.symlink_to("missing")
    said = mistake(*(word.format(link) for word in words))
    assert f"{link}: the file cannot be written: it is a link to missing, which leads to no folder" in said
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


@pytest.mark.parametrize("form", ["csv", "mat", "rrd", "lerobot"])
def test_a_file_of_an_export_is_no_link_to_nothing_nor_to_the_recording(form, imported, tmp_path, mistake):
    out, content = tmp_path / "out", imported.read_bytes()
    links = {"csv": out / "units.csv", "mat": tmp_path / "out.mat", "rrd": tmp_path / "out.rrd"}
    link = links.get(form, out / "meta" / "info.json")
    link.parent.mkdir(parents=True, exist_ok=True)
    for target, why in ((tmp_path / "missing", "leads to no file"), (imported, "it was not changed|are the same file")):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        assert re.search(why, mistake("recording", "export", imported, "--format", form, "--out", out))
        assert imported.read_bytes() == content
        assert link.readlink() == target
        assert not (tmp_path / "missing").exists()


def test_an_export_to_a_link_writes_its_target_and_the_parts_beside_that(imported, tmp_path, ran, monkeypatch):
    monkeypatch.setattr("shearloop.tools.recordings.export._MAT_SIZE", 1000)
    target, link = tmp_path / "targets" / "a.mat", tmp_path / "link"
    target.parent.mkdir()
    target.touch()
    link.symlink_to(target)
    ran("recording", "export", imported, "--format", "mat", "--out", link)
    assert link.readlink() == target
    assert target.stat().st_size
    assert (target.parent / "a_2.mat").exists()
    assert not [*tmp_path.glob("link*_*"), *tmp_path.glob("link.*")]


def test_the_default_figure_is_no_calibration_and_no_other_picture(tmp_path, mistake):
    calibration, recording = tmp_path / "right.png", tmp_path / "twist.mcap"
    for path in (calibration, recording):
        path.write_text(TABLE)
    said = mistake("evaluate", calibration, recording, "--plot")
    assert f"--out {calibration} and CAL {calibration} are the same file" in said
    said = mistake("evaluate", tmp_path / "right.cal", recording, "--plot")
    assert f"{calibration} exists and is not a figure: it was not changed" in said
    assert calibration.read_text() == TABLE


def test_a_table_of_an_export_is_not_the_recording(imported, tmp_path, mistake):
    content = imported.read_bytes()
    recording = imported.rename(tmp_path / f"{next(iter(RecordedTopics(imported)))}.csv")
    said = mistake("recording", "export", recording, "--out", tmp_path)
    assert f"{recording} and the recording {recording} are the same file" in said
    assert recording.read_bytes() == content


def test_a_report_is_not_its_own_page(tmp_path):
    with pytest.raises(UserError, match=r"report\.html is the name of the report's page"):
        earlier_report(tmp_path / "report.html")


NAMED = pytest.mark.parametrize(
    ("command", "ending"),
    [
        ("evaluate {} no.mcap", "cal"),
        ("bank info {}", "bank"),
        ("recording info {}", "mcap"),
        ("recording export {}", "mcap"),
        ("recording repair {} --out x.mcap", "mcap"),
    ],
)


@NAMED
def test_a_name_that_no_file_can_have_is_refused_too(command, ending, tmp_path, mistake):
    assert "is the name of no file: too long" in mistake(*command.format(tmp_path / f"{300 * 'a'}.{ending}").split())


@NAMED
def test_a_missing_file_with_a_near_name_is_proposed(command, ending, tmp_path, mistake):
    (tmp_path / f"right.{ending}").write_bytes(b"")
    said = mistake(*command.format(tmp_path / f"rigth.{ending}").split())
    assert f"No such file or directory; did you mean {tmp_path}/right.{ending}?" in said
