"""Names and addresses of computers, as people write them in files."""

import contextlib
import ipaddress
import socket
import threading
import time
from collections.abc import Iterable, Mapping

# All names of one question together may take this long: a name server that is out of reach must not delay a start.
RESOLVED_WITHIN_S = 2.0


def why_no_host(host: str) -> str:
    """Return why a text is no name or address of a computer, as the end of a sentence, or an empty string."""
    if not host.strip():
        return "is empty"
    if host != host.strip():
        return "begins or ends with a space"
    if not is_address(host) and (unfit := set(host) & set(" :/@[]")):
        return f"is no name or address of a computer: take out {' and '.join(map(repr, sorted(unfit)))}, and any port"
    try:
        host.encode("idna")
    except UnicodeError:
        return "is no name or address of a computer"
    # A name may have digits, but not in all its parts: such a one is meant as an address.
    if all(part.isdecimal() for part in host.split(".")):
        try:
            ipaddress.IPv4Address(host)
        except ValueError:
            return f"is no address: {host} does not have four numbers up to 255"
    return ""


def one_spelling(host: str) -> str:
    """Return one spelling for all spellings of an address, or of a name; no name is looked up.

    The loopback address of IPv6, and the address of no interface, reach the same computer as 127.0.0.1.
    """
    name = host.strip().lower().removesuffix(".")
    try:
        # It reads every number that a connection accepts, such as 0x7f.1.
        address: ipaddress.IPv4Address | ipaddress.IPv6Address = ipaddress.IPv4Address(socket.inet_aton(name))
    except OSError:
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            with contextlib.suppress(UnicodeError):
                name = name.encode("idna").decode()
            return name
    if isinstance(address, ipaddress.IPv6Address):
        if address.is_loopback or address.is_unspecified:
            return "127.0.0.1"
        address = address.ipv4_mapped or address
    elif address.is_unspecified:
        return "127.0.0.1"
    return str(address)


def is_address(host: str) -> bool:
    """Return whether a host in its `one_spelling` is an address, and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_loopback_host(host: str) -> bool:
    """Return whether a host's name or address is this computer itself, by its text alone."""
    spelt = one_spelling(host)
    return spelt == "localhost" or (is_address(spelt) and ipaddress.ip_address(spelt).is_loopback)


def addresses_of(hosts: Iterable[str]) -> Mapping[str, frozenset[str]]:
    """Return the addresses of each host in their `one_spelling`; none of a name that is not found in time."""
    found: dict[str, frozenset[str]] = {}

    def look_up(name: str) -> None:
        with contextlib.suppress(OSError, UnicodeError):
            answers = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
            found[name] = frozenset(one_spelling(str(answer[4][0])) for answer in answers)

    spelt = {host: one_spelling(host) for host in hosts}
    names = {name for name in spelt.values() if not is_address(name)}
    # A look-up cannot be broken off, and must not keep the process from ending either.
    asking = [threading.Thread(target=look_up, args=(name,), name="look-up", daemon=True) for name in names]
    for thread in asking:
        thread.start()
    until_s = time.monotonic() + RESOLVED_WITHIN_S
    for thread in asking:
        thread.join(max(0.0, until_s - time.monotonic()))
    known = dict(found)
    return {
        host: frozenset({name}) if is_address(name) else known.get(name, frozenset()) for host, name in spelt.items()
    }
