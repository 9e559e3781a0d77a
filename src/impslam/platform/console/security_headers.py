"""The security headers of every answer."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from starlette.types import Message, Send

from impslam.platform.console.request import IncomingRequest
from impslam.platform.console.request_checks import HOST

PAGE_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' {socket}; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "form-action 'self'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"same-origin",  # not `no-referrer`: a form would then send no origin
    b"permissions-policy": b"camera=(), geolocation=(), microphone=()",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
}


class SecurityHeaders:
    """Adds security headers to every answer, and removes those of CORS and the server."""

    def __init__(self, request: IncomingRequest, send: Send) -> None:
        self._request, self._send = request, send

    async def __call__(self, message: Message) -> None:
        """Send a message, with the headers if it begins an answer."""
        if message["type"] in {"http.response.start", "websocket.http.response.start"}:
            message = {**message, "headers": self._headers(message.get("headers", []))}
        await self._send(message)

    def _headers(self, headers: Iterable[tuple[bytes, bytes]]) -> list[tuple[bytes, bytes]]:
        given = [(name.lower(), value) for name, value in headers]
        names = {name for name, _ in given}
        ours = dict(_HEADERS)
        if b"content-security-policy" not in names:
            ours[b"content-security-policy"] = self._policy().encode("latin-1")
        if not self._request.path.startswith("/_nicegui/") or b"cache-control" not in names:
            ours[b"cache-control"] = b"no-store"
        kept = [
            (name, value)
            for name, value in given
            if name not in ours and not name.startswith(b"access-control-") and name != b"server"
        ]
        return [*kept, *ours.items()]

    def _policy(self) -> str:
        # 'self' does not cover sockets in older browsers; the guard checks the host.
        match = HOST.fullmatch(self._request.header("host"))
        socket = f"ws{self._request.origin[4:]}" if match else ""
        return PAGE_POLICY.format(socket=socket)
