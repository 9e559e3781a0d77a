"""The methods and paths that are served.

The guard refuses all others, so that they do not reach nicegui, which would build a page for "not
found" and keep it for a minute.
"""

from __future__ import annotations

import re

from impslam.platform.console.request import IncomingRequest, Refusal

PAGE = "/"
SOCKET = "/_nicegui_ws/socket.io/"
READ = frozenset({"GET", "HEAD"})
_ROUTES = tuple(
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


def check_route(request: IncomingRequest) -> Refusal | None:
    """Refuse a path that is not served, and a method that its path does not accept."""
    what = f"{request.method} {request.path}"
    if request.socket:
        return None if request.path == SOCKET else Refusal(404, "a path", what)
    methods = next((taken for path, taken in _ROUTES if path.fullmatch(request.path)), None)
    if methods is None:
        return Refusal(404, "a path", what)
    return None if request.method in methods else Refusal(405, "a method", what)
