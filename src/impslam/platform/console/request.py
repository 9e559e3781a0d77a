"""The data of a request or socket for the checks of the guard."""

from __future__ import annotations

from dataclasses import dataclass
from http.cookies import CookieError

from starlette.requests import cookie_parser
from starlette.types import Scope

from impslam.platform.console import login

FILES = ("/logs", "/maps")  # scripts may fetch these with user and password, without a session


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is refused: the status of the answer, and what is logged."""

    status: int
    what: str
    detail: str = ""


class IncomingRequest:
    """One request or socket, as the client sent it."""

    def __init__(self, scope: Scope) -> None:
        self.scope = scope
        self.socket: bool = scope["type"] == "websocket"
        self.method: str = "GET" if self.socket else scope["method"]
        self.path: str = scope["path"]
        self.target: bytes = scope.get("raw_path", b"") + b"?" + scope.get("query_string", b"")
        client = scope.get("client")
        self.address: str = client[0] if client else "unknown"

    def headers(self, name: str) -> list[str]:
        """Return the values of a header, in order."""
        key = name.encode()
        return [value.decode("latin-1") for header, value in self.scope["headers"] if header == key]

    def header(self, name: str) -> str:
        """Return the first value of a header, empty if it is missing."""
        return next(iter(self.headers(name)), "")

    @property
    def size(self) -> int:
        """Bytes of all headers."""
        return sum(len(name) + len(value) for name, value in self.scope["headers"])

    @property
    def origin(self) -> str:
        """The origin of a page of this server."""
        scheme = "https" if self.scope["scheme"] in {"https", "wss"} else "http"
        return f"{scheme}://{self.header('host')}".lower()

    @property
    def changes(self) -> bool:
        """Whether it may change something: a socket, or anything but GET and HEAD."""
        return self.socket or self.method not in {"GET", "HEAD"}

    @property
    def public(self) -> bool:
        """Whether it is served without a session."""
        return not self.socket and self.path in login.PATHS

    @property
    def by_script(self) -> bool:
        """Whether user and password may replace a session."""
        files = any(self.path == top or self.path.startswith(f"{top}/") for top in FILES)
        return files and not self.changes

    def cookie(self, name: str) -> str:
        """Return the value of a cookie, empty if it is missing."""
        try:
            return cookie_parser("; ".join(self.headers("cookie"))).get(name, "")
        except CookieError:
            return ""
