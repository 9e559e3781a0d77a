"""Attacks over the network on a real server: refused and logged."""

import contextlib
import gc
import json
import re
import socket
import time
from urllib.parse import urlencode

import httpx
import pytest
from nicegui import Client, __version__
from tests.platform.console.serving import DRIVE, PICTURE, WATCH, raw, serving
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from impslam.platform.console import guard, page_limits, protocol, refusals
from impslam.platform.console.session import IDLE_TIMEOUT, LIFETIME
from impslam.platform.console.throttle import FREE_TRIES, RESET_TIME

SOCKET = "/_nicegui_ws/socket.io/"
SECRET = b"not for everyone"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    (folder / "secret.txt").write_bytes(SECRET)
    with serving(folder) as running:
        logs = folder / "logs"
        (logs / "one.mcap").write_bytes(b"a log")
        (logs / "linked.mcap").symlink_to(folder / "secret.txt")
        (logs / "up").symlink_to(folder)
        yield running


@pytest.fixture(autouse=True)
def calm(served):
    """Begin every test without counts, pages and waits."""
    served.close_pages()
    served.server.authenticator.refusals.flush(everything=True)
    served.clock.ahead += RESET_TIME


def cookie(client):
    return "; ".join(f"{name}={value}" for name, value in client.cookies.items())


def session_of(served, client):
    authenticator = served.server.authenticator
    return authenticator.sessions.find(client.cookies[authenticator.cookie])


@contextlib.contextmanager
def opened(served, client=None, *, page="", origin=None, host=None, **headers):
    """A socket to the page of a session, as a browser would open it."""
    query = {"EIO": "4", "transport": "websocket"}
    if page:
        query |= {"client_id": page, "implicit_handshake": "true", "tab_id": "tab"}
        query |= {"document_id": "document", "next_message_id": "0"}
    if client is not None:
        headers["Cookie"] = cookie(client)
    address = f"ws://{host or '127.0.0.1'}:{served.port}{SOCKET}?{urlencode(query)}"
    with (
        socket.create_connection(("127.0.0.1", served.port)) as near,
        connect(
            address,
            sock=near,
            origin=served.origin if origin is None else origin or None,
            additional_headers=headers,
            proxy=None,
            compression=None,
            close_timeout=1,
        ) as line,
    ):
        assert line.recv(timeout=5).startswith("0")  # engine.io is open
        line.send("40")  # socket.io is asked to connect
        yield line


def status(served, *arguments, **options):
    """Return the status with which a socket is refused."""
    with pytest.raises(InvalidStatus) as refused, opened(served, *arguments, **options):
        pass
    return refused.value.response.status_code


def closing(line, *messages):
    """Send messages, and return the code with which the server closes the socket."""
    with contextlib.suppress(ConnectionClosed):
        for message in messages:
            line.send(message)
    with contextlib.suppress(ConnectionClosed):
        while True:
            line.recv(timeout=5)
    return line.protocol.close_rcvd.code


def page_of(client):
    """Open the page; return its id and the message that presses its button."""
    found = re.search(r"'client_id': '([0-9a-f-]+)'", client.get("/").text)
    assert found is not None
    page = found[1]
    [button] = [one for one in Client.instances[page].elements.values() if one.tag == "q-btn"]
    [listener] = button._event_listeners
    press = {"id": button.id, "client_id": page, "listener_id": listener, "args": []}
    return page, "42" + json.dumps(["event", press])


