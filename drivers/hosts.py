"""Names and addresses of computers, as people write them in files."""

import ipaddress


def why_no_host(host: str) -> str:
    """Return why a text is no name or address of a computer, as the end of a sentence, or an empty string."""
    if not host.strip():
        return "is empty"
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


def is_loopback_host(host: str) -> bool:
    """Return whether a host's name or address is this computer itself."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
