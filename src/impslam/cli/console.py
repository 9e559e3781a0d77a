"""What the commands share: options, logging, and tables on the terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter

from impslam.cli import waiting

if TYPE_CHECKING:
    from rich.console import Console
    from rich.padding import Padding
    from rich.table import Table

WIDTH = 120
"""Columns where there is no terminal to fit."""

Flag: TypeAlias = Annotated[bool, Parameter(negative="", show_default=False)]
Settings: TypeAlias = Annotated[
    tuple[str, ...],
    Parameter(
        name="--set",
        negative="",
        show_default=False,
        help="Override a parameter: --set filter.kind=ekf.",
    ),
]
Base: TypeAlias = Annotated[
    str | None,
    Parameter(
        name=["--config", "-c"],
        help="A preset (`imp list presets`) or a TOML file. Default: the preset that fits the log.",
    ),
]
Jobs: TypeAlias = Annotated[
    int | None, Parameter(name=["--jobs", "-j"], help="Processes. Default: all cores.")
]
Target: TypeAlias = Annotated[Path, Parameter(name=["--output", "-o"])]
Output: TypeAlias = Annotated[Path | None, Parameter(name=["--output", "-o"])]
Force: TypeAlias = Annotated[
    bool,
    Parameter(
        negative="",
        show_default=False,
        help="Replace the run in the folder of -o, once the new one is complete.",
    ),
]
Topics: TypeAlias = Annotated[
    tuple[str, ...],
    Parameter(
        name="--topic",
        negative="",
        show_default=False,
        help="Use a topic for a role: --topic scan=/scan.",
    ),
]
Columns: TypeAlias = Annotated[
    tuple[str, ...],
    Parameter(
        name="--columns",
        negative="",
        show_default=False,
        help="Name the columns of a CSV log: --columns stamp=t,ranges=r0:r359*0.001.",
    ),
]
Seed: TypeAlias = Annotated[int | None, Parameter(help="Seed of everything that is random.")]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Common:
    """Options of every command.

    Parameters
    ----------
    quiet
        Print errors only.
    verbose
        Print more while running.
    debug
        Print the traceback of an error.
    """

    quiet: Flag = False
    verbose: Annotated[
        bool, Parameter(name=["--verbose", "-v"], negative="", show_default=False)
    ] = False
    debug: Flag = False


class LogLines(logging.Handler):
    """One line on stderr for each entry of the log, like the errors, so that both can be searched.

    It writes to whatever `sys.stderr` is at the time: a progress bar takes its place and moves on.
    """

    def emit(self, record: logging.LogRecord) -> None:
        """Write an entry."""
        waiting.end()
        sys.stderr.write(f"imp: {record.levelname.lower()}: {record.getMessage()}\n")


def configure(common: Common | None) -> None:
    """Show the library's log on stderr, as much of it as was asked for."""
    common = common or Common()
    level = logging.INFO if common.verbose else logging.WARNING
    level = logging.DEBUG if common.debug else logging.ERROR if common.quiet else level
    log = logging.getLogger("impslam")
    log.setLevel(level)
    log.propagate = False
    log.handlers[:] = [LogLines()]


def described(sentence: str, command: str, *examples: str) -> str:
    """Return the help of a command, with examples of the words after its name."""
    lines = [f"- `{' '.join(f'imp {command} {words}'.split())}`" for words in examples]
    return "\n".join([sentence, "", "For example:", "", *lines])


def stdout() -> Console:
    """Return the console for results; text is taken literally."""
    return _console(sys.stdout.isatty(), stderr=False)


def stderr() -> Console:
    """Return the console for progress and errors."""
    return _console(sys.stderr.isatty(), stderr=True)


def _console(terminal: bool, stderr: bool) -> Console:
    from rich.console import Console

    width = None if terminal else WIDTH
    return Console(stderr=stderr, width=width, markup=False, highlight=False, soft_wrap=False)


def show_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], title: str = "", numbers: int = 0
) -> None:
    """Print a table; the last `numbers` columns are flush right."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for i, name in enumerate(header):
        right = i >= len(header) - numbers
        table.add_column(Text(name), justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    _print(table)


def show_indented(table: Table, indent: int) -> None:
    """Print a table some columns further right."""
    from rich.padding import Padding

    _print(Padding(table, (0, 0, 0, indent)))


def _print(table: Table | Padding) -> None:
    """Print what rich lays out, without the blanks that it fills lines with."""
    console = stdout()
    with console.capture() as text:
        console.print(table)
    for line in text.get().splitlines():
        say(line.rstrip())


def show_facts(facts: Mapping[str, str]) -> None:
    """Print names and values, one a line, values flush left."""
    width = max(map(len, facts))
    for name, value in facts.items():
        say(f"{name:<{width}}  {value}")


COPED_WITH = frozenset({"gap", "backward stamp", "repeated stamp", "odometry off"})
"""Kinds of problems with a log that do a run no harm."""


def show_problem(kind: str, count: int, example: str) -> None:
    """Print what was wrong with a log: how often, and the first time."""
    say(f"{'note' if kind in COPED_WITH else 'problem'}: {count} x {kind}: {example}")


def show_finding(kind: str, text: str, *, harmful: bool) -> None:
    """Print what a diagnosis found: a problem, or something that a run copes with."""
    say(f"{'problem' if harmful else 'note'}: {kind}: {text}")


def say(text: str = "") -> None:
    """Print a line of a result, however long."""
    waiting.end()
    sys.stdout.write(text + "\n")