def soon(condition, seconds=5.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


class TestWithoutLogin:
    @pytest.mark.parametrize(
        "path",
        [
            "/",
            "/logs",
            "/logs/one.mcap",
            "/logs/one.mcap.sha256",
            "/maps",
            "/maps/map.zip",
            "/camera.jpg",
            "/favicon.ico",
            "/docs",
            "/openapi.json",
            "/nothing",
            "/login/",
            "/login.css/",
            "/login/../camera.jpg",
            "/LOGIN",
            "//login",
            f"/_nicegui/{__version__}/static/nicegui.css",
            f"/_nicegui/{__version__}/components/button",
            f"/_nicegui/{__version__}/libraries/vue",
            f"{SOCKET}?EIO=4&transport=polling",
        ],
    )
    @pytest.mark.parametrize("method", ["GET", "HEAD", "POST"])
    def test_nothing_is_served(self, served, path, method, caplog):
        answer = raw(
            served.port,
            f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\n"
            f"Origin: {served.origin}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n".encode(),
        )
        assert answer[9:12] in {b"400", b"401"}
        body = answer.partition(b"\r\n\r\n")[2]
        assert body in {b"", b"no session\n", b"an odd path\n"}
        assert "refused 127.0.0.1: " in caplog.text

    @pytest.mark.parametrize("method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT"])
    def test_other_methods_are_not_known(self, served, method, caplog):
        answer = raw(
            served.port,
            f"{method} /login HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode(),
        )
        assert answer.startswith(b"HTTP/1.1 405")
        assert f"a method ({method})" in caplog.text

    def test_no_socket_is_opened(self, served, caplog):
        assert status(served) == 403
        assert "no session (GET /_nicegui_ws/socket.io/)" in caplog.text

    def test_refused_sockets_do_not_fill_the_log(self, served, caplog):
        for _ in range(20):
            assert status(served) == 403
        time.sleep(0.05)  # the server goes on after its answer
        assert {record.name for record in caplog.records} == {refusals.__name__}
        assert len(caplog.records) == refusals.FIRST

    def test_a_socket_may_not_go_to_the_public_paths_either(self, served):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{served.port}/login", origin=served.origin, proxy=None).close()
        assert refused.value.response.status_code == 403

    @pytest.mark.parametrize("value", ["", "x", "A" * 43, "\u00e9", '"', "a=b; c", "\\"])
    def test_a_guessed_cookie_is_none(self, served, value, caplog):
        name = served.server.authenticator.cookie
        headers = {"cookie": f"{name}={value}".encode()}
        with served.client() as client:
            assert client.get("/camera.jpg", headers=headers).status_code == 401
        assert "refused 127.0.0.1: " in caplog.text

    def test_a_browser_is_led_to_the_login(self, served):
        with served.client() as client:
            answer = client.get("/", headers={"accept": "text/html"})
            assert (answer.status_code, answer.headers["location"]) == (303, "/login")
            page = client.get("/login")
            assert page.status_code == 200
            assert "<script" not in page.text
            assert client.get("/login.css").status_code == 200


class TestSessions:
    def test_the_right_password_opens_the_page(self, served, caplog):
        caplog.set_level("INFO")
        with served.logged_in() as client:
            assert client.get("/").status_code == 200
            assert client.get("/camera.jpg").content == PICTURE
        assert "127.0.0.1 logs in as driver" in caplog.text
        assert DRIVE not in caplog.text

    def test_the_cookie_is_inaccessible_to_scripts(self, served):
        with served.client() as client:
            answer = client.post(
                "/login", data={"password": DRIVE}, headers={"origin": served.origin}
            )
        flags = answer.headers["set-cookie"].lower()
        for flag in ("httponly", "samesite=strict", "path=/"):
            assert flag in flags
        assert "domain" not in flags
        assert "expires" not in flags
        assert "max-age" not in flags

    @pytest.mark.parametrize("age", [IDLE_TIMEOUT, LIFETIME])
    def test_a_stolen_expired_session_is_useless(self, served, age, caplog):
        with served.logged_in() as thief:
            assert thief.get("/camera.jpg").status_code == 200
            served.clock.ahead += age
            assert thief.get("/camera.jpg").status_code == 401
            assert status(served, thief) == 403
        assert "a session that has ended (GET /camera.jpg)" in caplog.text
        assert "a session that has ended (GET /_nicegui_ws/socket.io/)" in caplog.text

    def test_a_session_stolen_before_the_logout_is_useless_after(self, served, caplog):
        with served.logged_in() as owner, served.client() as thief:
            thief.cookies.update(owner.cookies)
            assert thief.get("/camera.jpg").status_code == 200
            gone = owner.post("/logout", headers={"origin": served.origin})
            assert (gone.status_code, gone.headers["location"]) == (303, "/login")
            assert not owner.cookies
            assert thief.get("/camera.jpg").status_code == 401
            assert status(served, thief) == 403
        assert "a session that has ended" in caplog.text

    def test_an_open_socket_is_cut_when_the_session_ends(self, served, caplog):
        with served.logged_in() as client:
            page, press = page_of(client)
            before = len(served.pressed.by)
            with opened(served, client, page=page) as line:
                line.send(press)
                soon(lambda: len(served.pressed.by) == before + 1)
                client.post("/logout", headers={"origin": served.origin})
                assert closing(line, *[press] * 50) == 1008
        assert len(served.pressed.by) == before + 1
        assert "an open socket whose session has ended" in caplog.text

    def test_an_open_socket_is_cut_when_the_session_is_too_old(self, served):
        with served.logged_in() as client, opened(served, client) as line:
            served.clock.ahead += LIFETIME
            assert closing(line) == 1008

    def test_a_socket_that_says_nothing_is_cut_as_well(self, served, caplog):
        with served.logged_in() as client, opened(served, client):
            served.server.authenticator.sessions.find(
                client.cookies[served.server.authenticator.cookie]
            ).end()
            soon(lambda: "an open socket whose session has ended" in caplog.text)

    def test_a_new_password_ends_all(self, served):
        with served.logged_in() as client:
            served.server.authenticator.accounts.set("watch", WATCH)
            soon(lambda: client.get("/camera.jpg").status_code == 401)

    def test_an_open_page_counts_as_use(self, served):
        with served.logged_in() as client, opened(served, client) as line:
            session = served.server.authenticator.sessions.find(
                client.cookies[served.server.authenticator.cookie]
            )
            for _ in range(3):
                used = session.used
                served.clock.ahead += IDLE_TIMEOUT * 0.6
                line.send("3")  # what answers the server's ping
                soon(lambda used=used: session.used > used)
            assert client.get("/camera.jpg").status_code == 200


