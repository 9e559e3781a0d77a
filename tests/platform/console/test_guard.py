"""The guard with fake apps; tests over the network are in test_security.py."""

import asyncio

import pytest

from impslam.platform.console import connection, guard
from impslam.platform.console.accounts import Accounts
from impslam.platform.console.authenticator import Authenticator
from impslam.platform.console.guard import Guard
from impslam.platform.console.request_checks import plain
from impslam.platform.console.routes import SOCKET

pytestmark = pytest.mark.anyio
HOST = (b"host", b"robot:8080")
ORIGIN = (b"origin", b"http://robot:8080")


@pytest.fixture
def anyio_backend():
    return "asyncio"


@pytest.fixture
def authenticator(tmp_path):
    return Authenticator(Accounts(tmp_path / "accounts.json"), secure=False)


@pytest.fixture
def cookie(authenticator):
    token, session = authenticator.sessions.begin("drive")
    return (b"cookie", f"{authenticator.cookie}={token}".encode()), session


def scope(*headers, kind="http", method="GET", path=None):
    path = path or (SOCKET if kind == "websocket" else "/logout" if method == "POST" else "/")
    return {
        "type": kind,
        "method": method,
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"EIO=4&transport=websocket" if kind == "websocket" else b"",
        "scheme": "ws" if kind == "websocket" else "http",
        "server": ("10.0.0.5", 8080),
        "client": ("10.0.0.9", 1234),
        "headers": list(headers),
        "state": {"kept": 1},
        "extensions": {"websocket.http.response": {}},
    }


async def ask(guarded, request, messages=({"type": "http.request", "body": b""},)):
    """Send messages, and then nothing; return the answers."""
    left, sent = list(messages), []

    async def receive():
        if left:
            return left.pop(0)
        return await asyncio.get_running_loop().create_future()

    async def send(message):
        sent.append(message)

    await guarded(request, receive, send)
    return sent


async def test_the_app_sees_the_session_and_the_whole_body(authenticator, cookie):
    seen = []

    async def app(scope, receive, send):
        seen.append((scope["state"], dict(scope["headers"]), await receive()))
        await send({"type": "http.response.start", "status": 204, "headers": [(b"Server", b"x")]})
        await send({"type": "http.response.body"})

    request = scope(HOST, ORIGIN, cookie[0], (b"x-forwarded-for", b"1.2.3.4"), method="POST")
    parts = [
        {"type": "http.request", "body": b"one ", "more_body": True},
        {"type": "http.request", "body": b"two"},
    ]
    sent = await ask(Guard(app, authenticator, ["Robot."]), request, parts)
    state, headers, message = seen[0]
    assert state == {"kept": 1, "session": cookie[1]}
    assert request["state"] == {"kept": 1}
    assert b"x-forwarded-for" not in headers
    assert message == {"type": "http.request", "body": b"one two", "more_body": False}
    assert b"server" not in dict(sent[0]["headers"])
    assert dict(sent[0]["headers"])[b"cache-control"] == b"no-store"


async def test_an_incomplete_body_does_not_reach_the_app(authenticator, cookie):
    async def app(*_):
        pytest.fail("reached")

    parts = [{"type": "http.request", "body": b"x", "more_body": True}, {"type": "http.disconnect"}]
    request = scope(HOST, ORIGIN, cookie[0], method="POST")
    assert await ask(Guard(app, authenticator, ["robot"]), request, parts) == []


async def test_lifespan_messages_pass_unchanged(authenticator):
    seen = []

    async def app(scope, receive, send):
        seen.append(scope)

    await ask(Guard(app, authenticator, []), {"type": "lifespan"})
    assert seen == [{"type": "lifespan"}]


async def test_a_download_aborts_when_its_session_ends(authenticator, cookie, caplog):
    parts = []

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for k in range(5):
            if k == 2:
                cookie[1].end()
            await send({"type": "http.response.body", "body": b"x", "more_body": True})
            parts.append(k)

    sent = await ask(Guard(app, authenticator, ["robot"]), scope(HOST, cookie[0]))
    assert parts == [0, 1]
    assert len(sent) == 3
    assert "the rest after its session ended" in caplog.text


