"""`shearloop recording`: list, inspect, repair, export, replay and import recordings."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli import replay
from shearloop.cli.options import (
    PAPERS_RECORDINGS,
    add_action,
    add_fingertip,
    add_json,
    add_option,
    load_fingertip,
    run_action,
)
from shearloop.cli.output_paths import output_path
from shearloop.cli.terminal import one_line, print_result, table
from shearloop.errors import UserError
from shearloop.tools.outputs import check_new, check_overwrite, progress_bar, writing
from shearloop.tools.recordings.time_formats import DATENUM, STREAM_VARIABLES, TIME_FORMATS
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.tools.recordings.summary import RecordingSummary

# Exports in one file, and how it begins.
_SINGLE_FILES = {"mat": ("a MATLAB file", b"MATLAB"), "rrd": ("a file of Rerun", b"RRF")}

# Only the whole file has a checksum of them.
_DAMAGED_ELSEWHERE = (
    "A part outside of its messages is damaged, such as its header or metadata: a name there, of an experiment for "
    "instance, can be wrong."
)

run = run_action


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the actions of `recording`."""
    parts = parser.add_subparsers(dest="part", metavar="WHAT", required=True)
    listed = add_action(parts, "list", "list the recordings of a folder, oldest first", _list)
    text = "folder to search, with those below it (default: the present one)"
    add_option(listed, "folder", Path, "DIR", text, nargs="?", default=Path())
    listed.add_argument("--json", action="store_true", help="one JSON object per recording")
    info = add_action(parts, "info", "show the content of recordings, closed or not", _info)
    add_option(info, "recordings", Path, "REC", "recordings (.mcap or .mcap.partial)", nargs="+")
    info.add_argument("--json", action="store_true", help="one JSON object per recording")
    repair = add_action(parts, "repair", "copy the intact part of a damaged or unclosed one into a new one", _repair)
    add_option(repair, "recording", Path, "REC", "e.g. NAME.mcap.partial; it is not changed")
    add_option(repair, "--out", output_path, "FILE", "recording to write (default: NAME.mcap, or NAME.repaired.mcap)")
    add_json(repair)
    summary = "write a recording as tables, or for MATLAB, Rerun, LeRobot or `reproduce`"
    export = add_action(parts, "export", summary, _export)
    add_option(export, "recording", Path, "REC", "a closed recording (.mcap); `recording repair` closes another")
    choices = ("csv", "parquet", "mat", "rrd", "lerobot", "slices")
    export.add_argument("--format", choices=choices, default="csv", help="files to write (default: %(default)s)")
    add_option(export, "--out", output_path, "PATH", "folder to write; for mat and rrd a file (default: next to REC)")
    export.add_argument("--topic", action="append", metavar="TOPIC", help="export only this topic; repeatable")
    add_fingertip(export)
    add_json(export)
    summary = "send a recording through the same estimators again, as if live"
    replay.configure(add_action(parts, "replay", summary, replay.run))
    summary = "import other formats"
    imported = parts.add_parser("import", help=summary, description=summary, epilog=PAPERS_RECORDINGS)
    formats = imported.add_subparsers(dest="format", metavar="FORMAT", required=True)
    mat = add_action(formats, "mat", "import the paper's MATLAB streams", _import)
    variables = "; ".join(f"{stream}: {' or '.join(names)}" for stream, names in STREAM_VARIABLES.items())
    text = f".mat files of one recording, or its folder; the variable of each stream is {variables}"
    add_option(mat, "sources", Path, "SRC", text, nargs="+")
    add_option(mat, "--out", output_path, "REC", "recording to write, e.g. twist.mcap", required=True)
    formats_text = "; ".join(f"{name}: {form.words}" for name, form in TIME_FORMATS.items())
    text = f"what the first column's times are (default: %(default)s). {formats_text}"
    mat.add_argument("--time-format", choices=tuple(TIME_FORMATS), default=DATENUM, help=text)
    add_json(mat)