class TestForeignPages:
    @pytest.mark.parametrize(
        "origin",
        [
            "http://evil.example",
            "https://127.0.0.1:{port}",
            "http://127.0.0.1",
            "http://127.0.0.1:1",
            "http://localhost:{port}",
            "http://127.0.0.1:{port}.evil.example",
            "null",
            "",
        ],
    )
    def test_cannot_open_sockets_nor_post_with_the_session_of_the_browser(
        self, served, origin, caplog
    ):
        origin = origin.format(port=served.port)
        with served.logged_in() as client:
            assert status(served, client, origin=origin) == 403
            headers = {"origin": origin} if origin else {}
            assert client.post("/logout", headers=headers).status_code == 403
            form = {"password": DRIVE}
            assert client.post("/login", data=form, headers=headers).status_code == 403
            assert client.get("/camera.jpg").status_code == 200  # still logged in
        assert ("a foreign origin" if origin else "no origin") in caplog.text

    def test_cannot_start_a_poll_that_they_could_read(self, served):
        with served.logged_in() as client:
            poll = f"{SOCKET}?EIO=4&transport=polling"
            answer = client.get(poll, headers={"origin": "http://127.0.0.1:1"})
            assert answer.status_code == 403
            assert client.get(poll).status_code == 404  # sockets are the only transport
            assert not [name for name in answer.headers if name.startswith("access-control")]

    @pytest.mark.parametrize(
        ("site", "mode", "dest", "expected"),
        [
            ("cross-site", "no-cors", "image", 403),
            ("same-site", "no-cors", "image", 403),
            ("same-site", "cors", "empty", 403),
            ("cross-site", "navigate", "iframe", 403),
            ("cross-site", "navigate", "object", 403),
            ("cross-site", "navigate", "document", 200),  # a link; the strict cookie stays behind
            ("same-origin", "no-cors", "image", 200),
            ("none", "navigate", "document", 200),
        ],
    )
    def test_cannot_embed_anything(self, served, site, mode, dest, expected):
        headers = {"sec-fetch-site": site, "sec-fetch-mode": mode, "sec-fetch-dest": dest}
        with served.logged_in() as client:
            assert client.get("/camera.jpg", headers=headers).status_code == expected

    def test_a_post_that_the_browser_calls_foreign_is_refused(self, served):
        with served.logged_in() as client:
            headers = {"origin": served.origin, "sec-fetch-site": "same-site"}
            assert client.post("/logout", headers=headers).status_code == 403

    @pytest.mark.parametrize(
        "host",
        [
            "evil.example",
            "evil.example:{port}",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "10.0.0.1",
            "127.0.0.2:{port}",
            "[::2]",
            "0.0.0.0",
        ],
    )
    def test_a_name_bound_to_the_robot_is_foreign(self, served, host, caplog):
        """DNS rebinding: evil.example resolves to the robot, so that its page has one origin."""
        host = host.format(port=served.port)
        with served.logged_in() as client:
            headers = {"host": host, "origin": f"http://{host}"}
            assert client.get("/camera.jpg", headers=headers).status_code == 421
            assert client.post("/logout", headers=headers).status_code == 421
        assert f"a foreign host ({host})" in caplog.text

    def test_a_socket_to_a_foreign_host_is_refused(self, served):
        with served.logged_in() as client:
            assert (
                status(
                    served,
                    client,
                    host="evil.example",
                    origin=f"http://evil.example:{served.port}",
                )
                == 421
            )

    @pytest.mark.parametrize("host", ["", "a b", "a/b", "a@b", "[", "127.0.0.1:x", "é"])
    def test_an_invalid_host_is_refused(self, served, host):
        request = b"GET /login HTTP/1.1\r\nHost: " + host.encode() + b"\r\n\r\n"
        assert raw(served.port, request).startswith(b"HTTP/1.1 400")

    @pytest.mark.parametrize("host", ["localhost:{port}", "LOCALHOST", "127.0.0.1", "localhost."])
    def test_the_names_of_this_computer_are_not_foreign(self, served, host):
        with served.client() as client:
            headers = {"host": host.format(port=served.port)}
            assert client.get("/login", headers=headers).status_code == 200

    def test_headers_of_proxies_are_ignored(self, served, caplog):
        headers = {"x-forwarded-for": "10.9.9.9", "x-forwarded-prefix": "//evil.example"}
        headers |= {"x-forwarded-host": "evil.example", "forwarded": "for=10.9.9.9"}
        with served.logged_in() as client:
            answer = client.get("/", headers=headers)
        assert answer.status_code == 200
        assert "evil" not in answer.text
        with served.client() as client:
            client.get("/", headers=headers)
        assert "10.9.9.9" not in caplog.text

    def test_every_answer_has_the_security_headers(self, served):
        with served.logged_in() as client:
            answers = [client.get(path) for path in ("/", "/login", "/camera.jpg", "/none")]
        for answer in answers:
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert answer.headers["cache-control"] == "no-store"
            assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
            assert answer.headers["referrer-policy"] == "same-origin"
            assert "server" not in answer.headers
        assert "script-src" not in answers[1].headers["content-security-policy"]


