"""Names and addresses of computers, as people write them in files."""

import contextlib
import ipaddress
import socket


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

    `localhost`, the loopback address of IPv6 and the address of no interface reach the same computer as 127.0.0.1.
    """
    name = host.strip().lower().removesuffix(".")
    if name == "localhost":
        return "127.0.0.1"
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
    return is_address(spelt) and ipaddress.ip_address(spelt).is_loopback


def why_no_address(host: str) -> str:
    """Return why a text is no address of a device, with the cure, as the end of a sentence; empty for an address.

    A name can mean another device tomorrow, except `localhost`. It is looked up only to tell its present address, which
    takes at most 2 s.
    """
    if reason := why_no_host(host):
        return f"{reason}; give the device's address"
    if is_address(one_spelling(host)):
        return ""
    # Only the mistake needs it.
    from shearloop.drivers.name_look_up import look_up

    name = "is a name, which can mean another device tomorrow"
    if present := dict.fromkeys(map(one_spelling, look_up(host))):
        return f"{name}: write {' or '.join(present)}, which {host!r} means now"
    return f"{name}, and it cannot be looked up now: write the device's address"
