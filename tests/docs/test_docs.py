"""What the pages say is so: commands and code are run, or are at least understood."""

import json
import re
import shlex
import shutil
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.docs.notebook import NOTEBOOK, execute
from tests.registry import own_registry

from impslam.cli import main
from impslam.cli.app import make_app
from impslam.config import load
from impslam.observers import video

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
RUN = ["tutorial", "your-robot", "tasks", "parts"]
"""Pages that a reader follows from top to bottom, in an empty folder."""
FENCE = re.compile(r"^ *```+ *(?:\{ \.)?(\w*)[^\n]*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"")
NUMBER = re.compile(r"-?\d+(?:\.\d*)?")


@pytest.fixture(autouse=True)
def _own_registry():
    with own_registry():
        yield


def blocks(page, *languages):
    """Return the code blocks of a page as (language, text), snippets of files left out."""
    found = FENCE.findall(page.read_text("utf-8"))
    return [(name, text) for name, text in found if name in languages and "--8<--" not in text]


def commands(text):
    """Return the words of each call of `imp` in a block of shell commands."""
    lines = text.replace("\\\n", " ").splitlines()
    words = [shlex.split(line.partition(" | ")[0], comments=True) for line in lines]
    return [line[1:] for line in words if line and line[0].removeprefix(".venv/bin/") == "imp"]


@pytest.mark.parametrize("name", RUN)
def test_a_page_does_what_it_says(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(video, "RATE", 2.0)  # coding a frame of the usual size takes 60 ms
    monkeypatch.setattr(video, "SIZE", 200)
    for example in (ROOT / "examples").glob("*.py"):
        shutil.copy(example, tmp_path)
    languages = "sh", "toml", "python", "text"
    printed_last, page = "", blocks(ROOT / "docs" / f"{name}.md", *languages)
    for (language, text), (following, _) in pairwise([*page, ("", "")]):
        if language == "text":
            assert_shown(text, printed_last)
        elif language == "python":
            exec(text, {})
        elif language == "toml":
            file = re.match(r"# (\S+\.toml)\n", text)
            assert file, f"the first line of the config is to name its file: {text}"
            Path(file[1]).write_text(text)
            if "[[walls]]" not in text:
                load(file[1])
        else:
            assert len(commands(text)) == len(text.splitlines()), "each line is one command"
            quiet = () if following == "text" else ("--quiet",)
            for words in commands(text):
                assert main([*words, *quiet]) == 0, words
            said = capsys.readouterr()
            printed_last = said.out
            assert said.err == ""


def assert_shown(text, output):
    """Check that an output has the lines of a page, also if only a part of each or with other breaks.

    Numbers may differ by a tenth, by 3 mm or mrad, or by two units of the last digit.
    """
    words = output.split()
    for line in text.splitlines():
        shown = line.split()
        starts = range(len(words) - len(shown) + 1)
        assert any(alike(shown, words[k : k + len(shown)]) for k in starts), (line, output)


def alike(shown, words):
    """Return whether words are equal, except for their numbers, which are close."""
    if [NUMBER.sub("#", w) for w in shown] != [NUMBER.sub("#", w) for w in words]:
        return False
    pairs = zip(NUMBER.findall(" ".join(shown)), NUMBER.findall(" ".join(words)), strict=True)
    return all(abs(float(a) - float(b)) <= tolerance(a) for a, b in pairs)


def tolerance(number):
    """Return by how much a number may differ from the one on the page."""
    return max(0.1 * abs(float(number)), 3e-3, 2 * 10.0 ** -len(number.partition(".")[2]))


def test_an_output_is_compared_with_the_page():
    assert_shown("scans 912 used\nRMS 0.0043", "log a.mcap\nscans   910 used\nRMS 0.0045 m")
    for other in ("scans 700 used", "scans 912 lost", "scans 912"):
        with pytest.raises(AssertionError):
            assert_shown("scans 912 used", other)


def test_the_example_of_a_config_loads(tmp_path):
    ((_, text),) = blocks(ROOT / "docs" / "config.md", "toml")
    (tmp_path / "mine.toml").write_text(text)
    assert load(tmp_path / "mine.toml").robot == "myrobot"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_config_is_understood(page):
    for language, text in blocks(page, "sh", "toml", "python"):
        if language == "toml":
            tomllib.loads(text)
        elif language == "python":
            compile(text, str(page), "exec")
        else:
            for words in commands(text):
                make_app().parse_args(words, exit_on_error=False, print_error=False)


def test_the_architecture_names_each_folder_and_files_that_exist():
    package = ROOT / "src" / "impslam"
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    names = set(re.findall(r"`([\w/*]+(?:\.py)?)`", page))
    for file in (name for name in names if name.endswith(".py")):
        assert next(package.rglob(file), None), file
    folders = {path.parent for path in package.rglob("*.*") if path.parent.parent == package}
    folders |= set((package / "platform").iterdir())
    named = {str(f.relative_to(package)) for f in folders if f.is_dir()} - {"__pycache__"}
    hidden = {"cli", "platform", "platform/__pycache__"}  # in the text, and in the parts below it
    assert named - hidden <= names
    parts = next(line for line in page.splitlines() if line.startswith("| `estimators`"))
    for part in re.findall(r"`(\w[\w*]*)`", parts.split(" | ")[1].partition("parts of")[2]):
        assert next(package.glob(f"estimators/{part}.py"), None), part


def test_links_out_of_the_site_lead_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]:
        for link in filter(None, sum(LINK.findall(page.read_text("utf-8")), ())):
            assert (page.parent / link).exists(), link


def test_the_notebook_gives_what_it_shows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = json.loads(NOTEBOOK.read_text("utf-8"))
    for then, now in zip(shown["cells"], execute(shown)["cells"], strict=True):
        assert NUMBER.sub("#", printed(then)) == NUMBER.sub("#", printed(now))
        np.testing.assert_allclose(numbers(printed(then)), numbers(printed(now)), 0.05, 0.02)


def printed(cell):
    """Return what a cell prints, pictures as a word."""
    texts = [
        output.get("text", output.get("data", {}).get("text/plain", ["picture"]))
        for output in cell.get("outputs", [])
    ]
    return "\n".join("".join(text) for text in texts)


def numbers(text):
    return [float(number) for number in NUMBER.findall(text)]
