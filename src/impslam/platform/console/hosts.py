"""The names and addresses of this computer."""

from __future__ import annotations

import ipaddress
import socket

import ifaddr

from impslam.errors import ImpError

LOOPBACK = ("localhost", "127.0.0.1", "::1")


def loopback(host: str) -> bool:
    """Return whether `host` is reachable only from this computer.

    Raises
    ------
    ImpError
        If the name has no address.
    """
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        raise ImpError(f"host {host}: no such name or address; try 127.0.0.1 or 0.0.0.0") from None
    return all(ip(entry[4][0]).is_loopback for entry in found)


def names() -> tuple[str, ...]:
    """Return the names of this computer: host name, short, by mDNS, and localhost."""
    name = socket.gethostname().lower()
    return tuple(dict.fromkeys((name, _short(name), mdns_name(), "localhost")))


def mdns_name() -> str:
    """Return the name of this computer by mDNS, as in `robot.local`."""
    return f"{_short(socket.gethostname().lower())}.local"


def _short(name: str) -> str:
    return name.partition(".")[0]


def addresses() -> tuple[str, ...]:
    """Return the addresses of this computer, without link-local ones."""
    found = []
    for adapter in ifaddr.get_adapters():
        for given in adapter.ips:
            text = given.ip if isinstance(given.ip, str) else given.ip[0]
            address = ip(text)
            if not address.is_link_local:
                found.append(str(address))
    return tuple(sorted(dict.fromkeys(found)))


def ip(text: object) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Return an address in its canonical form: without zone, and as IPv4 if it is IPv4-mapped.

    Raises
    ------
    ValueError
        If it is not an address.
    """
    found = ipaddress.ip_address(str(text).partition("%")[0])
    mapped = found.ipv4_mapped if isinstance(found, ipaddress.IPv6Address) else None
    return mapped or found
