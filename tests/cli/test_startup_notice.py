"""While a command starts, the terminal shows a notice."""

import io
import time
from types import SimpleNamespace

import pytest

from impslam.cli import console, startup_notice


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def screen(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(startup_notice, "sys", SimpleNamespace(stderr=stream))
    monkeypatch.setattr(startup_notice, "DELAY", 0.01)
    monkeypatch.setattr(startup_notice, "INTERVAL", 0.01)
    yield stream
    startup_notice.end()


def shown(screen):
    end = time.monotonic() + 5.0
    while not screen.getvalue() and time.monotonic() < end:
        time.sleep(0.005)
    return screen.getvalue()


def test_the_notice_disappears_with_the_first_line_of_output(screen, capsys):
    startup_notice.begin(["run", "some.log"])
    assert "imp run: starting" in shown(screen)
    console.echo("done")
    assert screen.getvalue().endswith(startup_notice.CLEAR)
    before = screen.getvalue()
    time.sleep(0.05)
    assert screen.getvalue() == before
    assert capsys.readouterr().out == "done\n"


def test_a_long_start_is_explained(screen, monkeypatch):
    monkeypatch.setattr(startup_notice, "COMPILE_HINT_DELAY", 0.0)
    startup_notice.begin(["map", "info"])
    assert "the first run compiles" in shown(screen)


@pytest.mark.parametrize("words", [[], ["--version"], ["robot"], ["run", "x", "--quiet"]])
def test_commands_without_a_notice(screen, words):
    startup_notice.begin(words)
    time.sleep(0.05)
    assert screen.getvalue() == ""


def test_no_notice_without_a_terminal(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(startup_notice, "sys", SimpleNamespace(stderr=stream))
    monkeypatch.setattr(startup_notice, "DELAY", 0.01)
    startup_notice.begin(["run"])
    time.sleep(0.05)
    assert stream.getvalue() == ""
