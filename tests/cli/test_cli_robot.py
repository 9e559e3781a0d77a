"""`imp robot` before it serves: what it refuses, and what its other commands write."""

import getpass
import io
import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from impslam.cli import replay, robot
from impslam.errors import ImpError
from impslam.observers import trajectory

ROBOT = """
folder = "logs"
[devices.lidar]
kind = "urg"
port = "/dev/imp-lidar"
"""


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


def type_in(monkeypatch, text):
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


def test_without_a_robot_the_error_says_how_to_name_one(imp):
    said = imp("robot")
    assert said.code == 2
    assert "-c robot.toml" in said.err
    assert "--virtual" in said.err
    assert said.err.count("\n") == 1


def test_the_virtual_robot_is_as_its_options_say(monkeypatch):
    process = pytest.importorskip("impslam.platform.virtual.process")
    asked = {}

    def virtual(world, seed, **options):
        asked.update(world=world, seed=seed, **options)
        raise ImpError("enough")

    monkeypatch.setattr(process, "VirtualRobot", virtual)
    chosen = robot.VirtualOptions(virtual=True, world="room", seed=3, speed_control=True)
    with pytest.raises(ImpError, match="enough"), robot.running_station(None, chosen, None):
        pass
    assert asked == {"world": "room", "seed": 3, "gps": False, "speed_control": True}


def test_a_wrong_robot_file_is_a_one_line_error(imp, tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT.replace("port", "prot"))
    said = imp("robot", "-c", path)
    assert said.code == 2
    assert "did you mean 'port'" in said.err


def test_beyond_loopback_it_asks_for_a_password_first(imp, home):
    path = home / "robot.toml"
    path.write_text(ROBOT)
    said = imp("robot", "-c", path, "--host", "0.0.0.0", "--folder", home / "logs", "--record")
    assert said.code == 2
    assert "set one with `imp robot password`" in said.err
    assert not (home / "logs").exists()


def test_a_password_is_kept_hashed_and_private(imp, home, monkeypatch):
    type_in(monkeypatch, "four walls and a door\n")
    said = imp("robot", "password")
    assert said.code == 0, said.err
    path = home / "config" / "impslam" / "accounts.json"
    assert str(path) in said.out
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert "four walls" not in path.read_text()
    type_in(monkeypatch, "only looking around\n")
    assert imp("robot", "password", "--watch").code == 0
    book = json.loads(path.read_text())
    assert book["drive"] != book["watch"]


def test_a_short_password_is_refused(imp, home, monkeypatch):
    type_in(monkeypatch, "short\n")
    said = imp("robot", "password")
    assert said.code == 2
    assert "characters" in said.err