def _list(args: argparse.Namespace) -> int:
    from shearloop.tools.recordings.listing import list_recordings

    found = list_recordings(args.folder)
    if args.json:
        for recording in found:
            print(json.dumps(asdict(recording), ensure_ascii=False))
        return 0
    if not found:
        print(f"{args.folder}: no recording is in this folder or below it")
        return 0
    rows = []
    for recording in found:
        # A recording without an index has neither of these; an empty cell would look like a shifted row.
        began = "–" if recording.first_unix_ns is None else _local_time(recording.first_unix_ns)
        lasts = "–" if recording.duration_s is None else f"{recording.duration_s:.0f} s"
        unclosed = "being written" if recording.being_written else "not closed, or being written"
        remark = recording.unreadable or ("" if recording.closed else unclosed)
        ran = ", ".join(recording.experiments) or "–"
        rows.append((began, lasts, f"{recording.size_bytes / 1e6:.1f} MB", recording.path, ran, remark))
    print(*table(("from", "lasts", "size", "file", "experiment", "remark"), rows), sep="\n")
    return 0


def _local_time(unix_ns: int) -> str:
    return datetime.fromtimestamp(unix_ns / 1e9).astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


def _info(args: argparse.Namespace) -> int:
    from shearloop.tools.recordings.summary import summarise

    mistakes = []
    for path in args.recordings:
        try:
            with progress_bar(path.name, path.stat().st_size if path.is_file() else 0, "B") as progress:
                found = summarise(path, progress)
        except UserError as error:
            # The others are readable all the same.
            mistakes.append(str(error))
            continue
        print(json.dumps(asdict(found), ensure_ascii=False) if args.json else _summary_text(found), flush=True)
    if mistakes:
        raise UserError("\n".join(mistakes))
    return 0


def _summary_text(found: "RecordingSummary") -> str:
    from shearloop.daemon.recorder.schema import EMULATED, FORMAT_VERSION, REMARKS_NOTE, software_version

    lines = [found.path]
    if found.first_unix_ns is not None:
        began = _local_time(found.first_unix_ns)
        lines.append(f"  from     {began}, {found.duration_s:.1f} s, {found.size_bytes / 1e6:.2f} MB")
        named_ns = found.named_unix_ns
        if named_ns is not None and found.first_unix_ns < named_ns:
            waited = f"what was measured up to {(named_ns - found.first_unix_ns) / 1e9:.1f} s before waited for it"
            lines.append(f"  begun    {_local_time(named_ns)}, by its name; {waited}")
    lines.append(f"  source   {found.metadata.get('source', 'unknown: not a recording of shearloop')}")
    if EMULATED in found.metadata:
        lines.append("  EMULATED every device was emulated on that computer")
    if remarks := found.metadata.get(REMARKS_NOTE):
        lines.append(f"  import   {remarks}")
    lines += [f"  ran      {name}" for name in found.experiments]
    lines += [f"  tool     {found.tool_mm} mm"] if found.tool_mm is not None else []
    if software := found.metadata.get("software"):
        here = "the same code as here" if found.same_code else f"different code from here ({software_version()})"
        lines.append(f"  made by  shearloop {software}, {here}")
    version = found.metadata.get("format_version", FORMAT_VERSION)
    if version != FORMAT_VERSION:
        lines.append(f"  It has format version {version}, expected {FORMAT_VERSION}: other commands refuse it.")
    for name, topic in found.topics.items():
        rate = "" if topic.rate_hz is None else f"{topic.rate_hz:8.2f} Hz"
        plural = " " if topic.messages == 1 else "s"
        lines.append(f"  {name:<22} {topic.messages:>8} message{plural} {rate}".rstrip())
    lines += _other_keys(found)
    lines += [f"  attached {name}" for name in found.attachments]
    lines += [
        f"  {step.after_s:.1f} s after the first message: {step}; the times of the recording do not follow it."
        for step in found.clock_steps
    ]
    lines += _damage(found)
    if found.repaired_from is not None:
        lost = [_lost_text(found.lost_in_repair)] if found.lost_in_repair else []
        if found.torn_bytes_in_repair:
            lost.append(f"{counted(found.torn_bytes_in_repair, 'incomplete byte')} at the end")
        text = " and ".join(lost) or "nothing that its source showed"
        lines.append(f"  It is the repaired copy of {found.repaired_from}; lost there: {text}.")
    if found.dropped:
        dropped = counted(found.dropped, "message was", "messages were")
        lines.append(f"  {dropped} dropped because the disk was too slow.")
    return "\n".join(map(one_line, lines))


