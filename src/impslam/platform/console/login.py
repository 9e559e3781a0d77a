"""The login: a plain page with a form, without scripts."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from importlib.resources import files
from string import Template
from urllib.parse import parse_qs

from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from impslam.platform.console.authenticator import Authenticator, LoginRefused

PATHS = frozenset({"/login", "/login.css"})  # served without a session
POLICY = (
    "default-src 'none'; style-src 'self'; img-src data:; form-action 'self'; "
    "base-uri 'none'; frame-ancestors 'none'"
)

_FORM = """<form method="post" action="/login">
        <label for="password">Password, to drive or to watch</label>
        <input class="hidden" name="username" value="robot" autocomplete="username" readonly
          tabindex="-1" aria-hidden="true" />
        <input id="password" name="password" type="password" autocomplete="current-password"
          maxlength="256" required autofocus />
        <button>Log in</button>
      </form>"""
_LINK = """<p>No password is set, so this page opens only by a link that works once.
        $where</p>"""
_PRINTED = "The newest one is printed where <code>$program</code> runs."
_SOON = (
    "Open <a href='/login'>this page</a> again in $seconds s: a new one is then printed where "
    "<code>$program</code> runs."
)
_ENTER = '<p><a href="/">Open the page</a></p>'
_REDIRECT = '<meta http-equiv="refresh" content="0; url=/" />'


def routes(authenticator: Authenticator, title: str, program: str) -> Sequence[Route]:
    """Return the routes of `/login`, its style, and `/logout`; `program` prints the links."""
    endpoints = _LoginEndpoints(authenticator, title, program)
    return [
        Route("/login", endpoints.form, methods=["GET"]),
        Route("/login", endpoints.enter, methods=["POST"]),
        Route("/login.css", endpoints.css, methods=["GET"]),
        Route("/logout", endpoints.leave, methods=["POST"]),
    ]


class _LoginEndpoints:
    """Answers requests for login and logout."""

    def __init__(self, authenticator: Authenticator, title: str, program: str) -> None:
        folder = files("impslam.platform.console")
        self._authenticator, self._title, self._program = authenticator, title, program
        self._page = Template(folder.joinpath("login.html").read_text(encoding="utf-8"))
        self._style = folder.joinpath("login.css").read_bytes()

    async def form(self, request: Request) -> Response:
        token = request.query_params.get("token")
        if request.method == "GET" and token is not None:
            return self._use_link(request, token)
        if not self._authenticator.open_by_link():
            return self._page_with(_FORM)
        return self._page_with(self._link_offer())

    async def enter(self, request: Request) -> Response:
        try:
            fields = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=8)
        except ValueError:
            return self._page_with(_FORM, "Invalid login request.", status=400)
        try:
            token, _ = await self._authenticator.enter(
                address(request), fields.get("password", [""])[0]
            )
        except LoginRefused as error:
            return self._refused(error)
        return self._with_cookie(RedirectResponse("/", 303), token)

    async def leave(self, request: Request) -> Response:
        request.state.session.end()
        return self._with_cookie(RedirectResponse("/login", 303), "", max_age=0)

    async def css(self, _: Request) -> Response:
        return Response(self._style, media_type="text/css")

    def _use_link(self, request: Request, token: str) -> Response:
        try:
            token, _ = self._authenticator.redeem(address(request), token)
        except LoginRefused as error:
            return self._refused(error)
        # Not an HTTP redirect: if the link was opened from another site's page, browsers would not
        # send the strict cookie with a redirect.
        return self._with_cookie(self._page_with(_ENTER, head=_REDIRECT), token)

    def _refused(self, error: LoginRefused) -> Response:
        if error.wait > 0.0:
            seconds = math.ceil(error.wait)
            response = self._page_with(_FORM, f"{error} Wait {seconds} s.", status=429)
            response.headers["retry-after"] = str(seconds)
            return response
        return self._page_with(
            self._link_offer() if self._authenticator.open_by_link() else _FORM,
            str(error),
            status=401,
        )

    def _link_offer(self) -> str:
        """Offer a link, and return the text that says where it is printed."""
        seconds = math.ceil(self._authenticator.offer_link())
        where = Template(_SOON if seconds else _PRINTED)
        printed = where.substitute(seconds=seconds, program=self._program)
        return Template(_LINK).substitute(where=printed)

    def _page_with(
        self, body: str, message: str = "", head: str = "", status: int = 200
    ) -> Response:
        notice = f'<p class="refused" role="alert">{html.escape(message)}</p>' if message else ""
        text = self._page.substitute(
            title=html.escape(self._title), head=head, message=notice, body=body
        )
        return HTMLResponse(text, status, {"content-security-policy": POLICY})

    def _with_cookie(self, response: Response, token: str, max_age: int | None = None) -> Response:
        """Set the cookie: inaccessible to scripts, and never sent from other sites."""
        authenticator = self._authenticator
        response.set_cookie(
            authenticator.cookie,
            token,
            max_age,
            secure=authenticator.secure,
            httponly=True,
            samesite="strict",
        )
        return response


def address(request: Request) -> str:
    """Return the address of a client; headers of proxies are ignored."""
    return request.client.host if request.client is not None else "unknown"
