"""The URCap's socket as a face of the gripper: lines in, replies out, and a server for it."""

from collections.abc import Callable
from dataclasses import dataclass, field

from shearloop.drivers.emulators.ports import SocketServer
from shearloop.drivers.emulators.robotiq.gripper import Command, Gripper

PORT = 63352
LONGEST_LINE = 256
_FLAGS = {"ACT": "act", "GTO": "gto", "ATR": "atr", "ARD": "ard"}
_VALUES = {"POS": "pos", "SPE": "spe", "FOR": "force"}


@dataclass(slots=True)
class UrcapFace:
    """One connection. What is not understood gets no reply, as a client's mistake would show."""

    gripper: Gripper
    # The controller answers but has no data from the gripper: its values are `?`.
    no_data: bool = False
    _buffer: bytes = field(default=b"", init=False)

    def feed(self, data: bytes) -> bytes:
        """Return the replies to the lines that `data` completes."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        self._buffer = self._buffer[-LONGEST_LINE:]
        return b"".join(self._reply(line.decode("ascii", "replace").split()) for line in lines)

    def _reply(self, words: list[str]) -> bytes:
        match words:
            case ["GET", variable]:
                return self._get(variable)
            case ["SET", *pairs] if pairs and len(pairs) % 2 == 0:
                return self._set(dict(zip(pairs[::2], pairs[1::2], strict=True)))
        return b""

    def _get(self, variable: str) -> bytes:
        gripper = self.gripper
        gripper.heard()
        values = {
            "ACT": int(gripper.act),
            "GTO": int(gripper.gto),
            "ATR": int(gripper.command.atr),
            "ARD": int(gripper.command.ard),
            "SPE": gripper.command.spe,
            "FOR": gripper.command.force,
            "STA": gripper.sta,
            "OBJ": gripper.obj,
            "POS": gripper.pos,
            "PRE": gripper.pre,
            "FLT": gripper.flt,
            "COU": gripper.current,
            "SID": 9,
            "PCO": gripper.pos,
        }
        if self.no_data or variable not in values:
            return f"{variable} ?\n".encode()
        number = values[variable]
        text = f"{number:02d}" if variable == "FLT" else str(number)
        if variable == "FLT":
            gripper.status_was_read()
        return f"{variable} {text}\n".encode()

    def _set(self, pairs: dict[str, str]) -> bytes:
        if not pairs.keys() <= _FLAGS.keys() | _VALUES.keys():
            return b""
        if not all(text.isdigit() and int(text) <= 255 for text in pairs.values()):
            return b""
        self.gripper.heard()
        apply(self.gripper.command, {name: int(text) for name, text in pairs.items()})
        return b"ack"


def apply(command: Command, values: dict[str, int]) -> None:
    """Write variables by their names on the socket into the command registers."""
    for name, value in values.items():
        if name in _FLAGS:
            setattr(command, _FLAGS[name], bool(value))
        else:
            setattr(command, _VALUES[name], value)


class UrcapServer(SocketServer):
    """Serves the gripper's socket; on request it is lost, silent, or without data from the gripper."""

    def __init__(
        self,
        gripper: Gripper,
        host: str = "127.0.0.1",
        port: int = PORT,
        on_port: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(self._new_face, host, port, on_port)
        self._gripper = gripper
        self.no_data = False

    def _new_face(self) -> Callable[[bytes], bytes]:
        face = UrcapFace(self._gripper)

        def answer(data: bytes) -> bytes:
            face.no_data = self.no_data
            return face.feed(data)

        return answer
