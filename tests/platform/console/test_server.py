"""The server as a whole: where it listens, with which certificate, and how it ends."""

import signal
import socket
import ssl
import subprocess
import sys
import time

import pytest
from tests.platform.console.serving import DRIVE, Clock, raw, serving, stand_in
from websockets.sync.client import connect

from impslam.errors import ImpError
from impslam.platform.console.accounts import Accounts
from impslam.platform.console.server import ServerSettings, listening, prepared
from impslam.platform.console.tls import own_certificate

CHILD = """
import sys
from pathlib import Path
from tests.platform.console.serving import Pressed, stand_in
from impslam.platform.console.server import ServerSettings, listening, prepared

settings = ServerSettings(port=0, accounts=Path(sys.argv[1]) / "accounts.json")
with listening(settings) as listener:
    tell = lambda line: print(line, flush=True)
    prepared(stand_in(Path(sys.argv[1])), settings, listener, tell, Pressed().build).run([listener])
print("put away", flush=True)
"""


def refused(tmp_path, **settings):
    """Return the line with which the server refuses to serve."""
    wanted = ServerSettings(port=0, accounts=tmp_path / "accounts.json", **settings)
    with listening(wanted) as listener, pytest.raises(ImpError) as notices:
        prepared(stand_in(tmp_path), wanted, listener, print, lambda model: None, Clock())
    assert "\n" not in str(notices.value)
    return str(notices.value)


class TestWhereItListens:
    @pytest.mark.parametrize("host", ["0.0.0.0", "::"])
    def test_other_computers_are_not_served_without_a_password(self, tmp_path, host):
        assert "other computers need a password to drive" in refused(tmp_path, host=host)

    def test_a_password_to_watch_is_not_enough(self, tmp_path):
        Accounts(tmp_path / "accounts.json").set("watch", "watch-password")
        assert "other computers need a password to drive" in refused(tmp_path, host="0.0.0.0")

    def test_passwords_that_others_can_read_are_refused(self, tmp_path):
        Accounts(tmp_path / "accounts.json").set("drive", DRIVE)
        (tmp_path / "accounts.json").chmod(0o644)
        assert "chmod 600" in refused(tmp_path, host="0.0.0.0")

    def test_a_certificate_needs_its_key(self, tmp_path):
        assert "give both" in refused(tmp_path, certificate=tmp_path / "certificate.pem")

    @pytest.mark.parametrize("host", ["192.0.2.1", "no such host", "a" * 300])
    def test_an_unknown_address_is_an_error(self, host):
        with pytest.raises(ImpError, match="choose another"):
            listening(ServerSettings(host=host, port=0))

    @pytest.mark.parametrize("port", [-1, 65536])
    def test_an_invalid_port_is_an_error(self, port):
        with pytest.raises(ImpError, match="choose another"):
            listening(ServerSettings(port=port))

    def test_a_used_port_is_an_error(self):
        with listening(ServerSettings(port=0)) as taken, pytest.raises(ImpError, match="in use"):
            listening(ServerSettings(port=taken.getsockname()[1]))


class TestLink:
    def test_without_a_password_the_one_time_link_opens_the_page(self, tmp_path):
        with serving(tmp_path, passwords=False) as served:
            assert served.notices[0] == f"the page is at {served.origin}"
            link = served.notices[1].removeprefix("open ")
            with served.client() as client:
                assert client.get("/camera.jpg").status_code == 401
                assert client.get("/login?token=wrong").status_code == 401
                answer = client.get(link)
                assert answer.status_code == 200
                assert '<meta http-equiv="refresh" content="0; url=/" />' in answer.text
                assert "token" not in answer.text
                assert client.get("/camera.jpg").status_code == 200
            with served.client() as thief:
                assert thief.get(link).status_code == 401
                assert thief.get("/camera.jpg").status_code == 401
                headers = {"origin": served.origin}
                for guess in ("", "password"):
                    form = {"password": guess}
                    assert thief.post("/login", data=form, headers=headers).status_code == 401

    def test_another_link_is_shown_when_the_page_is_requested(self, tmp_path):
        with serving(tmp_path, passwords=False) as served, served.client() as client:
            client.get(served.notices[1].removeprefix("open "))
            assert "again in 60 s" in client.get("/login?token=used").text  # one a minute
            assert len(served.notices) == 2
            served.clock.ahead += 3600.0
            assert client.get("/camera.jpg").status_code == 401
            text = client.get("/login").text
            assert "newest one is printed where <code>imp robot</code> runs" in text
            client.get("/login")
            assert len(served.notices) == 3
            assert client.get(served.notices[2].removeprefix("open ")).status_code == 200
            assert client.get("/camera.jpg").status_code == 200

    def test_the_login_of_a_replay_names_the_program_that_prints_the_link(
        self, tmp_path, monkeypatch
    ):
        replay = stand_in(tmp_path)
        replay.station = None
        monkeypatch.setattr(f"{serving.__module__}.stand_in", lambda _: replay)
        with serving(tmp_path, passwords=False) as served, served.client() as client:
            assert "where <code>imp run --live</code> runs" in client.get("/login").text


@pytest.fixture(scope="module")
def secured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    pem = own_certificate(folder / "certificate", ["localhost"], ["127.0.0.1"])
    trust = ssl.create_default_context(cafile=pem.certificate)
    given = {"certificate": pem.certificate, "key": pem.key}
    with serving(folder, verify=trust, **given) as served:
        served.trust = trust
        yield served


