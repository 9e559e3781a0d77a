"""Authentication: the only place where passwords and one-time links become sessions."""

from __future__ import annotations

import asyncio
import base64
import binascii
import hmac
import logging
import math
import secrets
import time
from collections.abc import Callable

from impslam.errors import ImpError
from impslam.platform.console.accounts import MAX_LENGTH, Accounts, AccountsError
from impslam.platform.console.refusals import Refusals
from impslam.platform.console.session import Right, Session
from impslam.platform.console.session_store import Sessions, digest
from impslam.platform.console.throttle import Throttle

log = logging.getLogger(__name__)

LINK_LIFETIME = 600.0  # s; long enough to walk from the terminal to the browser
LINK_INTERVAL = 60.0  # s between links that are made because somebody opens the page
CACHE_LIFETIME = 300.0  # s that a correct password needs no new hash: logins, resumed downloads


class LoginRefused(ImpError):
    """A refused login; `wait` is the time until the next try is possible, s."""

    def __init__(self, message: str, wait: float = 0.0) -> None:
        super().__init__(message)
        self.wait = wait


class Authenticator:
    """Begins sessions with a password or, if none is set, with a one-time link.

    Parameters
    ----------
    accounts : the passwords
    secure : whether the page is served over TLS
    show : called with the path of a new one-time link, to print it in the terminal of the server
    clock : monotonic time, s
    """

    def __init__(
        self,
        accounts: Accounts,
        *,
        secure: bool,
        show: Callable[[str], None] = lambda path: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.accounts, self.secure = accounts, secure
        self.refusals = Refusals(clock)
        self.sessions = Sessions(clock, self.refusals.record)
        self._throttle = Throttle(clock)
        self._show, self._clock = show, clock
        self._link: tuple[bytes, float] | None = None
        self._link_shown_at = -math.inf
        self._version = accounts.version()
        self._secret = secrets.token_bytes(32)
        self._cache: dict[bytes, tuple[Right, float]] = {}  # correct passwords, so two at most
        self._hashing = asyncio.Semaphore(1)  # use one core at most

    @property
    def cookie(self) -> str:
        """Name of the cookie; with `__Host-`, browsers never send it to other hosts or over HTTP."""
        return "__Host-imp_session" if self.secure else "imp_session"

    def open_by_link(self) -> bool:
        """Return whether no password is set, so that the one-time link gives access."""
        try:
            return not self.accounts.rights()
        except AccountsError as error:
            log.error("%s", error)  # noqa: TRY400  # what to do is in the message
            return False

    def offer_link(self) -> float:
        """Show a new link if none is valid, at most one a minute.

        Return the time until a link can be shown, s; 0 if one is valid now.
        """
        moment = self._clock()
        pause = self._link_shown_at + LINK_INTERVAL - moment
        if not self.open_by_link() or (self._link is not None and moment < self._link[1]):
            return 0.0
        if pause > 0.0:
            return pause
        token = secrets.token_urlsafe(32)
        self._link, self._link_shown_at = (digest(token), moment + LINK_LIFETIME), moment
        self._show(f"/login?token={token}")
        return 0.0

    def redeem(self, address: str, token: str) -> tuple[str, Session]:
        """Return the token and session, with the right to drive, for the token of a link.

        Raises
        ------
        LoginRefused
            If the link was used, is too old, or never existed.
        """
        link, moment = self._link, self._clock()
        known = link is not None and hmac.compare_digest(link[0], digest(token))
        if link is None or not known or moment >= link[1] or not self.open_by_link():
            self.refusals.record(address, "a link that does not hold")
            raise LoginRefused("This link was used before, or is too old.")
        self._link = None
        return self._begin(address, "drive", "a link")

    async def enter(self, address: str, password: str) -> tuple[str, Session]:
        """Return the token and session for a password.

        Raises
        ------
        LoginRefused
            If the password is wrong, or too many were tried.
        """
        right = await self._check(address, password, "login")
        return self._begin(address, right, "a password")

    async def basic(self, address: str, header: str) -> Session | None:
        """Return a session for one request with basic authentication: the right and its password.

        Return None if they are wrong; the log says why.
        """
        user, password = _credentials(header)
        try:
            right = self._cached_right(password) or await self._check(
                address, password, "basic login"
            )
        except LoginRefused:
            return None
        if right != user:
            self.refusals.record(address, "basic login", "a wrong user")
            return None
        return Session(f"basic-{right}", f"{user}'s script", may_drive=False, clock=self._clock)

    def sweep(self) -> None:
        """End sessions if a password has changed, and log counts; call about once a second."""
        self.refusals.flush()
        version = self.accounts.version()
        if version != self._version:
            self._version = version
            self.close()
            log.warning("the passwords have changed: every session has ended")

    def close(self) -> None:
        """End every session, the link, and cached passwords."""
        self._link = None
        self._cache.clear()
        self.sessions.end_all()

    async def _check(self, address: str, password: str, what: str) -> Right:
        wait = self._throttle.wait(address)
        if wait > 0.0:
            self.refusals.record(address, what, "too many tries")
            raise LoginRefused("Too many attempts.", wait)
        right = self._cached_right(password) or await self._check_hash(password)
        if right is None:
            self.refusals.record(address, what, "a wrong password")
            raise LoginRefused("Wrong password.")
        self._throttle.forgive(address, wholly=right == "drive")
        return right

    async def _check_hash(self, password: str) -> Right | None:
        version = self._version
        try:
            async with self._hashing:
                right = await asyncio.to_thread(self.accounts.right, password[: MAX_LENGTH + 1])
        except AccountsError as error:
            log.error("%s", error)  # noqa: TRY400  # what to do is in the message
            raise LoginRefused("The robot cannot read its passwords; its log says why.") from None
        if right is not None and version == self.accounts.version():
            self._cache[self._key(password)] = right, self._clock() + CACHE_LIFETIME
        return right

    def _cached_right(self, password: str) -> Right | None:
        """Return the right of a recently used correct password, or None."""
        right, until = self._cache.get(self._key(password), (None, 0.0))
        fresh = self._clock() < until and self.accounts.version() == self._version
        return right if fresh else None

    def _key(self, password: str) -> bytes:
        return hmac.digest(self._secret, password.encode("utf-8", "replace"), "sha256")

    def _begin(self, address: str, right: Right, by: str) -> tuple[str, Session]:
        token, session = self.sessions.begin(right, address)
        role = "driver" if session.may_drive else "watcher"
        self.refusals.admit(address, f"logs in as {role}", f"{session.name}, by {by}")
        return token, session


def _credentials(header: str) -> tuple[str, str]:
    """Return user and password of a header `Basic ...` (RFC 7617), empty if it is invalid."""
    scheme, _, code = header.partition(" ")
    try:
        text = base64.b64decode(code.strip(), validate=True).decode()
    except (binascii.Error, UnicodeDecodeError):
        return "", ""
    user, _, password = text.partition(":")
    return (user, password) if scheme.lower() == "basic" else ("", "")