class TestPaths:
    @pytest.mark.parametrize(
        "name",
        [
            "../secret.txt",
            "..%2fsecret.txt",
            "%2e%2e/secret.txt",
            "%2e%2e%2fsecret.txt",
            "%2E%2E%2Fsecret.txt",
            "%252e%252e%252fsecret.txt",
            "..%5csecret.txt",
            "..\\secret.txt",
            "....//secret.txt",
            "./one.mcap",
            "%2e/one.mcap",
            "one.mcap%00",
            "%00",
            "one.mcap%0a",
            "//etc/passwd",
            "%2fetc%2fpasswd",
            "/etc/passwd",
            "C:%5cWindows",
            "..%c0%afsecret.txt",
            "%c0%ae%c0%ae/secret.txt",
            "..%e2%88%95secret.txt",
            "\u2024\u2024/secret.txt",
            "linked.mcap",
            "up",
            "up/secret.txt",
            "up%2fsecret.txt",
            "linked.mcap.sha256",
            "..",
            ".",
            "%2e%2e",
            "",
            "~",
            "a" * 3000,
        ],
    )
    @pytest.mark.parametrize("top", ["/logs/", "/maps/"])
    def test_nothing_but_logs_is_ever_read(self, served, top, name, caplog):
        with served.logged_in(WATCH) as client:
            target = (top + name).encode()
            answer = raw(
                served.port,
                b"GET "
                + target
                + f" HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie(client)}\r\n"
                "Connection: close\r\n\r\n".encode(),
            )
        assert answer[9:12] in {b"400", b"404", b"307"}
        assert SECRET not in answer
        assert b"root:" not in answer
        if answer[9:12] == b"400":
            assert "refused 127.0.0.1: " in caplog.text

    def test_a_log_is_read(self, served):
        with served.logged_in(WATCH) as client:
            assert client.get("/logs/one.mcap").content == b"a log"

    @pytest.mark.parametrize("room", ["static", "libraries", "components", "resources/a", "esm/a"])
    @pytest.mark.parametrize("way", ["../" * 9, "..%2f" * 9, "%2e%2e/" * 9, "..%5c" * 9])
    def test_the_frameworks_own_files_are_no_way_out(self, served, room, way):
        with served.logged_in(WATCH) as client:
            target = f"/_nicegui/{__version__}/{room}/{way}etc/passwd"
            answer = raw(
                served.port,
                f"GET {target} HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie(client)}\r\n"
                "Connection: close\r\n\r\n".encode(),
            )
        assert answer.startswith(b"HTTP/1.1 400")


