"""What is served: methods and paths, to those without a session and to those with one.

The guard refuses everything else before it reaches the page's toolkit, which would build a page of
its own, and keep it for a minute, to say that something is not found.
"""

from __future__ import annotations

import re

from impslam.platform.console.request import IncomingRequest, Refusal

PAGE = "/"
SOCKET = "/_nicegui_ws/socket.io/"
READ = frozenset({"GET", "HEAD"})
_SERVED = tuple(
    (re.compile(pattern), methods)
    for pattern, methods in (
        (PAGE, frozenset({"GET"})),
        (r"/login", READ | {"POST"}),
        (r"/logout", frozenset({"POST"})),
        (r"/login\.css|/favicon\.ico|/grid\.png|/camera\.jpg", READ),
        (r"/logs(/[^/]+)?|/maps(/[^/]+\.zip)?", READ),
        (
            r"/_nicegui/[^/]+/(static|libraries|components|resources|dynamic_resources|esm)/.+",
            READ,
        ),
    )
)


def route(request: IncomingRequest) -> Refusal | None:
    """Refuse a path that is not served, and a method that its path does not take."""
    what = f"{request.method} {request.path}"
    if request.socket:
        return None if request.path == SOCKET else Refusal(404, "a path", what)
    methods = next((taken for path, taken in _SERVED if path.fullmatch(request.path)), None)
    if methods is None:
        return Refusal(404, "a path", what)
    return None if request.method in methods else Refusal(405, "a method", what)
