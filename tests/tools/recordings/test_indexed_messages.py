"""Messages come as the mcap library's own reader gives them, also where chunks overlap and times are equal."""

import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from shearloop.tools.recordings.indexed_messages import in_file_order, in_time_order

TOPICS = ("a", "b", "c")


@pytest.fixture(scope="module", params=list(CompressionType))
def overlapping(request, tmp_path_factory) -> Path:
    """A recording of many chunks whose log times go back and forth and repeat; one topic ends early."""
    path, rng = tmp_path_factory.mktemp("chunks") / "a.mcap", random.Random(3)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=request.param)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channels = [writer.register_channel(topic, "json", schema, {"of": topic}) for topic in TOPICS]
        for number in range(600):
            channel = rng.choice(channels[: 3 if number < 200 else 2])
            log_time = number // 3 * 10 + rng.randrange(-20, 20) * 10 + 1000
            writer.add_message(channel, log_time, rng.randbytes(rng.randrange(0, 60)), number, sequence=number)
        writer.finish()
    return path


@pytest.mark.parametrize("topics", [None, ["a"], ["c"], ["a", "c"], ["d"]])
@pytest.mark.parametrize("by_log_time", [False, True])
def test_they_are_those_of_the_library_in_its_order(topics, by_log_time, overlapping):
    with overlapping.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert len(summary.chunk_indexes) > 10
        expected = [(channel, one) for _, channel, one in reader.iter_messages(topics, log_time_order=by_log_time)]
        found = list((in_time_order if by_log_time else in_file_order)(file, summary, topics))
    assert found == expected
    assert bool(found) == (topics != ["d"])