class TestRoutes:
    @pytest.mark.parametrize("method", ["POST", "GET"])
    def test_a_stranger_cannot_have_a_page_built(self, served, method):
        before = len(Client.instances)
        with served.client(headers={"origin": served.origin}) as client:
            for _ in range(5):
                answer = client.request(method, "/login.css")
                assert answer.status_code == (405 if method == "POST" else 200)
                assert len(answer.content) < 3000
        assert len(Client.instances) == before

    @pytest.mark.parametrize(
        ("method", "path", "expected"),
        [
            ("GET", "/nothing", 404),
            ("GET", "/docs", 404),
            ("GET", "/openapi.json", 404),
            ("GET", "/logs/", 404),
            ("GET", "/maps/map", 404),
            ("GET", "/_nicegui/", 404),
            ("GET", f"/_nicegui/{__version__}/static/nothing", 404),
            ("GET", f"/_nicegui/{__version__}/nothing/more", 404),
            ("GET", "/_nicegui_ws/nothing", 404),
            ("GET", "/logout", 405),
            ("POST", "/", 405),
            ("HEAD", "/", 405),
            ("POST", "/login.css", 405),
            ("POST", "/camera.jpg", 405),
            ("POST", "/logs", 405),
            ("POST", f"/_nicegui/{__version__}/static/nicegui.css", 405),
        ],
    )
    def test_what_is_not_served_costs_no_page(self, served, method, path, expected, caplog):
        with served.logged_in(WATCH) as client:
            before = len(Client.instances)
            answer = client.request(method, path, headers={"origin": served.origin})
            assert answer.status_code == expected
            assert len(answer.content) < 100
            assert len(Client.instances) == before
        assert not [record for record in caplog.records if record.name == "nicegui"]

    def test_a_path_that_no_route_takes_costs_no_page(self, served, monkeypatch):
        """As /logs in a replay: the guard lets it through, and the app has no such route."""
        monkeypatch.setattr(guard, "check_route", lambda request: None)
        with served.logged_in(WATCH) as client:
            before = len(Client.instances)
            assert client.get("/nothing").text == "not found\n"
            assert len(Client.instances) == before

    def test_a_socket_goes_to_the_path_of_sockets_alone(self, served):
        address = f"ws://127.0.0.1:{served.port}/logs"
        with served.logged_in() as client:
            headers = {"Cookie": cookie(client)}
            with pytest.raises(InvalidStatus) as refused:
                connect(address, origin=served.origin, additional_headers=headers, proxy=None)
        assert refused.value.response.status_code == 404


