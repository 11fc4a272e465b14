"""A damaged chunk costs its own messages and no others, and the report counts them by topic."""

import struct
import time
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import LoopState, wire_map
from shearloop.daemon.recorder.recorder import AttachedFile, Identity, Recorder
from shearloop.daemon.recorder.schema import CONFIGURATION, basic_identity
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.tools.recordings.reader import read_messages
from shearloop.tools.recordings.repair import repair
from shearloop.tools.recordings.summary import summarise
from tests.daemon.recorder.test_recorder import frame, torque
from tests.sample_messages import sample

CHUNKS, NUMBERS_PER_CHUNK = 4, 3
# The places of a chunk's head: its kind, its length (two bytes of it), the name of its compression.
PLACES = {"kind": 0, "length": 1, "length, far": 3, "compression": 42, "data": 60}
Found = set[tuple[str, int]]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> tuple[bytes, bytes]:
    """Return a recording with a topic that begins in the first chunk and one that begins later: closed, and killed."""
    folder = tmp_path_factory.mktemp("whole")
    attached = AttachedFile(CONFIGURATION, "application/json", b"{}")
    recorder = Recorder(folder, Identity(basic_identity("a test"), (attached,)), Clock())
    inputs = recorder.input_recorder("right")
    for number in range(CHUNKS * NUMBERS_PER_CHUNK):
        inputs.record(RawEvent(InputKind.DATA, time.monotonic_ns(), b"0.1, 0.2\r\n"))
        recorder.record_message("eit.frame", frame(number))
        recorder.record_message("load.torque", torque(number))
        if number >= NUMBERS_PER_CHUNK:
            state = sample(LoopState, source="loop")
            recorder.record_message("loop.state", wire_map(state, 0.0, number))
        if (number + 1) % NUMBERS_PER_CHUNK == 0:
            recorder.write()
    killed = recorder.path.read_bytes()
    recorder.close()
    return recorder.closed_files[0].read_bytes(), killed


def chunks(content: bytes) -> Iterator[tuple[int, Found]]:
    """Yield each chunk's place and its messages."""
    at = 8
    topics: dict[int, str] = {}
    while at + 9 < len(content):
        opcode, length = struct.unpack_from("<BQ", content, at)
        if opcode == Opcode.CHUNK:
            (chunk,) = _records(content[at : at + 9 + length])
            inside = breakup_chunk(chunk)
            topics.update({one.id: one.topic for one in inside if isinstance(one, Channel)})
            yield at, {(topics[one.channel_id], one.sequence) for one in inside if isinstance(one, Message)}
        at += 9 + length


def _records(content: bytes) -> list[Chunk]:
    reader = StreamReader(BytesIO(content), skip_magic=True, emit_chunks=True)
    return [one for one in islice(reader.records, 1) if isinstance(one, Chunk)]


def messages(path: Path) -> Found:
    with path.open("rb") as file:
        return {(channel.topic, message.sequence) for _, channel, message in make_reader(file).iter_messages()}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("number", range(CHUNKS))
def test_only_the_messages_of_a_damaged_chunk_are_missing(number, closed, place, recording, tmp_path):
    content = recording[0 if closed else 1]
    found = list(chunks(content))
    assert len(found) == CHUNKS
    everything = set.union(*(inside for _, inside in found))
    at, gone = found[number]
    damaged = bytearray(content)
    damaged[at + PLACES[place]] ^= 0x01
    path = tmp_path / "x.mcap"
    path.write_bytes(damaged)
    result = repair(path, tmp_path / "repaired.mcap")
    assert messages(result.path) == everything - gone
    assert result.messages == len(everything - gone)
    # A killed daemon's file has no index: a topic that only the damaged chunk had is not known.
    known = {topic for topic, _ in everything - gone} if not closed else {topic for topic, _ in everything}
    by_topic = dict(sorted(Counter(topic for topic, _ in gone if topic in known).items()))
    # A length that is wrong at the torn end of a killed daemon's file does not show what came after it.
    if closed or number < CHUNKS - 1 or place in ("compression", "data"):
        assert (result.lost, result.damaged_chunks) == (by_topic, 1)
    summary = summarise(path)
    assert (summary.lost, summary.damaged_chunks) == (result.lost, result.damaged_chunks)
    assert len(list(read_messages(result.path, sorted({topic for topic, _ in everything})))) == result.messages
    copy = summarise(result.path)
    assert copy.lost == {}, "what is repaired is whole"
    assert (copy.repaired_from, copy.lost_in_repair) == (str(path), result.lost)
    with result.path.open("rb") as file:
        assert [one.name for one in make_reader(file).iter_attachments()] == [CONFIGURATION]