async def test_an_app_that_ignores_the_cut_is_cancelled(authenticator, cookie, monkeypatch, caplog):
    monkeypatch.setattr(guard, "CHECK_INTERVAL", 0.01)
    monkeypatch.setattr(guard, "GRACE", 0.05)
    ended = asyncio.Event()

    async def app(scope, receive, send):
        await receive()
        await send({"type": "websocket.accept"})
        cookie[1].end()
        try:
            while True:
                await asyncio.sleep(0.01)
                await send({"type": "websocket.send", "text": "more"})
        finally:
            ended.set()

    request = scope(HOST, ORIGIN, cookie[0], kind="websocket")
    sent = await ask(Guard(app, authenticator, ["robot"]), request, [{"type": "websocket.connect"}])
    await asyncio.wait_for(ended.wait(), 5.0)
    assert [message["type"] for message in sent][-1] == "websocket.close"
    assert "an open socket whose session has ended" in caplog.text


async def test_a_socket_that_takes_nothing_does_not_block_the_guard(
    authenticator, cookie, monkeypatch
):
    monkeypatch.setattr(guard, "CHECK_INTERVAL", 0.01)
    monkeypatch.setattr(guard, "GRACE", 0.05)
    never = asyncio.get_running_loop().create_future

    async def app(scope, receive, send):
        cookie[1].end()
        await send({"type": "websocket.accept"})

    async def receive():
        return await never()

    async def send(message):
        await never()

    request = scope(HOST, ORIGIN, cookie[0], kind="websocket")
    guarded = Guard(app, authenticator, ["robot"])
    await asyncio.wait_for(guarded(request, receive, send), 5.0)


async def test_a_socket_that_is_not_read_is_cut(authenticator, cookie, monkeypatch, caplog):
    """Otherwise, waiting messages would fill the memory."""
    monkeypatch.setattr(guard, "CHECK_INTERVAL", 0.01)
    monkeypatch.setattr(guard, "GRACE", 0.05)
    monkeypatch.setattr(connection, "SEND_TIMEOUT", 0.05)
    never = asyncio.get_running_loop().create_future

    async def app(scope, receive, send):
        await send({"type": "websocket.send", "text": "a frame"})

    async def send(message):
        await never()

    request = scope(HOST, ORIGIN, cookie[0], kind="websocket")
    await asyncio.wait_for(Guard(app, authenticator, ["robot"])(request, never, send), 5.0)
    assert "a socket that takes nothing" in caplog.text


async def test_no_message_passes_after_the_end(authenticator, cookie, monkeypatch):
    monkeypatch.setattr(guard, "CHECK_INTERVAL", 0.01)
    got = []

    async def app(scope, receive, send):
        while got[-1:] != ["websocket.disconnect"]:
            message = await receive()
            got.append(message["type"])
            cookie[1].end()

    messages = [{"type": "websocket.connect"}, *[{"type": "websocket.receive", "text": "go"}] * 3]
    request = scope(HOST, ORIGIN, cookie[0], kind="websocket")
    await ask(Guard(app, authenticator, ["robot"]), request, messages)
    assert got == ["websocket.connect", "websocket.disconnect"]


async def test_errors_of_the_app_are_raised(authenticator, cookie):
    async def app(scope, receive, send):
        raise LookupError("a bug")

    request = scope(HOST, ORIGIN, cookie[0], kind="websocket")
    with pytest.raises(LookupError):
        await ask(Guard(app, authenticator, ["robot"]), request)
    with pytest.raises(LookupError):
        await ask(Guard(app, authenticator, ["robot"]), scope(HOST, cookie[0]))


@pytest.mark.parametrize(
    ("host", "server", "status"),
    [
        (b"10.0.0.5", "10.0.0.5", 200),
        (b"10.0.0.5:9", "::ffff:10.0.0.5", 200),
        (b"[FD00::5]:8080", "fd00:0:0::5%eth0", 200),
        (b"[fd00::6]", "fd00::5", 421),
        (b"fd00::5", "fd00::5", 400),
        (b"robot.", "10.0.0.5", 200),
        (b"ROBOT", "10.0.0.5", 200),
        (b"robot.local", "10.0.0.5", 421),
    ],
)
async def test_the_address_of_the_connection_is_no_foreign_host(
    authenticator, cookie, host, server, status
):
    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body"})

    request = scope((b"host", host), cookie[0]) | {"server": (server, 8080)}
    sent = await ask(Guard(app, authenticator, ["robot"]), request)
    assert sent[0]["status"] == status


def test_addresses_are_made_canonical():
    assert plain("::ffff:10.0.0.5") == "10.0.0.5"
    assert plain("FE80::1%eth0") == "fe80::1"
    assert plain("robot") == "robot"
