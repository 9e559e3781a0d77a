"""While a command has nothing to show, the terminal tells that it has begun."""

import io
import time
from types import SimpleNamespace

import pytest

from impslam.cli import console, waiting


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def screen(monkeypatch):
    made = Terminal()
    monkeypatch.setattr(waiting, "sys", SimpleNamespace(stderr=made))
    monkeypatch.setattr(waiting, "AFTER", 0.01)
    monkeypatch.setattr(waiting, "EVERY", 0.01)
    yield made
    waiting.end()


def shown(screen):
    end = time.monotonic() + 5.0
    while not screen.getvalue() and time.monotonic() < end:
        time.sleep(0.005)
    return screen.getvalue()


def test_it_is_told_until_the_first_line_of_a_result(screen, capsys):
    waiting.begin(["run", "some.log"])
    assert "imp run: starting" in shown(screen)
    console.say("done")
    assert screen.getvalue().endswith(waiting.CLEAR)
    before = screen.getvalue()
    time.sleep(0.05)
    assert screen.getvalue() == before
    assert capsys.readouterr().out == "done\n"


def test_long_starts_are_explained(screen, monkeypatch):
    monkeypatch.setattr(waiting, "PATIENCE", 0.0)
    waiting.begin(["map", "info"])
    assert "the very first run compiles" in shown(screen)


@pytest.mark.parametrize("words", [[], ["--version"], ["robot"], ["run", "x", "--quiet"]])
def test_some_commands_have_nothing_to_wait_for(screen, words):
    waiting.begin(words)
    time.sleep(0.05)
    assert screen.getvalue() == ""


def test_nothing_is_written_where_nobody_looks_on(monkeypatch):
    made = io.StringIO()
    monkeypatch.setattr(waiting, "sys", SimpleNamespace(stderr=made))
    monkeypatch.setattr(waiting, "AFTER", 0.01)
    waiting.begin(["run"])
    time.sleep(0.05)
    assert made.getvalue() == ""
