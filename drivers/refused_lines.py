"""What a line that a parser refuses looks like: the line in printable form, who sends such lines, and the cure."""

import re
from dataclasses import dataclass
from typing import Final, Literal

from shearloop.errors import Hint

BoardKind = Literal["EIT-kit", "load cell", "skin's converter board"]

# So many lines that are refused in a row show who sends them. A single one may be a part of the board's own line.
REPEATED: Final = 3
# Characters of a refused line in a message.
SHOWN_BYTES: Final = 40

# The cure of bytes that were lost or changed.
CABLE: Final = "replace the USB cable if more of them come"
_EXCHANGE: Final = "name each board by its own port in the configuration (`shearloop ports` lists them)"
_SKETCH: Final = {
    "EIT-kit": "load the program that sends all values of a frame in one line, each as `0.1234, `",
    "load cell": "load the sketch in firmware/hx711_torque, which sends a number a line",
    "skin's converter board": "let its program send `1.2345,1.2345`, both voltages in one line",
}
_OWN: Final = "replace the USB cable, and check that it is the board that the configuration and its files are made for"
_BAUD: Final = "let its program use 115200 baud"


@dataclass(frozen=True, slots=True)
class _Sender:
    """Lines of one form: who sends them, which board that is, and the cure.

    Without board and cure the board needs its own program.
    """

    form: re.Pattern[bytes]
    who: str
    board: BoardKind | None = None
    cure: str = ""
    # An EIT-kit sends such lines too, with its stock library.
    stock_library: bool = False


# The first that matches the whole line counts.
_SENDERS: Final = (
    _Sender(re.compile(rb"\s*"), "a program that writes empty lines"),
    _Sender(re.compile(rb".*[^\x20-\x7e\t\r].*", re.DOTALL), "a board with another baud rate", cure=_BAUD),
    _Sender(re.compile(rb"(\d\.\d{4}, ?){4,}.*"), "an EIT-kit", "EIT-kit"),
    _Sender(re.compile(rb"[+-]?\d+\.\d+, ?[+-]?\d+\.\d+\s*"), "a converter board", "skin's converter board"),
    _Sender(re.compile(rb"[+-]?\d+\s*"), "a load cell's board", "load cell"),
    _Sender(
        re.compile(rb"[+-]?\d\.\d{4}\s*"),
        "a load cell's board, or an EIT-kit with its stock library,",
        "load cell",
        stock_library=True,
    ),
    _Sender(re.compile(rb"[+-]?\d*\.\d+\s*|[+-]?\d+\.\s*"), "a load cell's board", "load cell"),
    _Sender(re.compile(rb"([+-]?\d+,\d+[;, \t]*)+\s*"), "a program with a decimal comma"),
    _Sender(re.compile(rb"[+-]?\d*\.?\d+[eE][+-]?\d+\s*"), "a program that writes exponents"),
    _Sender(
        re.compile(rb"[+-]?(nan|inf|ovf)(inity)?\W*", re.IGNORECASE),
        "a program that divides by zero or has no converter",
        cure="check the board's supply and the wires to its converter, then restart it",
    ),
    _Sender(re.compile(rb".*[A-Za-z].*\d.*|.*\d.*[A-Za-z].*"), "a program that writes words beside the number"),
    _Sender(re.compile(rb".*[A-Za-z].*"), "a program that writes messages"),
    _Sender(re.compile(rb"[\d.,\s+-]*"), "a board of another kind, or one that loses bytes,"),
)


def shown(line: bytes) -> str:
    """Return a line in quotes, shortened, with escapes for bytes that cannot be printed."""
    return repr(line[:SHOWN_BYTES])[1:] + ("…" if len(line) > SHOWN_BYTES else "")


def sender_of(line: bytes, expected: BoardKind) -> tuple[str, str]:
    """Return who sends such lines, and what to do where the expected board should send."""
    sender = next((sender for sender in _SENDERS if sender.form.fullmatch(line)), None)
    if sender is None:
        return "a board of another kind", _EXCHANGE
    if sender.board is None:
        return sender.who, sender.cure or _SKETCH[expected]
    if sender.board == expected:
        return sender.who, _OWN
    if expected == "EIT-kit" and sender.stock_library:
        return sender.who, f"{_EXCHANGE}, or {_SKETCH[expected]}"
    return sender.who, _EXCHANGE


def refusal_of(line: bytes, reason: str, expected: BoardKind, in_a_row: int = REPEATED) -> Hint:
    """Return the line with the reason against it, and the cure; of repeated ones who sends them."""
    found = f"refused {shown(line)}: {reason}"
    if in_a_row < REPEATED:
        return Hint(f"{found}. A single line like this has lost bytes on its way", CABLE)
    who, cure = sender_of(line, expected)
    return Hint(f"{found}. {who[0].upper()}{who[1:].rstrip(',')} sends such lines", cure)
