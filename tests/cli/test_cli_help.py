"""The help of every command has examples, and they are understood."""

import re
import shlex

import pytest

from impslam.cli.app import make_app
from impslam.cli.commands import COMMANDS
from impslam.cli.map import COMMANDS as MAP_COMMANDS

WORDS = [
    "",
    *COMMANDS,
    *(f"map {name}" for name in MAP_COMMANDS),
    "robot password",
    "robot service",
]


@pytest.mark.parametrize("command", WORDS)
def test_each_help_has_an_example(imp, command) -> None:
    assert re.search(rf"For example: *\n *\n • imp {command}", imp(*command.split(), "--help").out)


def test_each_example_is_understood() -> None:
    examples = re.findall(r"^- `imp (.*)`$", make_app().generate_docs(), re.MULTILINE)
    assert len(examples) > len(WORDS)
    for words in examples:
        typed = shlex.split(words.partition(" | ")[0])
        make_app().parse_args(typed, exit_on_error=False, print_error=False)


@pytest.mark.parametrize("command", ["robot", "simulate"])
def test_worlds_are_not_listed_incompletely(imp, command) -> None:
    text = " ".join(re.sub("│", " ", imp(command, "--help").out).split())
    assert "(see imp list worlds) or a TOML file" in text
