"""The login: a plain page that needs no script, so that it works wherever a form does."""

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

PATHS = frozenset({"/login", "/login.css"})  # what is served without a session
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
_LINK = """<p>No password is set, so this page opens by a link that is good once.
        $where</p>"""
_PRINTED = "The newest one is printed where <code>imp robot</code> runs."
_SOON = (
    "Open <a href='/login'>this page</a> again in $seconds s: a new one is then printed where "
    "<code>imp robot</code> runs."
)
_ENTER = '<p><a href="/">Open the page</a></p>'
_GO_ON = '<meta http-equiv="refresh" content="0; url=/" />'


def routes(authenticator: Authenticator, title: str) -> Sequence[Route]:
    """Return `/login`, `/logout` and what the page of the login needs."""
    endpoints = _LoginEndpoints(authenticator, title)
    return [
        Route("/login", endpoints.form, methods=["GET"]),
        Route("/login", endpoints.enter, methods=["POST"]),
        Route("/login.css", endpoints.css, methods=["GET"]),
        Route("/logout", endpoints.leave, methods=["POST"]),
    ]


class _LoginEndpoints:
    """Answers requests for the login."""

    def __init__(self, authenticator: Authenticator, title: str) -> None:
        folder = files("impslam.platform.console")
        self._authenticator, self._title = authenticator, title
        self._page = Template(folder.joinpath("login.html").read_text(encoding="utf-8"))
        self._style = folder.joinpath("login.css").read_bytes()

    async def form(self, request: Request) -> Response:
        token = request.query_params.get("token")
        if request.method == "GET" and token is not None:
            return self._follow(request, token)
        if not self._authenticator.open_by_link():
            return self._shown(_FORM)
        return self._shown(self._offered())

    async def enter(self, request: Request) -> Response:
        try:
            fields = parse_qs((await request.body()).decode("utf-8", "replace"), max_num_fields=8)
        except ValueError:
            return self._shown(_FORM, "That was no login.", status=400)
        try:
            token, _ = await self._authenticator.enter(
                address(request), fields.get("password", [""])[0]
            )
        except LoginRefused as error:
            return self._refused(error)
        return self._admitted(RedirectResponse("/", 303), token)

    async def leave(self, request: Request) -> Response:
        request.state.session.end()
        return self._admitted(RedirectResponse("/login", 303), "", lasting=0)

    async def css(self, _: Request) -> Response:
        return Response(self._style, media_type="text/css")

    def _follow(self, request: Request, token: str) -> Response:
        try:
            token, _ = self._authenticator.redeem(address(request), token)
        except LoginRefused as error:
            return self._refused(error)
        # Not a redirect: the link may have been opened from another site's page, and browsers
        # would withhold the strict cookie from a redirect that began there.
        return self._admitted(self._shown(_ENTER, head=_GO_ON), token)

    def _refused(self, error: LoginRefused) -> Response:
        if error.wait > 0.0:
            seconds = math.ceil(error.wait)
            response = self._shown(_FORM, f"{error} Wait {seconds} s.", status=429)
            response.headers["retry-after"] = str(seconds)
            return response
        return self._shown(
            self._offered() if self._authenticator.open_by_link() else _FORM, str(error), status=401
        )

    def _offered(self) -> str:
        """Offer a link, and return where it is found."""
        seconds = math.ceil(self._authenticator.offer_link())
        where = Template(_SOON).substitute(seconds=seconds) if seconds else _PRINTED
        return Template(_LINK).substitute(where=where)

    def _shown(self, body: str, message: str = "", head: str = "", status: int = 200) -> Response:
        notice = f'<p class="refused" role="alert">{html.escape(message)}</p>' if message else ""
        text = self._page.substitute(
            title=html.escape(self._title), head=head, message=notice, body=body
        )
        return HTMLResponse(text, status, {"content-security-policy": POLICY})

    def _admitted(self, response: Response, token: str, lasting: int | None = None) -> Response:
        """Hand over the cookie: out of reach of scripts, and never sent along from other sites."""
        authenticator = self._authenticator
        response.set_cookie(
            authenticator.cookie,
            token,
            lasting,
            secure=authenticator.secure,
            httponly=True,
            samesite="strict",
        )
        return response


def address(request: Request) -> str:
    """Return where a request comes from; what proxies claim is ignored."""
    return request.client.host if request.client is not None else "unknown"
