"""The help of every command has examples, and they are understood."""

import re
import shlex
from typing import get_args

import pytest

from impslam.cli.app import make_app
from impslam.cli.commands import COMMANDS
from impslam.cli.map import COMMANDS as MAP_COMMANDS
from impslam.sources.ros_topics import Use

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


@pytest.mark.parametrize(
    ("command", "usage"),
    [
        ("evaluate", "[OPTIONS] RUNS..."),
        ("calibrate", "[OPTIONS] LOGS..."),
        ("sweep", "[OPTIONS] LOGS..."),
        ("tune", "[OPTIONS] LOGS..."),
        ("map merge", "--output PATH [OPTIONS] FILES..."),
    ],
)
def test_the_usage_names_what_a_command_needs(imp, command, usage) -> None:
    assert imp(*command.split(), "--help").out.startswith(f"Usage: imp {command} {usage}\n")


def test_the_roles_of_topics_are_those_of_ros_logs(imp) -> None:
    words = " ".join(re.sub("[│\n]", " ", imp("run", "--help").out).split())
    assert f"Roles: {', '.join(get_args(Use))}." in words


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
