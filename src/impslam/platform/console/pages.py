"""How many pages those may have who may not drive: each takes memory, and time for its updates."""

from __future__ import annotations

from nicegui import Client

from impslam.platform.console.session import Session

UNOPENED = 3  # pages of a session that no socket has opened yet; a browser does so within a second
OPEN = 8  # pages of a session
WATCHED = 24  # pages of all who may not drive


def room(session: Session) -> bool:
    """Return whether a session may have one more page; give up what nobody opened to make room.

    nicegui itself keeps a page for a minute that no socket has opened; what was opened and lost its
    socket it gives up after 3 s, and must not be given up twice.
    """
    if session.may_drive:
        return True
    pages = [(page, owner) for page in Client.instances.values() if (owner := _owner(page))]
    watched = [page for page, owner in pages if not owner.may_drive]
    mine = [page for page, owner in pages if owner is session]
    unopened = [page for page in mine if page.environ is None]
    gone = set(unopened[: max(0, len(unopened) - UNOPENED + 1)])
    others = [page for page in watched if page.environ is None and page not in gone]
    gone |= set(others[: max(0, len(watched) - len(gone) - WATCHED + 1)])
    for page in gone:
        page.delete()
    return len(set(mine) - gone) < OPEN and len(set(watched) - gone) < WATCHED


def _owner(page: Client) -> Session | None:
    """Return the session that a page was opened in."""
    found = getattr(page.request.state, "session", None)
    return found if isinstance(found, Session) else None