def test_a_password_typed_twice_must_be_the_same(imp, home, monkeypatch):
    typed = iter(["four walls and a door", "four walls and a d00r"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(robot.getpass, "getpass", lambda prompt: next(typed))
    said = imp("robot", "password")
    assert said.code == 2
    assert "differ" in said.err
    assert not (home / "config").exists()


def test_the_unit_starts_this_robot(imp, home, monkeypatch):
    path = home / "robot.toml"
    path.write_text(ROBOT)
    monkeypatch.chdir(home)
    said = imp("robot", "service", "-c", path, "--user", getpass.getuser(), "--port", "8443")
    assert said.code == 0, said.err
    start = next(line for line in said.out.splitlines() if line.startswith("ExecStart="))
    assert f'/imp" "robot" "-c" "{path}"' in start
    assert '"--port" "8443"' in start
    # The service runs in that folder, where "logs" would be another one.
    assert f'"--folder" "{home}/logs"' in start
    assert f"WorkingDirectory={home}/logs" in said.out
    assert f"User={getpass.getuser()}" in said.out


@pytest.mark.parametrize("words", [("robot", "--virtual"), ("run", "LOG", "--live")])
def test_without_the_extra_the_error_says_what_to_install(imp, room, tmp_path, monkeypatch, words):
    monkeypatch.setattr(replay, "WEB", ("nicegui_is_not_there",))
    words = [room if word == "LOG" else word for word in words]
    if "--live" in words:
        words += ["-o", tmp_path / "run"]
    said = imp(*words)
    assert said.code == 2
    assert re.search(r"pip install .*nicegui|impslam\[robot,web\]", said.err)


@pytest.fixture
def taken():
    """A port that another program listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener.getsockname()[1]


def test_a_port_in_use_is_reported_before_anything_starts(imp, home, taken):
    path = home / "robot.toml"
    path.write_text(ROBOT)
    logs = home / "logs"
    said = imp("robot", "-c", path, "--port", taken, "--folder", logs, "--record")
    assert said.code == 2
    assert f"port {taken}" in said.err
    assert said.err.count("\n") == 1
    assert not logs.exists()


def test_a_replay_on_a_port_in_use_writes_nothing(imp, room, tmp_path, taken):
    began = time.monotonic()
    said = imp("run", room, "--live", "--port", taken, "-o", tmp_path / "run")
    assert said.code == 2
    assert f"port {taken}" in said.err
    assert not (tmp_path / "run").exists()
    assert time.monotonic() - began < 4.0  # nothing was compiled, and nothing had to be ended


COMPILER = """
import os, sys, time
from pathlib import Path
from impslam.platform.station.warm_up import end_with_parent
end_with_parent()
Path(sys.argv[1]).write_text(f"{os.getpid()} ")
time.sleep(60)
"""
STARTING = f"""
import sys, time
from impslam.cli import main
from impslam.platform.console import server
from impslam.platform.station import player, warm_up
def compiling(config):
    warm_up.run_until_either_ends([sys.executable, "-c", {COMPILER!r}, sys.argv.pop()])
after = player.Player.__init__.__defaults__[1:]
player.Player.__init__.__defaults__ = (compiling, *after)
server.prepared = lambda *_: time.sleep(60)
sys.exit(main(sys.argv[1:-1]))
"""


def test_a_signal_before_the_page_is_served_ends_a_replay_at_once(room, tmp_path):
    """Also while kernels are compiled, in a process that then ends, too."""
    pid, folder = tmp_path / "pid", tmp_path / "run"
    words = ["run", str(room), "--live", "--port", "0", "-o", str(folder), str(pid)]
    command = [sys.executable, "-c", STARTING, *words]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not (pid.exists() and pid.read_text().endswith(" ")):
            assert process.poll() is None
            time.sleep(0.05)
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=50)
    assert (process.returncode, err) == (143, "imp: terminated\n")
    assert time.monotonic() - begin < 3.0
    assert not folder.exists()
    while Path(f"/proc/{pid.read_text().strip()}").exists():
        assert time.monotonic() - begin < 10.0
        time.sleep(0.05)


def test_a_replay_stopped_early_prints_one_line_and_writes_the_partial_map(
    imp, room, tmp_path, monkeypatch
):
    """Ctrl-C while the log plays; who leaves the page is not told of a fault."""

    def leave():
        end = time.monotonic() + 300.0  # with nothing compiled yet
        path = tmp_path / "run" / "trajectory.live.tum"
        while not (path.exists() and path.stat().st_size) and time.monotonic() < end:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(trajectory, "FLUSH_ROWS", 1)
    monkeypatch.setattr("impslam.platform.station.player.warm_up", lambda config: None)
    threading.Thread(target=leave, daemon=True).start()
    said = imp("run", room, "--live", "--port", 0, "-o", tmp_path / "run", "--quiet")
    assert said.code == 130
    assert "stopped before the end of the log" in said.err
    assert said.err.count("\n") == 1
    partial = json.loads((tmp_path / "run" / "summary.json").read_text())["partial"]
    assert "stopped before the end of the log" in partial
