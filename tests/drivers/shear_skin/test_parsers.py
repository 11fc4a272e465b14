"""What the skin's instruments may send: sound replies come through, anything else is refused by kind, in any slices."""

import re
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.serial_sensor import LineSplitter
from shearloop.drivers.shear_skin.instruments import (
    MAX_REPLY_BYTES,
    PairParser,
    Reply,
    parse_numbers,
    read_elements,
    read_scan,
    split_replies,
)
from tests.slices import slices

VOLTS = st.floats(-0.6, 0.6).map(lambda volts: round(volts, 6))


CUTS = st.lists(st.integers(0, 400), max_size=8)


@given(st.lists(st.tuples(VOLTS, VOLTS), min_size=1, max_size=8), CUTS)
def test_every_line_of_the_board_comes_through_in_any_slices(pairs, cuts):
    parser = PairParser()
    data = b"2,0.123\r\n" + b"".join(f"{v1:.6f},{v2:.6f}\r\n".encode() for v1, v2 in pairs)
    found = [voltages for part in slices(data, cuts) for voltages in parser.feed(part, 10**9)]
    assert [(one.v1_v, one.v2_v) for one in found] == pairs
    assert [(one.over_1, one.over_2) for one in found] == [(abs(a) >= 0.51174, abs(b) >= 0.51174) for a, b in pairs]
    assert not parser.errors


def test_refused_lines_are_counted_by_kind():
    parser = PairParser()
    parser.feed(b"cut\n0.1,0.2,0.3\n0.1\n0,1\nnan,0.1\n\r\n" + b"1" * 50 + b"\n0.100000,0.200000\n", 0)
    assert parser.errors == {"not a number": 4, "empty": 1, "too long": 1}


@given(st.lists(st.from_regex(r"[ -~]{1,40}", fullmatch=True).filter(str.strip), max_size=6), CUTS)
def test_replies_come_through_whatever_ends_their_lines(replies, cuts):
    for end in (b"\n", b"\r", b"\r\n", b"\n\r"):
        lines = LineSplitter(MAX_REPLY_BYTES)
        data = b"".join(reply.encode() + end for reply in replies)
        assert [text for part in slices(data, cuts) for text in split_replies(lines, part)] == [
            r.strip() for r in replies
        ]


def test_a_flood_without_an_end_is_counted_once_and_forgotten():
    lines = LineSplitter(MAX_REPLY_BYTES)
    for _ in range(10):
        assert split_replies(lines, b"7" * 300) == []
    assert split_replies(lines, b"\n\xff\n0\n") == ["\N{REPLACEMENT CHARACTER}", "0"]
    assert lines.too_long == 1


@given(st.text(max_size=80))
def test_what_is_no_reading_is_refused_by_name(text):
    for read in (lambda: read_elements(Reply(text, 0, 0)), lambda: read_scan(Reply(text, 0, 2))):
        if re.fullmatch(r"[0-9Ee.,+ -]+", text):
            with suppress(ProtocolError):
                read()
        else:
            with pytest.raises(ProtocolError, match=r"^The (current source|scanner) sent"):
                read()


def test_the_manual_s_own_example_is_read():
    # Figure 17-1 of the 6430's manual, without the resistance and the time; 10 kΩ at 100 µA.
    reading = read_elements(Reply("+1.000206E+00, +1.000000E-04, +4.813200E+04", 0, 5))
    assert (reading.voltage_v, reading.current_a, reading.t_ns) == (1.000206, 1e-4, 5)
    assert reading.output_on
    assert not reading.compliance


@pytest.mark.parametrize("bit", [0, 3, 4, 16])
def test_every_way_of_not_keeping_its_current_is_compliance(bit):
    assert read_elements(Reply(f"+1.0E+00,+1.0E-09,{38916 | 1 << bit:+.6E}", 0, 0)).compliance


@pytest.mark.parametrize("text", ["+9.91E37,+5.0E-03,+3.8E+04", "1,2", "1,2,-1", "1,2,3E+08", "inf,nan,1", "1_0,2,3"])
def test_a_reading_that_was_not_made_is_refused(text):
    with pytest.raises(ProtocolError):
        read_elements(Reply(text, 0, 0))


def test_an_overload_of_the_scanner_names_its_channel():
    voltages = read_scan(Reply("+9.90000000E+37,-1.25000000E-01", 100, 300))
    assert (voltages.over_1, voltages.over_2, voltages.t_mid_ns) == (True, False, 200)
    assert parse_numbers("-1,2.5E3", 2, "It") == [-1.0, 2500.0]