class TestTls:
    def test_the_fingerprint_is_reported(self, secured):
        assert secured.notices[0].startswith("the page is at https://127.0.0.1:")
        assert secured.notices[1].startswith("SHA-256 of its certificate: ")

    def test_the_cookie_is_bound_to_host_and_tls(self, secured):
        with secured.client() as client:
            headers = {"origin": secured.origin}
            answer = client.post("/login", data={"password": DRIVE}, headers=headers)
            given = answer.headers["set-cookie"]
            assert client.get("/camera.jpg").status_code == 200
        assert given.startswith("__Host-imp_session=")
        assert "; secure" in given.lower()
        assert "path=/;" in given.lower() + ";"
        assert "domain" not in given.lower()

    def test_a_page_without_tls_is_foreign(self, secured):
        with secured.logged_in() as client:
            headers = {"origin": secured.origin.replace("https", "http")}
            assert client.post("/logout", headers=headers).status_code == 403

    def test_sockets_use_tls_too(self, secured):
        with secured.logged_in() as client:
            cookie = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
            address = f"wss://127.0.0.1:{secured.port}/_nicegui_ws/socket.io/?EIO=4"
            with connect(
                f"{address}&transport=websocket",
                origin=secured.origin,
                additional_headers={"cookie": cookie},
                ssl=secured.trust,
                proxy=None,
                close_timeout=1,
            ) as line:
                assert line.recv(timeout=5).startswith("0")

    def test_plain_http_gets_nothing(self, secured):
        answer = raw(secured.port, b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b"HTTP" not in answer

    @pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
    @pytest.mark.filterwarnings("ignore:ssl.TLSVersion.TLSv1:DeprecationWarning")
    def test_old_tls_versions_are_refused(self, secured, version):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        context.set_ciphers("ALL:@SECLEVEL=0")
        context.minimum_version = context.maximum_version = version
        with (
            socket.create_connection(("127.0.0.1", secured.port)) as near,
            pytest.raises(ssl.SSLError),
        ):
            context.wrap_socket(near)


class TestBeyondLoopback:
    def test_it_is_on_tls_with_a_certificate_of_its_own(self, tmp_path):
        with serving(tmp_path, host="0.0.0.0", names=("robot.example",), verify=False) as served:
            assert served.notices[0] == f"the page is at https://robot.example:{served.port}"
            assert served.server.authenticator.secure
            assert (tmp_path / "accounts" / "certificate.pem").exists()
            with served.client() as client:
                for host, status in {
                    "robot.example": 200,
                    f"127.0.0.1:{served.port}": 200,
                    socket.gethostname(): 200,
                    "evil.example": 421,
                    "10.11.12.13": 421,
                }.items():
                    assert client.get("/login", headers={"host": host}).status_code == status
            with served.logged_in() as client:
                assert client.get("/").status_code == 200

    @pytest.mark.parametrize("name", ["vm", "vm.local", "vm.example.org"])
    def test_without_another_name_the_address_is_that_by_mdns(self, tmp_path, monkeypatch, name):
        monkeypatch.setattr(socket, "gethostname", lambda: name)
        wanted = ServerSettings("0.0.0.0", 0, accounts=tmp_path / "accounts.json")
        Accounts(wanted.accounts).set("drive", DRIVE)
        with listening(wanted) as listener:
            server = prepared(stand_in(tmp_path), wanted, listener, print, lambda _: None, Clock())
            port = listener.getsockname()[1]
        assert server.address == f"https://vm.local:{port}"


def test_it_beats_for_the_watchdog(tmp_path):
    beats = []
    with serving(tmp_path) as served:
        served.server.beat = lambda: beats.append(time.monotonic())
        until = time.monotonic() + 10.0
        while len(beats) < 3 and time.monotonic() < until:
            time.sleep(0.01)
    assert len(beats) >= 3


class TestEnd:
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_a_signal_ends_it_within_2_s_with_sockets_open(self, tmp_path, number):
        """It prints nothing of its own, even if a client does not take its answer."""
        with (tmp_path / "big.mcap").open("wb") as log:
            log.truncate(64_000_000)
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, tmp_path],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with child:
            origin = child.stdout.readline().strip().rpartition(" ")[2]
            link = child.stdout.readline().strip().removeprefix("open ")
            port = int(origin.rpartition(":")[2])
            head, path = f"Host: 127.0.0.1:{port}\r\n", link.removeprefix(origin)
            answer = raw(port, f"GET {path} HTTP/1.1\r\n{head}Connection: close\r\n\r\n".encode())
            cookie = answer.partition(b"set-cookie: ")[2].partition(b";")[0].decode()
            with (
                connect(
                    f"ws://127.0.0.1:{port}/_nicegui_ws/socket.io/?EIO=4&transport=websocket",
                    origin=origin,
                    additional_headers={"cookie": cookie},
                    proxy=None,
                    close_timeout=1,
                ) as line,
                socket.create_connection(("127.0.0.1", port)) as silent,
                socket.create_connection(("127.0.0.1", port)) as stalled,
            ):
                assert line.recv(timeout=5).startswith("0")
                silent.sendall(b"GET /")
                request = f"GET /logs/big.mcap HTTP/1.1\r\n{head}Cookie: {cookie}\r\n\r\n"
                stalled.sendall(request.encode())
                assert stalled.recv(64).startswith(b"HTTP/1.1 200")  # and nothing of the rest
                begun = time.monotonic()
                child.send_signal(number)
                assert child.stdout.readline() == "put away\n"
                spent = time.monotonic() - begun
            assert child.wait(10.0) == 0
            assert child.stderr.read() == ""
        assert spent < 2.0

    def test_pressing_ctrl_c_twice_shows_no_traceback(self, tmp_path):
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, tmp_path],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with child:
            child.stdout.readline()
            child.stdout.readline()
            for _ in range(2):
                child.send_signal(signal.SIGINT)
                time.sleep(0.03)  # two signals at once are one
            out, err = child.communicate(timeout=20.0)
        assert out == "put away\n"
        assert err == ""
        assert child.returncode == 0