def test_a_topic_defined_in_the_first_chunk_only_is_taken_from_the_index(tmp_path, ran):
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1)
        writer.start("x")
        writer.add_metadata("shearloop", basic_identity("another program"))
        channel = writer.register_channel(
            "load.torque", "json", writer.register_schema("load.torque", "jsonschema", b"{}")
        )
        for number in range(5):
            writer.add_message(channel, 10**18 + number, b'{"torque_nm": 0.1}', 10**18, number)
        writer.finish()
    content = bytearray(path.read_bytes())
    at = next(at for at, inside in chunks(bytes(content)) if inside)
    content[at + 60] ^= 0x01
    path.write_bytes(content)
    result = repair(path)
    assert (result.messages, result.lost) == (4, {"load.torque": 1})
    assert messages(result.path) == {("load.torque", number) for number in range(1, 5)}
    # A copy that is repaired again, here because its end is torn off, still names what is lost.
    copy = result.path
    copy.write_bytes(copy.read_bytes()[:-20])
    again = repair(copy)
    third = repair(again.path, tmp_path / "third.mcap")
    for one in (again, third):
        summary = summarise(one.path)
        assert (summary.repaired_from, summary.lost_in_repair) == (str(path), {"load.torque": 1})
        assert summary.torn_bytes_in_repair == again.torn_bytes
        said = ran("recording", "info", one.path).out
        assert f"the repaired copy of {path}; lost there: 1 of load.torque" in said
        assert ("incomplete byte" in said) is (again.torn_bytes > 0)


def test_bytes_of_a_damaged_chunk_that_look_like_a_record_cost_no_other_chunk(tmp_path):
    """Where its length says one byte too few, its last byte, here the number of a message, seems to begin a record."""
    path = tmp_path / "x.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1, compression=CompressionType.NONE)
        writer.start("x")
        writer.add_metadata("shearloop", basic_identity("another program"))
        schema = writer.register_schema("load.torque", "jsonschema", b"{}")
        channel = writer.register_channel("load.torque", "json", schema)
        for number in range(5):
            writer.add_message(channel, 10**18 + number, bytes(4000 + number % 2) + b"\x05", 10**18, number)
        writer.finish()
    content = path.read_bytes()
    odd = [(at, inside) for at, inside in chunks(content) if inside and content[at + 1] & 1]
    assert odd
    for at, inside in odd:
        damaged = bytearray(content)
        damaged[at + 1] ^= 0x01
        path.write_bytes(damaged)
        repaired = tmp_path / f"{at}.mcap"
        assert repair(path, repaired).lost == {"load.torque": 1}
        assert messages(repaired) == {("load.torque", number) for number in range(5)} - inside


def test_a_damaged_attachment_is_left_out_and_counted(recording, tmp_path, ran):
    content = bytearray(recording[0])
    content[content.index(b"application/json") + 24] ^= 0x01
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    assert "1 attachment is damaged and left out." in ran("recording", "info", path).out
    printed = ran("recording", "repair", path).out
    assert "left out: 1 damaged attachment." in printed
    assert summarise(tmp_path / "x.repaired.mcap").attachments == []


def test_the_report_names_the_losses(recording, tmp_path, ran):
    content = bytearray(recording[0])
    at, _ = next(chunks(bytes(content)))
    content[at + 60] ^= 0x01
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    said = "3 of eit.frame.right, 1 of input.clock, 3 of input.right, 3 of load.torque."
    assert f"Lost with them: {said}" in ran("recording", "info", path).out
    assert f"left out: 1 damaged chunk.\nLost: {said}" in ran("recording", "repair", path).out


@pytest.mark.parametrize("place", [1, 40])
@pytest.mark.parametrize("closed", [True, False])
def test_the_identity_stands_in_every_chunk(place, closed, recording, tmp_path):
    content = bytearray(recording[0 if closed else 1])
    # The record's length, or a letter of a key.
    content[content.index(b"\x09\0\0\0shearloop", 50) - 9 + place] ^= 0x01
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    result = repair(path, tmp_path / "repaired.mcap")
    assert result.lost == {}
    assert len(list(read_messages(result.path, ["load.torque"]))) == CHUNKS * NUMBERS_PER_CHUNK
    assert summarise(result.path).metadata["source"] == summarise(path).metadata["source"] == "a test"


@pytest.mark.parametrize("closed", [True, False])
def test_a_damaged_record_that_is_no_chunk_costs_no_message(closed, recording, tmp_path):
    content = bytearray(recording[0 if closed else 1])
    at, _ = list(chunks(bytes(content)))[1]
    # The length of the first record of times behind the chunk.
    content[at + 9 + struct.unpack_from("<Q", content, at + 1)[0] + 1] ^= 0x01
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    result = repair(path, tmp_path / "repaired.mcap")
    assert (result.damaged_chunks, result.lost) == (0, {})
    assert messages(result.path) == set.union(*(inside for _, inside in chunks(recording[0])))