def _damage(found: "RecordingSummary") -> list[str]:
    """Return the lines on what is damaged or missing, and the cure."""
    lines = []
    repair = f"shearloop recording repair {shlex.quote(found.path)}"
    if not found.closed:
        cure = f"`{repair}` makes an indexed copy" if found.topics else "It holds no intact message"
        torn = counted(found.torn_bytes, "byte is", "bytes are")
        if found.being_written:
            lines.append("  It is being written, and its writer finishes it at the end of the run.")
        else:
            lines.append(f"  It was not closed, or is being written; {torn} incomplete. {cure}.")
    if found.damaged_chunks:
        lines.append(f"  {counted(found.damaged_chunks, 'chunk is', 'chunks are')} damaged and left out.")
    if found.damaged_attachments:
        lines.append(
            f"  {counted(found.damaged_attachments, 'attachment is', 'attachments are')} damaged and left out."
        )
    if found.damaged_index:
        lines.append("  Its index is damaged.")
    if found.damaged_elsewhere:
        lines.append(f"  {_DAMAGED_ELSEWHERE}")
    if found.lost:
        lines.append(f"  Lost with them: {_lost_text(found.lost)}.")
    if found.closed and found.topics and found.is_damaged:
        lines.append(f"  `{repair}` makes a copy that the other commands read.")
    return lines


def _other_keys(found: "RecordingSummary") -> list[str]:
    """Return the lines on topics and keys that differ from this version's."""
    lines = []
    for name, topic in found.topics.items():
        if topic.not_recorded:
            lines.append(f"  {name} was recorded without {', '.join(topic.not_recorded)}: exports have no value there.")
        if topic.differing:
            recorded = ", ".join(f"{key} {how}" for key, how in topic.differing.items())
            lines.append(f"  {name} was recorded with {recorded}: tables have this, and no command computes with it.")
        if not topic.known:
            lines.append(f"  {name} is a topic that this version does not have: csv, parquet, mat and rrd have it.")
        if topic.unknown:
            lines.append(f"  {name} was recorded with {', '.join(topic.unknown)}, which this version does not have.")
        if topic.problem:
            lines.append(f"  {name} cannot be read: {topic.problem}.")
    return lines


def _repair(args: argparse.Namespace) -> int:
    from shearloop.tools.recordings.repair import repair

    path = args.recording
    with progress_bar(path.name, path.stat().st_size if path.is_file() else 0, "B") as progress:
        result = repair(path, args.out, progress)
    lost = [f"{counted(result.torn_bytes, 'incomplete byte')} at the end"] if result.torn_bytes else []
    lost += [counted(result.damaged_chunks, "damaged chunk")] if result.damaged_chunks else []
    lost += [counted(result.damaged_attachments, "damaged attachment")] if result.damaged_attachments else []
    saved = counted(result.messages, "message is", "messages are")
    sentences = [f"{result.path}: {saved} saved; left out: {' and '.join(lost) or 'nothing'}."]
    if not result.was_damaged and not result.being_written:
        sentences.append(f"{path} was intact: it needs no repair, and the copy has the same content.")
    sentences += [f"Lost: {_lost_text(result.lost)}."] if result.lost else []
    if result.damaged_index:
        sentences.append("The index was damaged: the copy has a new one.")
    if result.damaged_elsewhere:
        sentences.append(_DAMAGED_ELSEWHERE)
    if result.being_written:
        sentences.append(f"{path} is being written: the copy ends with the present content.")
    return print_result({**asdict(result), "path": str(result.path)}, sentences, as_json=args.json)


def _lost_text(lost: Mapping[str, int]) -> str:
    return ", ".join(f"{count} of {topic}" for topic, count in lost.items())