class TestSizes:
    def post(self, served, client, headers, body=b""):
        head = (
            f"POST /logout HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nOrigin: {served.origin}\r\n"
            f"Cookie: {cookie(client)}\r\n{headers}\r\n\r\n"
        )
        return raw(served.port, head.encode() + body)

    def test_a_body_that_says_it_is_large_is_not_read(self, served, caplog):
        with served.logged_in() as client:
            answer = self.post(served, client, "Content-Length: 99999999999")
        assert answer.startswith(b"HTTP/1.1 413")
        assert "a large body" in caplog.text

    def test_a_body_that_does_not_say_so_is_read_no_further(self, served, caplog):
        with served.logged_in() as client:
            chunk = b"4000\r\n" + b"x" * 0x4000 + b"\r\n"
            answer = self.post(served, client, "Transfer-Encoding: chunked", chunk * 5)
            assert client.get("/camera.jpg").status_code == 200
        assert answer.startswith(b"HTTP/1.1 413")
        assert "a large body" in caplog.text

    def test_bodies_without_a_session_are_limited_further(self, served, caplog):
        with served.client() as client:
            answer = client.post("/login", content=b"x" * 5000, headers={"origin": served.origin})
        assert answer.status_code == 413
        assert "/login: more than 4096 bytes" in caplog.text

    def test_many_fields_are_no_login(self, served):
        with served.client() as client:
            answer = client.post("/login", content=b"&a=" * 1000, headers={"origin": served.origin})
        assert answer.status_code == 400

    @pytest.mark.parametrize("length", ["-1", "1e3", "x", "5, 6", ""])
    def test_an_invalid_length_is_refused(self, served, length, caplog):
        with served.logged_in() as client:
            answer = self.post(served, client, f"Content-Length: {length}")
        assert answer.startswith(b"HTTP/1.1 400")
        assert "a request that is none, or too large" in caplog.text

    def test_smuggling_by_two_lengths_is_refused(self, served):
        with served.logged_in() as client:
            answer = self.post(served, client, "Content-Length: 5\r\nContent-Length: 6", b"x" * 6)
        assert answer.startswith(b"HTTP/1.1 400")

    @pytest.mark.parametrize("size", [17_000, 60_000, 1_000_000])
    def test_large_headers_are_refused(self, served, size, caplog):
        request = b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"x" * size + b"\r\n\r\n"
        answer = raw(served.port, request)
        assert answer[:12] in {b"HTTP/1.1 400", b"HTTP/1.1 431", b""}
        assert "large" in caplog.text

    def test_a_long_target_is_refused(self, served, caplog):
        request = b"GET /login?" + b"x" * 5000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        assert raw(served.port, request).startswith(b"HTTP/1.1 414")
        assert "a long target" in caplog.text

    @pytest.mark.parametrize("parts", [1, 50])
    def test_a_large_message_closes_the_socket(self, served, parts, caplog):
        with served.logged_in() as client, opened(served, client) as line:
            part = "x" * (guard.MAX_BODY // parts + 10)
            assert closing(line, [part] * parts if parts > 1 else part) == 1009
            soon(lambda: "a socket message that is odd, or too large" in caplog.text)

    def test_too_many_messages_close_the_socket(self, served, caplog):
        with served.logged_in() as client, opened(served, client) as line:
            assert closing(line, *["3"] * 5000) == 1008
        assert "too many messages on a socket" in caplog.text

    @pytest.mark.parametrize("data", [b"\0" * 100, b"hello\r\n\r\n", b"\x16\x03\x01\x02" * 30])
    def test_other_protocols_than_http_are_refused(self, served, data, caplog):
        assert raw(served.port, data)[:12] in {b"HTTP/1.1 400", b""}
        assert "a request that is none, or too large" in caplog.text


class TestMessages:
    """Messages of a watcher's socket reach neither nicegui's log nor its tracebacks."""

    FORGED = "\x1b[31mall is well\nimp: warning: all is well"

    @pytest.fixture
    def page(self, served, monkeypatch):
        # A page that was left stays for 3 s.
        monkeypatch.setattr(page_limits, "MAX_WATCHER_PAGES", 1000)
        with served.logged_in(WATCH) as client:
            page, press = page_of(client)
            with opened(served, client, page=page) as line:
                yield served, line, page, json.loads(press[2:])[1]

    def sent(self, page, *messages):
        """Send messages and press the button, so that earlier messages have been processed."""
        served, line, _, press = page
        before = len(served.pressed.by)
        for message in messages:
            line.send(message)
        line.send("42" + json.dumps(["event", press]))
        soon(lambda: len(served.pressed.by) == before + 1)

    @pytest.mark.parametrize("level", ["debug", "info", "warning", "error"])
    def test_nothing_is_written_into_the_log(self, page, level, caplog):
        caplog.set_level("DEBUG", "nicegui")
        logged = {"client_id": page[2], "level": level, "message": self.FORGED}
        self.sent(page, "42" + json.dumps(["log", logged]))
        assert "all is well" not in caplog.text
        assert "a message of another kind than the page sends" in caplog.text

    @pytest.mark.parametrize(
        ("kind", "fields"),
        [
            ("log", {"level": "none", "message": "x"}),
            ("event", {"listener_id": "none"}),
            ("event", {"listener_id": ["x"]}),
            ("event", {"id": "4"}),
            ("event", {"id": {}}),
            ("event", {"id": None}),
            ("event", {"args": None}),
            ("event", {"args": 5}),
            ("event", {"args": ["{"]}),
            ("event", {"args": ["[" * 2000]}),
            ("event", {"args": ["NaN"]}),
            ("event", {"args": [5]}),
            ("ack", {}),
            ("ack", {"next_message_id": "x"}),
            ("ack", {"next_message_id": None}),
            ("ack", {"next_message_id": []}),
            ("handshake", {}),
            ("handshake", {"tab_id": "t" * 5000, "document_id": "d"}),
            ("handshake", {"tab_id": [], "document_id": {}}),
            ("handshake", {"tab_id": "t", "document_id": "d", "next_message_id": "x"}),
            ("javascript_response", {}),
            ("javascript_response", {"request_id": []}),
            (["event"], {}),
            (None, {}),
        ],
    )
    def test_malformed_messages_raise_nothing(self, page, kind, fields, caplog):
        _, _, name, press = page
        message = {"client_id": name, **(press if kind == "event" else {}), **fields}
        self.sent(page, "42" + json.dumps([kind, message]), "420" + json.dumps([kind, message]))
        gc.collect()  # a task that failed is told when it is collected
        assert {record.name for record in caplog.records} == {refusals.__name__}

    @pytest.mark.parametrize(
        "frame",
        ["42" + "[" * 5000, "40", "40{}", "40/x,", "43[]", "44{}", "45-", "2probe", "5", "6", "42[1]",
         '42/x,["event",{}]', '421-["event",{}]', "42" + "9" * 80 + "[]", "é" * 9000, "", b"4", b""],
    )  # fmt: skip
    def test_frames_that_a_page_never_sends_are_dropped(self, page, frame, caplog):
        self.sent(page, frame)
        assert "a malformed message" in caplog.text
        assert {record.name for record in caplog.records} == {refusals.__name__}

    @pytest.mark.parametrize(
        "query",
        [
            "transport=websocket",
            "EIO=3&transport=websocket",
            "EIO=4&transport=polling",
            "EIO=4&transport=websocket&sid=x",
            "EIO=4&transport=websocket&j=1",
            "EIO=4&EIO=4&transport=websocket",
            "EIO=4&transport=websocket&client_id=x&implicit_handshake=true",
            "EIO=4&transport=websocket&client_id=x&implicit_handshake=true&tab_id=t&document_id=d"
            "&next_message_id=x",
        ],
    )
    def test_malformed_addresses_of_sockets_are_refused(self, served, query, caplog):
        with served.logged_in(WATCH) as client:
            headers = {"Cookie": cookie(client)}
            with pytest.raises(InvalidStatus) as refused:
                connect(
                    f"ws://127.0.0.1:{served.port}{SOCKET}?{query}",
                    origin=served.origin,
                    additional_headers=headers,
                    proxy=None,
                )
        assert refused.value.response.status_code == 400
        assert "a malformed socket" in caplog.text


class TestSlowness:
    def test_a_slow_body_times_out(self, served, monkeypatch, caplog):
        monkeypatch.setattr(guard, "BODY_TIMEOUT", 0.2)
        head = (
            f"POST /login HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nOrigin: {served.origin}\r\n"
        )
        answer = raw(served.port, (head + "Content-Length: 100\r\n\r\npass").encode())
        assert answer.startswith(b"HTTP/1.1 408")
        assert b"connection: close" in answer.lower()
        assert "a slow body" in caplog.text

    @pytest.mark.parametrize("data", [b"G", b"GET / HTTP/1.1\r\nHost: "])
    def test_a_slow_head_times_out(self, served, data, monkeypatch, caplog):
        monkeypatch.setattr(protocol, "HEAD_TIMEOUT", 0.2)
        assert raw(served.port, data) == b""
        assert "a slow request" in caplog.text

    def test_an_unused_connection_times_out_without_a_warning(self, served, monkeypatch, caplog):
        """Browsers open connections in advance."""
        monkeypatch.setattr(protocol, "HEAD_TIMEOUT", 0.2)
        begun = time.monotonic()
        assert raw(served.port, b"") == b""
        assert time.monotonic() - begun < 4.0  # it was closed
        assert "refused" not in caplog.text

    def test_a_slow_second_head_times_out(self, served, monkeypatch, caplog):
        monkeypatch.setattr(protocol, "HEAD_TIMEOUT", 0.2)
        first = b"GET /login.css HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        with socket.create_connection(("127.0.0.1", served.port), timeout=5.0) as connection:
            connection.sendall(first)
            assert connection.recv(65536).startswith(b"HTTP/1.1 200")
            connection.sendall(b"GET /lo")
            soon(lambda: "a slow request" in caplog.text)

    def test_a_used_connection_does_not_time_out(self, served, monkeypatch):
        monkeypatch.setattr(protocol, "HEAD_TIMEOUT", 0.2)
        with served.client() as client:
            for _ in range(4):
                assert client.get("/login").status_code == 200
                time.sleep(0.1)

    def test_one_address_cannot_take_every_connection(self, served, monkeypatch, caplog):
        monkeypatch.setattr(protocol, "MAX_PER_ADDRESS", 5)
        held = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(30)]
        try:
            soon(lambda: "too many connections" in caplog.text)
            other = httpx.HTTPTransport(local_address="127.0.0.2")
            with httpx.Client(base_url=served.origin, transport=other) as client:
                assert client.get("/login").status_code == 200
        finally:
            for one in held:
                one.close()


