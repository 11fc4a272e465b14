"""The messages of a closed recording, chunk by chunk.

The mcap library's own reader parses the channels and schemas that every chunk repeats, which takes most of its time.
"""

import heapq
import struct
from collections.abc import Collection, Iterator
from typing import IO, TypeAlias

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Message
from mcap.stream_reader import get_chunk_data_stream
from mcap.summary import Summary

# A record's opcode and length; a message's channel, number and times, and its content behind them.
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")

Found: TypeAlias = tuple[Channel, Message]


def in_file_order(file: IO[bytes], summary: Summary, topics: Collection[str] | None) -> Iterator[Found]:
    """Yield channel and message of some topics or of all, in the order of the file."""
    for index in _chunks(summary, topics):
        yield from _messages(file, summary, index, topics)


def in_time_order(file: IO[bytes], summary: Summary, topics: Collection[str] | None) -> Iterator[Found]:
    """Yield channel and message of some topics or of all by log time; those of one time in the order of the file."""
    waiting: list[tuple[int, int, int, Found]] = []
    for index in sorted(_chunks(summary, topics), key=lambda one: (one.message_start_time, one.chunk_start_offset)):
        # No later chunk has an earlier message.
        while waiting and waiting[0][:2] < (index.message_start_time, index.chunk_start_offset):
            yield heapq.heappop(waiting)[3]
        for number, found in enumerate(_messages(file, summary, index, topics)):
            heapq.heappush(waiting, (found[1].log_time, index.chunk_start_offset, number, found))
    while waiting:
        yield heapq.heappop(waiting)[3]


def _chunks(summary: Summary, topics: Collection[str] | None) -> Iterator[ChunkIndex]:
    """Yield the chunks that may have messages of the topics."""
    for index in summary.chunk_indexes:
        channels = [summary.channels[number].topic for number in index.message_index_offsets]
        if topics is None or not channels or any(topic in topics for topic in channels):
            yield index


def _messages(file: IO[bytes], summary: Summary, index: ChunkIndex, topics: Collection[str] | None) -> Iterator[Found]:
    """Yield channel and message of a chunk; raises many types of errors for a damaged one."""
    file.seek(index.chunk_start_offset + _RECORD.size)
    stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(file)), validate_crc=True)
    data, at = stream.read(size), 0
    while at < size:
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if opcode == Opcode.MESSAGE:
            number, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, at)
            channel = summary.channels[number]
            if topics is None or channel.topic in topics:
                content = data[at + _MESSAGE.size : at + length]
                yield channel, Message(number, log_time, content, publish_time, sequence)
        at += length
