"""Lines come through whole in any slices; what is no line is counted once."""

from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.serial_sensor import LineSplitter

LONGEST = 8


@given(st.lists(st.binary(max_size=2 * LONGEST), max_size=12))
def test_slices_change_nothing_and_every_line_is_given_or_counted(slices):
    data = b"".join(slices)
    whole, sliced = LineSplitter(LONGEST), LineSplitter(LONGEST)
    expected = whole.feed(data)
    assert [line for part in slices for line in sliced.feed(part)] == expected
    *ended, rest = data.split(b"\n")
    assert expected == [line if len(line) <= LONGEST else None for line in ended] + [None] * (len(rest) > LONGEST)
    assert whole.too_long == sliced.too_long == sum(len(line) > LONGEST for line in [*ended, rest])


def test_what_had_begun_when_the_port_was_opened_again_is_forgotten():
    for begun, too_long in ((b"1\n2", 0), (b"7" * 20, 1)):
        lines = LineSplitter(LONGEST)
        lines.feed(begun)
        lines.restart()
        assert lines.feed(b"3\n") == [b"3"]
        assert lines.too_long == too_long
