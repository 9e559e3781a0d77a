"""Limit the pages of watchers: each takes memory, and time for its updates."""

from __future__ import annotations

from nicegui import Client

from impslam.platform.console.session import Session

MAX_UNOPENED = 3  # pages of a session without a socket so far; a browser opens it within a second
MAX_PAGES = 8  # pages of a session
MAX_WATCHER_PAGES = 24  # pages of all watchers


def make_room(session: Session) -> bool:
    """Return whether a session may have one more page; delete pages without a socket if necessary.

    nicegui itself keeps a page without a socket for a minute. It deletes a page that has lost its
    socket after 3 s; such a page must not be deleted twice.
    """
    if session.may_drive:
        return True
    pages = [(page, owner) for page in Client.instances.values() if (owner := _owner(page))]
    watched = [page for page, owner in pages if not owner.may_drive]
    mine = [page for page, owner in pages if owner is session]
    unopened = [page for page in mine if page.environ is None]
    gone = set(unopened[: max(0, len(unopened) - MAX_UNOPENED + 1)])
    others = [page for page in watched if page.environ is None and page not in gone]
    gone |= set(others[: max(0, len(watched) - len(gone) - MAX_WATCHER_PAGES + 1)])
    for page in gone:
        page.delete()
    return len(set(mine) - gone) < MAX_PAGES and len(set(watched) - gone) < MAX_WATCHER_PAGES


def _owner(page: Client) -> Session | None:
    """Return the session that a page was opened in."""
    found = getattr(page.request.state, "session", None)
    return found if isinstance(found, Session) else None
