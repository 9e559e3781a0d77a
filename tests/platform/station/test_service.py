import contextlib
import getpass
import os
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from impslam.errors import ConfigError
from impslam.platform.station.service import WATCHDOG, unit
from impslam.platform.station.watchdog import NOTIFY_INTERVAL, Watchdog, notify, watchdog_period

USER = getpass.getuser()
HERE = Path("/srv/imp")


def made(program=Path(sys.executable), user=USER, folder=HERE, arguments=()):
    return unit(program, user, folder, arguments)


def value(text, key):
    (found,) = [line for line in text.splitlines() if line.startswith(f"{key}=")]
    return found.split("=", 1)[1]


def until_silent(link):
    with contextlib.suppress(TimeoutError):
        while True:
            yield link.recv(4096)


@pytest.fixture
def listener(tmp_path, monkeypatch):
    """The socket of systemd, named by NOTIFY_SOCKET."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(str(tmp_path / "notify"))
        link.settimeout(10.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield link


# --------------------------------------------------------------------------- unit


def test_the_unit_has_the_essential_settings():
    text = made(arguments=["robot", "-c", "/srv/imp/my robot.toml"])
    assert value(text, "ExecStart") == f'"{sys.executable}" "robot" "-c" "/srv/imp/my robot.toml"'
    assert value(text, "Type") == "notify"
    assert value(text, "WatchdogSec") == str(WATCHDOG)
    assert value(text, "User") == USER
    assert value(text, "Restart") == "always"
    assert value(text, "NoNewPrivileges") == "yes"
    assert value(text, "ProtectSystem") == "strict"
    assert value(text, "ReadWritePaths").startswith('"/srv/imp" -')
    assert value(text, "ReadWritePaths").endswith("/.config/impslam")
    assert value(text, "SupplementaryGroups") == "dialout video"
    assert "$" not in text  # nothing of the template is left


@pytest.mark.parametrize(
    ("argument", "escaped"),
    [
        ("100%", '"100%%"'),
        ("$HOME", '"$$HOME"'),
        ('say "hi"', r'"say \"hi\""'),
        ("a\\b", r'"a\\b"'),
        ("", '""'),
        ("größe", '"größe"'),
    ],
)
def test_special_characters_of_systemd_are_escaped(argument, escaped):
    words = value(made(arguments=[argument]), "ExecStart")
    assert words == f'"{sys.executable}" {escaped}'
    # Once specifiers and variables are undone, a shell's rules for double quotes are the same.
    if "$" not in argument:
        assert shlex.split(words.replace("%%", "%"))[1] == argument


def test_paths_with_blanks_and_percents():
    text = made(folder=Path("/srv/100% my logs"))
    assert value(text, "WorkingDirectory") == "/srv/100%% my logs"
    assert '"/srv/100%% my logs"' in value(text, "ReadWritePaths")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"program": Path("imp")}, "absolute"),
        ({"folder": Path("logs")}, "absolute"),
        ({"arguments": ["a\nExecStartPre=/bin/evil"]}, "characters"),
        ({"folder": Path("/srv/a\tb")}, "characters"),
        ({"user": "imp\nUser=root"}, "not a user name"),
        ({"user": ""}, "not a user name"),
        ({"user": "nobody-of-that-name"}, "adduser"),
    ],
)
def test_invalid_arguments_are_explained(wrong, message):
    with pytest.raises(ConfigError, match=message) as error:
        made(**wrong)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="needs systemd-analyze")
def test_systemd_finds_nothing_wrong(tmp_path):
    file = tmp_path / "imp.service"
    text = made(folder=tmp_path, arguments=["robot", "-c", '100% $HOME "my" \\robot.toml'])
    file.write_text(text, "utf-8")
    call = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(file)]
    found = subprocess.run(call, capture_output=True, text=True, check=False, timeout=60)
    ours = [line for line in (found.stdout + found.stderr).splitlines() if "imp.service" in line]
    assert ours == []
    # Check that a typo is found.
    file.write_text(text.replace("WatchdogSec=10", "WatchdogSec=ten"), "utf-8")
    found = subprocess.run(call, capture_output=True, text=True, check=False, timeout=60)
    assert "ignoring: ten" in found.stdout + found.stderr


# --------------------------------------------------------------------------- notifications


def test_lines_reach_systemd(listener):
    assert notify("READY=1", "STATUS=two\nlines")
    assert listener.recv(4096) == b"READY=1\nSTATUS=two lines"


@pytest.mark.skipif(sys.platform != "linux", reason="abstract sockets are Linux's")
def test_lines_reach_an_abstract_socket(monkeypatch):
    name = f"imp-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind("\0" + name)
        link.settimeout(10.0)
        monkeypatch.setenv("NOTIFY_SOCKET", "@" + name)
        assert notify("READY=1")
        assert link.recv(4096) == b"READY=1"


@pytest.mark.parametrize("address", ["", "vsock:2:1234", "/nowhere/at/all"])
def test_notify_without_a_listener_does_nothing(monkeypatch, address):
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    assert not notify("READY=1")
    with Watchdog(lambda: True):
        pass


def test_notify_does_not_block_on_a_full_socket(listener):
    begin = time.monotonic()
    while notify("STATUS=" + "x" * 1000):
        assert time.monotonic() - begin < 10.0
    assert time.monotonic() - begin < 10.0


def test_keep_alives_stop_when_the_robot_is_not_alive(listener, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    alive = threading.Event()
    alive.set()
    with Watchdog(alive.is_set, lambda: "drives"):
        assert listener.recv(4096) == b"READY=1"
        begin = time.monotonic()
        for _ in range(5):
            assert listener.recv(4096) == b"WATCHDOG=1\nSTATUS=drives"
        assert time.monotonic() - begin > 0.06  # every 20 ms, not as fast as it can
        alive.clear()
        listener.settimeout(0.3)
        assert len(list(until_silent(listener))) < 5  # some may be on their way
        alive.set()
        listener.settimeout(10.0)
        assert listener.recv(4096).startswith(b"WATCHDOG=1")
    last = b""
    while b"STOPPING" not in last:
        last = listener.recv(4096)
    assert last == b"STOPPING=1"


def test_a_failing_check_counts_as_not_alive(listener, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "20000")

    def fails():
        raise RuntimeError("lost")

    with Watchdog(fails):
        assert listener.recv(4096) == b"READY=1"
        listener.settimeout(0.2)
        with pytest.raises(TimeoutError):
            listener.recv(4096)
    assert listener.recv(4096) == b"STOPPING=1"


@pytest.mark.parametrize(
    ("usec", "process", "period"),
    [
        ("10000000", "", 5.0),
        ("10000000", "SELF", 5.0),
        ("10000000", "1", NOTIFY_INTERVAL),  # of another process
        ("", "", NOTIFY_INTERVAL),
        ("0", "", NOTIFY_INTERVAL),
        ("soon", "", NOTIFY_INTERVAL),
    ],
)
def test_the_period_is_half_of_what_is_allowed(monkeypatch, usec, process, period):
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    monkeypatch.setenv("WATCHDOG_PID", process.replace("SELF", str(os.getpid())))
    assert watchdog_period() == period