def _destination(recording: Path, out: Path | None, form: str) -> Path:
    """Return the file or the folder to write; a file has the usual ending of its format."""
    stem = recording.name.partition(".mcap")[0]
    if form not in _SINGLE_FILES:
        return out or recording.with_name(f"{stem}_{form}")
    if out is None:
        return recording.with_name(f"{stem}.{form}")
    if out.is_dir():
        return out / f"{stem}.{form}"
    # A pipe has no ending.
    return out if out.suffix or os.path.lexists(out) else out.with_name(f"{out.name}.{form}")


def _export(args: argparse.Namespace) -> int:
    from shearloop.daemon.recorder.schema import INPUT
    from shearloop.tools.recordings.export import export
    from shearloop.tools.recordings.tables import RecordedTopics

    path, form = args.recording, args.format
    if args.fingertip is not None and form != "rrd":
        raise UserError(f"--fingertip is for --format rrd, which draws profiles of it: leave it out with {form}")
    kind = _SINGLE_FILES.get(form)
    out = _destination(path, args.out, form)
    if kind:
        check_overwrite(out, *kind)
    counts = RecordedTopics(path).counts
    unknown = [topic for topic in args.topic or () if topic not in counts]
    if unknown:
        raise UserError(f"{path} has no topic {unknown[0]!r}; it has {', '.join(counts)}")
    topics = args.topic or list(counts)
    if form in ("rrd", "lerobot", "slices"):
        topics = [topic for topic in topics if not topic.startswith(f"{INPUT}.")]
    with progress_bar(form, sum(counts[topic] for topic in topics), "message") as progress, writing(out, "the export"):
        if form == "rrd":
            from shearloop.tools.recordings.rerun_export import export_rerun

            written = [export_rerun(path, out, topics, load_fingertip(args.fingertip), progress)]
        elif form == "lerobot":
            from shearloop.tools.recordings.lerobot_export import export_lerobot

            written = export_lerobot(path, out, topics, progress)
        elif form == "slices":
            from shearloop.tools.recordings.slice_export import export_slices

            written, missed = export_slices(path, out, topics, progress)
            for reason, count in missed.items():
                print(f"{path}: {counted(count, 'hold')} without a slice: {reason}", file=sys.stderr)
        else:
            written = export(path, form, out, topics, progress)
    # Slices of several recordings may share a folder.
    if form not in (*_SINGLE_FILES, "slices") and (others := _others(written)):
        print(f"Not of this export, and there before: {', '.join(map(str, others))}.", file=sys.stderr)
    return print_result({"files": [str(path) for path in written]}, map(str, written), as_json=args.json)


def _others(written: Sequence[Path]) -> list[Path]:
    """Return files of the same kinds next to the files of an export, which look like a part of it."""
    kinds = {(path.parent, path.suffix) for path in written if path.is_file()}
    found = {path for folder, ending in kinds for path in folder.glob(f"*{ending}")}
    return sorted(found - {*written})


def _import(args: argparse.Namespace) -> int:
    from shearloop.daemon.recorder.writer import PARTIAL
    from shearloop.tools.recordings.matlab_import import import_mat

    if args.out.suffix == PARTIAL:
        raise UserError(f"{args.out} is a name of unfinished recordings; choose another --out, such as twist.mcap")
    # A run that was killed, or still goes on, has its recording under the second name.
    for name in (args.out.name, f"{args.out.name}{PARTIAL}"):
        check_new(args.out.with_name(name))
    imported = import_mat(args.sources, args.out, args.time_format)
    counts = [f"{counted(count, 'frame')} of the {side} side" for side, count in imported.frames.items()]
    torques = counted(imported.torques, "torque")
    if imported.torque_range_nm is not None:
        low_nm, high_nm = imported.torque_range_nm
        torques += f" from {low_nm:.3g} to {high_nm:.3g} N·m"
    sentence = f"{args.out}: {', '.join(counts)}, {torques}."
    return print_result({"path": str(args.out), **asdict(imported)}, [sentence, *imported.remarks], as_json=args.json)
