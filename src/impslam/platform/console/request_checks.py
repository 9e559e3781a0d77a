"""Check the size, host and origin of a request or socket."""

from __future__ import annotations

import re
from collections.abc import Collection

from impslam.platform.console import hosts
from impslam.platform.console.request import IncomingRequest, Refusal

MAX_TARGET = 4096  # bytes of path and query; those of the page are below 300
MAX_HEADERS = 16 * 1024  # bytes of all headers; browsers send below 2 kB
METHODS = frozenset({"GET", "HEAD", "POST"})

HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9_.-]+)(?::[0-9]{1,5})?", re.IGNORECASE)
_ODD = re.compile(r"[\x00-\x1f\x7f\\]|(?:^|/)\.\.?(?:/|$)")
_HIDDEN = re.compile(rb"%(?:2f|5c|00)", re.IGNORECASE)


def check_shape(request: IncomingRequest) -> Refusal | None:
    """Refuse a request that is larger, or of another form, than any of the page."""
    if len(request.target) > MAX_TARGET:
        return Refusal(414, "a long target", f"{len(request.target)} bytes")
    if request.size > MAX_HEADERS:
        return Refusal(431, "large headers", f"{request.size} bytes")
    if _ODD.search(request.path) or _HIDDEN.search(request.target.partition(b"?")[0]):
        return Refusal(400, "an odd path", request.target.partition(b"?")[0].decode("latin-1"))
    if request.method not in METHODS:
        return Refusal(405, "a method", request.method)
    return None


def check_host(request: IncomingRequest, names: Collection[str]) -> Refusal | None:
    """Refuse a host that is none of the names, nor the address of this server."""
    found = request.headers("host")
    match = HOST.fullmatch(found[0]) if len(found) == 1 else None
    if match is None:
        return Refusal(400, "no host", ", ".join(found))
    named = match[1].lower().rstrip(".").strip("[]")
    server = request.scope.get("server")
    if named in names or (server and plain(named) == plain(server[0])):
        return None
    return Refusal(421, "a foreign host", found[0])


def check_origin(request: IncomingRequest) -> Refusal | None:
    """Refuse requests from foreign pages, and changing requests without an origin.

    Cookies do not distinguish ports, so a page on another port of the same host counts as foreign
    here, regardless of `SameSite`. Only a link may lead here from anywhere.
    """
    origins, site = request.headers("origin"), request.header("sec-fetch-site")
    if any(origin.lower() != request.origin for origin in origins) or len(origins) > 1:
        return Refusal(403, "a foreign origin", ", ".join(origins))
    if request.changes and not origins:
        return Refusal(403, "no origin")
    link = request.header("sec-fetch-mode") == "navigate" and not request.changes
    framed = request.header("sec-fetch-dest") in {"iframe", "frame", "embed", "object"}
    if site not in {"", "same-origin", "none"} and (framed or not link):
        return Refusal(403, "a foreign origin", site)
    return None


def plain(address: str) -> str:
    """Return an address in its canonical form, any other text unchanged."""
    try:
        return str(hosts.ip(address))
    except ValueError:
        return address