class TestGuessing:
    def test_a_thousand_logins_in_a_minute(self, served, caplog):
        """All but a few are refused without a hash, and another address can log in meanwhile."""
        counts = {401: 0, 429: 0}
        hashes = []
        accounts = served.server.authenticator.accounts
        real = accounts.right
        accounts.right = lambda password: hashes.append(password) or real(password)
        try:
            with served.client(headers={"origin": served.origin}) as client:
                begun = time.perf_counter()
                for k in range(1000):
                    answer = client.post("/login", data={"password": f"guess-{k:04d}"})
                    counts[answer.status_code] += 1
                    served.clock.ahead += 0.05
                spent = time.perf_counter() - begun
                right = client.post("/login", data={"password": DRIVE})
                assert right.status_code == 429
                assert int(right.headers["retry-after"]) > 0
                script = client.get("/logs", auth=("drive", DRIVE))
                assert script.status_code == 401
            other = httpx.HTTPTransport(local_address="127.0.0.2")
            with httpx.Client(base_url=served.origin, transport=other) as client:
                headers = {"origin": served.origin}
                answer = client.post("/login", data={"password": DRIVE}, headers=headers)
                assert answer.status_code == 303
        finally:
            del accounts.right
        assert counts[401] == len(hashes) - 1
        assert FREE_TRIES <= counts[401] <= 8
        assert counts[401] + counts[429] == 1000
        assert spent < 60.0
        served.server.authenticator.refusals.flush(everything=True)
        assert "refused 127.0.0.1: login (a wrong password)" in caplog.text
        [logged] = re.findall(r"refused 127\.0\.0\.1: login: (\d+) more in", caplog.text)
        assert int(logged) + 5 == 1001
        assert len(caplog.records) < 20
        assert "guess-" not in caplog.text

    def test_the_answer_does_not_reveal_what_was_wrong(self, served):
        with served.client(headers={"origin": served.origin}) as client:
            texts = {
                client.post("/login", data=form).text
                for form in ({"password": "guessed-it"}, {"password": ""}, {"user": "root"})
            }
        assert len(texts) == 1

    def test_what_was_typed_is_not_shown_again(self, served):
        with served.client(headers={"origin": served.origin}) as client:
            answer = client.post("/login", data={"password": "<script>alert(1)</script>"})
        assert answer.status_code == 401
        assert "alert(1)" not in answer.text


