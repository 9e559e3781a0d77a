"""The commands as a person meets them: in a terminal, with bars that move and questions."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from impslam.cli import main
from impslam.platform.console.accounts import Accounts

IMP = Path(sys.executable).with_name("imp")
OWN = "import os, sys; os.open(os.ttyname(0), os.O_RDWR); os.execv(sys.argv[1], sys.argv[1:])"
"""Makes the terminal a program's own, whose keys are its signals, and becomes that program."""
PATIENCE = 120.0  # s, for what compiles on a loaded machine
CURSOR = "\x1b[?25h"  # shown again
HIDDEN = "\x1b[?25l"


def in_terminal(
    *words: object, typed: Mapping[str, str] | None = None, **environment: str
) -> tuple[int, str]:
    """Run `imp` in a terminal and return its exit code and all that it wrote there.

    What `typed` holds for a text is typed when that text has appeared; each but once, in order.
    """
    ours, its = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", OWN, IMP, *map(str, words)],
        stdin=its,
        stdout=its,
        stderr=its,
        start_new_session=True,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", **environment},
    )
    os.close(its)
    said, waiting, end = "", list((typed or {}).items()), time.monotonic() + PATIENCE
    try:
        while time.monotonic() < end:
            try:
                piece = os.read(ours, 65536)
            except OSError:  # Linux's way to say that nobody has it open any more
                break
            if not piece:
                break
            said += piece.decode(errors="replace")
            if waiting and waiting[0][0] in said:
                os.write(ours, waiting.pop(0)[1].encode())
        return process.wait(PATIENCE), said
    finally:
        process.kill()
        process.wait()
        os.close(ours)


@pytest.mark.parametrize(
    "words",
    [
        ("run", "{log}", "-o", "{new}"),
        ("inspect", "{log}"),
        ("simulate", "room", "-o", "{new}.mcap"),
    ],
    ids=lambda words: words[0],
)
def test_slow_commands_show_a_progress_bar(
    words: tuple[str, ...], room: Path, tmp_path: Path
) -> None:
    code, said = in_terminal(*(w.format(log=room, new=tmp_path / "new") for w in words))
    assert code == 0, said
    assert "━" in said
    assert said.rindex(CURSOR) > said.rindex(HIDDEN)


def test_the_bar_of_a_run_shows_its_progress(room: Path, tmp_path: Path) -> None:
    slow = ("--set", "keyframes.distance=0", "--set", "sensors.lidar.extractors.walls.kind=hough")
    code, said = in_terminal("run", room, "-o", tmp_path / "run", *slow)
    assert code == 0
    assert re.search(r"mapping, [\d,]+ scans/s .*━", said), "it moves on from starting"


@pytest.mark.parametrize("words", [("list",), ("config", "imp"), ("evaluate", "{run}")])
def test_quick_commands_work_in_a_terminal(
    words: tuple[str, ...], room: Path, tmp_path: Path
) -> None:
    if "{run}" in words:
        assert main(["run", str(room), "-o", str(tmp_path), "--quiet"]) == 0
    code, said = in_terminal(*(w.format(run=tmp_path) for w in words))
    assert code == 0, said
    assert len(said.splitlines()) > 3


def test_ctrl_c_prints_one_line_and_restores_the_cursor(tmp_path: Path) -> None:
    """In the demo, whose bars are those of `simulate` and `run`."""
    code, said = in_terminal("demo", "-o", tmp_path / "run", typed={"simulating": "\x03"})
    assert code == 130
    assert "Traceback" not in said
    assert said.rindex(CURSOR) > said.rindex(HIDDEN)


def test_ctrl_c_keeps_the_partial_map(room: Path, tmp_path: Path) -> None:
    slow = ("--set", "keyframes.distance=0", "--set", "sensors.lidar.extractors.walls.kind=hough")
    code, said = in_terminal("run", room, "-o", tmp_path / "run", *slow, typed={"mapping": "\x03"})
    assert code == 130
    assert "marked as partial" in said
    assert said.rindex(CURSOR) > said.rindex(HIDDEN)
    assert '"partial": "interrupted' in (tmp_path / "run" / "summary.json").read_text()


def test_a_password_is_prompted_for_twice_and_never_shown(tmp_path: Path) -> None:
    word = "four walls, three cylinders"
    typed = {"new password to drive: ": f"{word}\n", "again: ": f"{word}\n"}
    code, said = in_terminal("robot", "password", typed=typed, XDG_CONFIG_HOME=str(tmp_path))
    assert code == 0, said
    assert word not in said
    assert Accounts(tmp_path / "impslam" / "accounts.json").right(word) == "drive"
