"""The log times of a recording by its monotonic stamps plus one offset, even if the wall clock was set meanwhile.

Recordings with schema.CLOCK_OFFSET have such log times. Others have log times of the wall clock as it was at each
message, and `MonotonicTimes` corrects them. Imported messages have no monotonic stamp: their log times stay.
"""

import heapq
import re
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TypeAlias

from mcap.records import Channel, Message

from shearloop.daemon.recorder import schema

# In a text of a message, the quotes have backslashes.
_STAMP = re.compile(rb'"t_mono_ns":\s*(\d{1,18})\b')

Messages: TypeAlias = Iterator[tuple[Channel, Message]]


class MonotonicTimes:
    """Corrects messages in the order of the file; the first with a monotonic stamp gives the offset."""

    def __init__(self) -> None:
        self._offset_ns: int | None = None

    def time_ns(self, channel: Channel, message: Message) -> int:
        """Return the Unix time of a message by the one offset."""
        stamp = None if has_one_offset(channel.metadata) else _STAMP.search(message.data)
        if stamp is None:
            return message.log_time
        t_mono_ns = int(stamp[1])
        if self._offset_ns is None:
            self._offset_ns = message.log_time - t_mono_ns
        return t_mono_ns + self._offset_ns

    def corrected(self, channel: Channel, message: Message) -> Message:
        """Return a message with log and publish time by the one offset."""
        t_ns = self.time_ns(channel, message)
        if t_ns == message.log_time:
            return message
        return replace(message, log_time=t_ns, publish_time=message.publish_time + t_ns - message.log_time)


def has_one_offset(identity: Mapping[str, str]) -> bool:
    """Return whether a recording of this identity has log times of one offset."""
    return schema.CLOCK_OFFSET in identity


def in_monotonic_order(first: tuple[Channel, Message], in_file_order: Callable[[], Messages]) -> Messages:
    """Yield corrected messages by time; `first` is the file's first with a monotonic stamp, selected or not.

    Reads the file twice, and holds only the messages that are out of order.
    """
    clock = MonotonicTimes()
    clock.time_ns(*first)
    times = array("q", (clock.time_ns(channel, message) for channel, message in in_file_order()))
    # The earliest time from each message on.
    earliest = array("q", times)
    for i in range(len(times) - 2, -1, -1):
        earliest[i] = min(earliest[i], earliest[i + 1])
    waiting: list[tuple[int, int, Channel, Message]] = []
    for number, (channel, message) in enumerate(in_file_order()):
        while waiting and waiting[0][0] <= earliest[number]:
            yield heapq.heappop(waiting)[2:]
        heapq.heappush(waiting, (times[number], number, channel, clock.corrected(channel, message)))
    while waiting:
        yield heapq.heappop(waiting)[2:]