class TestRights:
    def test_a_watcher_is_shown_as_one(self, served):
        with served.logged_in(WATCH) as client:
            page, press = page_of(client)
            before = len(served.pressed.by)
            with opened(served, client, page=page) as line:
                line.send(press)
                soon(lambda: len(served.pressed.by) == before + 1)
        assert not served.pressed.by[-1].may_drive

    def test_a_watcher_cannot_press_the_drivers_buttons(self, served, caplog):
        with served.logged_in() as driver, served.logged_in(WATCH) as watcher:
            drivers, press = page_of(driver)
            own, press_own = page_of(watcher)
            before = len(served.pressed.by)
            with (
                opened(served, driver, page=drivers) as line,
                opened(served, watcher, page=own) as foe,
            ):
                foe.send(press)
                foe.send(press.replace('"event"', '"javascript_response"'))
                foe.send("42" + json.dumps(["ack", {"client_id": drivers, "next_message_id": 9}]))
                foe.send(press_own)  # in order: earlier messages have been processed
                soon(lambda: len(served.pressed.by) == before + 1)
                assert not served.pressed.by[-1].may_drive
                line.send(press)
                soon(lambda: len(served.pressed.by) == before + 2)
                assert served.pressed.by[-1].may_drive
        assert "a message for another's page" in caplog.text

    def test_a_watcher_cannot_join_the_drivers_page(self, served, caplog):
        with served.logged_in() as driver, served.logged_in(WATCH) as watcher:
            drivers, press = page_of(driver)
            before = len(served.pressed.by)
            assert status(served, watcher, page=drivers) == 403
            with opened(served, watcher) as foe:
                assert foe.recv(timeout=5).startswith("40")
                hello = {"client_id": drivers, "tab_id": "t", "document_id": "d"}
                foe.send("42" + json.dumps(["handshake", hello]))
                foe.send(press)
                soon(lambda: "a message for another's page" in caplog.text)
            assert len(served.pressed.by) == before
        assert "a socket for another's page" in caplog.text

    @pytest.mark.parametrize(
        "message",
        [
            '42["event"]',
            '42["event", null]',
            '42["event", [1, 2]]',
            '42["event", {"client_id": 3}]',
            '42["event", {}, {}]',
            '42["nothing", {}]',
            '42["connect", {}]',
            '42["disconnect"]',
            "42[]",
            "42{",
            "4",
            "",
            "9",
            "451-",
        ],
    )
    def test_odd_messages_harm_nobody(self, served, message):
        with served.logged_in() as client:
            page, press = page_of(client)
            before = len(served.pressed.by)
            try:
                with opened(served, client) as foe:
                    foe.send(message)
                    foe.send("3")
                    time.sleep(0.05)
            except ConnectionClosed:
                pass
            with opened(served, client, page=page) as line:
                line.send(press)
                soon(lambda: len(served.pressed.by) == before + 1)

    def test_a_script_reads_files_and_nothing_else(self, served, caplog):
        with served.client(auth=("watch", WATCH)) as script:
            assert script.get("/logs/one.mcap").content == b"a log"
            assert script.get("/maps").json() == []
            assert script.get("/").status_code == 401
            assert script.get("/camera.jpg").status_code == 401
            assert script.get("/logsx").status_code == 401
            headers = {"origin": served.origin}
            assert script.post("/logs", headers=headers).status_code == 401
            assert script.post("/logout", headers=headers).status_code == 401
        assert "no session" in caplog.text
