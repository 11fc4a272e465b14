"""A link to an instrument on a socket."""

from dataclasses import dataclass

from shearloop.drivers.connection import Link, Port, TcpPort
from shearloop.drivers.errors import DeviceNotFoundError


@dataclass(eq=False)
class TcpLink(Link):
    """Keeps a TCP connection to an instrument open."""

    host: str
    tcp_port: int

    async def _connect(self) -> Port:
        try:
            return await TcpPort.connect(self.host, self.tcp_port)
        except OSError as error:  # includes a timeout
            raise DeviceNotFoundError(
                f"Nothing answers at {self.host}:{self.tcp_port} ({error or 'no answer'}); see that it is on and its "
                "address is right."
            ) from error
