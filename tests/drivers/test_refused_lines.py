"""Refused lines are quoted in printable form, with who sends them and the cure."""

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.refused_lines import REPEATED, SHOWN_BYTES, refusal_of, sender_of, shown

EIT_LINE = b"0.1234, " * 100
# The line, the board that is expected, who sends it, and a part of the cure.
CASES = [
    (b"0,091\r", "load cell", "a program with a decimal comma", "firmware/hx711_torque"),
    (b"0,1234, 0,1234, ", "EIT-kit", "a program with a decimal comma", "0.1234, "),
    (b"torque: 0.091", "load cell", "a program that writes words beside the number", "firmware/hx711_torque"),
    (b"0.091 Nm", "load cell", "a program that writes words beside the number", "firmware/hx711_torque"),
    (b"HX711 not found.", "load cell", "a program that writes words beside the number", "firmware/hx711_torque"),
    (b"Board Initialized", "EIT-kit", "a program that writes messages", "0.1234, "),
    (b"nan", "load cell", "a program that divides by zero", "wires"),
    (b"-inf", "load cell", "a program that divides by zero", "wires"),
    (b"nan, ", "EIT-kit", "a program that divides by zero", "supply"),
    (b"\xf8\x80\x00\xfe", "load cell", "a board with another baud rate", "115200"),
    (b"", "load cell", "a program that writes empty lines", "firmware/hx711_torque"),
    (b"1.2e-3", "load cell", "a program that writes exponents", "firmware/hx711_torque"),
    (b"81250", "EIT-kit", "a load cell's board", "shearloop ports"),
    (b"-0.054321", "EIT-kit", "a load cell's board", "shearloop ports"),
    (b"0.1234", "EIT-kit", "an EIT-kit with its stock library", "all values of a frame in one line"),
    (EIT_LINE, "load cell", "an EIT-kit", "shearloop ports"),
    (EIT_LINE, "EIT-kit", "an EIT-kit", "USB cable"),
    (b"1.23456,1.23456", "load cell", "a converter board", "shearloop ports"),
    (b"81250", "skin's converter board", "a load cell's board", "shearloop ports"),
    (b"1;2;3", "load cell", "a board of another kind", "shearloop ports"),
]


@pytest.mark.parametrize(("line", "expected", "who", "cure"), CASES)
def test_a_refused_line_names_its_probable_sender_and_the_cure(line, expected, who, cure):
    found_who, found_cure = sender_of(line, expected)
    assert who in found_who
    assert cure in found_cure
    refusal = refusal_of(line, "the reason", expected)
    assert refusal.cure == found_cure
    assert "the reason" in refusal.cause


@given(st.binary(max_size=2000), st.sampled_from(["EIT-kit", "load cell", "skin's converter board"]))
def test_any_line_is_quoted_short_and_printable(line, expected):
    quoted = shown(line)
    assert set(quoted) <= {*string.printable, "…"} - {*"\n\r\t\x0b\x0c"}
    assert len(quoted) <= 4 * SHOWN_BYTES + 3
    sentence = refusal_of(line, "no number", expected).clause
    assert len(sentence) < 500
    assert sentence.startswith("refused ")


def test_a_single_refused_line_accuses_no_other_board():
    """Half of a converter board's line looks like a load cell's."""
    sentence = refusal_of(b"0.126000", "not a number", "skin's converter board", in_a_row=1).clause
    assert "load cell" not in sentence
    assert sentence.startswith("refused '0.126000': not a number. A single line like this has lost bytes on its way")
    assert "load cell" in refusal_of(b"0.126000", "not a number", "skin's converter board", in_a_row=REPEATED).cause
