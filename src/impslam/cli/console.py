"""Options, logging and terminal output shared by the commands."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shutil import get_terminal_size
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter, Token, validators

from impslam.cli import startup_notice

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

WIDTH = 120
"""Columns of the output if it does not go to a terminal."""
MIN_WRAPPED = 20
"""Columns of wrapped text at least, however narrow the terminal is."""


def whole_number(kind: object, tokens: Sequence[Token]) -> int:
    """Return the integer that a user typed; cyclopts would round 1.5."""
    del kind
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f'"{tokens[0].value}" is not a whole number') from None


Whole: TypeAlias = Annotated[int, Parameter(converter=whole_number)]
Flag: TypeAlias = Annotated[bool, Parameter(negative="", show_default=False)]
Repeatable: TypeAlias = Annotated[tuple[str, ...], Parameter(negative="", show_default=False)]
Settings: TypeAlias = Annotated[
    Repeatable,
    Parameter(name="--set", help="Override a parameter: --set sensors.lidar.range_max=8."),
]
ConfigName: TypeAlias = Annotated[
    str | None,
    Parameter(
        name=["--config", "-c"],
        help="A preset (see `imp list presets`) or a TOML file. Default: the preset that fits the log.",
    ),
]
Jobs: TypeAlias = Annotated[
    int | None,
    Parameter(
        name=["--jobs", "-j"],
        help="Number of processes. Default: all cores.",
        converter=whole_number,
    ),
]
RequiredOutput: TypeAlias = Annotated[Path, Parameter(name=["--output", "-o"])]
Output: TypeAlias = Annotated[Path | None, Parameter(name=["--output", "-o"])]
Force: TypeAlias = Annotated[
    Flag,
    Parameter(help="Replace an existing run in the -o folder once the new one is complete."),
]
Topics: TypeAlias = Annotated[
    Repeatable,
    Parameter(
        name="--topic",
        help="Assign a topic to a role: --topic scan=/scan. Roles: scan, wheels, voltages, velocity, "
        "odometry, imu, fix, image, truth.",
    ),
]
Columns: TypeAlias = Annotated[
    Repeatable,
    Parameter(
        name="--columns",
        help="Map the columns of a CSV log: --columns stamp=t,ranges=r0:r359*0.001.",
    ),
]
Seed: TypeAlias = Annotated[
    int | None,
    Parameter(help="Random seed. Default: that of the config.", converter=whole_number),
]
SimulationSeed: TypeAlias = Annotated[
    Whole, Parameter(validator=validators.Number(gte=0, lt=1 << 63))
]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Common:
    """Options that every command takes.

    Parameters
    ----------
    quiet
        Print errors only; `inspect`, `list` and `config` still print their result.
    verbose
        Print more detail while running.
    debug
        Print debug messages, and the traceback of an error.
    """

    quiet: Flag = False
    verbose: Annotated[Flag, Parameter(name=["--verbose", "-v"])] = False
    debug: Flag = False


class LogLineHandler(logging.Handler):
    """Writes each log record to stderr as one line, in the format of the error messages.

    `sys.stderr` is looked up for each record because a progress bar replaces it while it is shown.
    """

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        startup_notice.end()
        sys.stderr.write(f"imp: {record.levelname.lower()}: {record.getMessage()}\n")


def configure_logging(common: Common | None) -> None:
    """Send the library's log to stderr at the level given by the common options."""
    common = common or Common()
    level = logging.INFO if common.verbose else logging.WARNING
    level = logging.DEBUG if common.debug else logging.ERROR if common.quiet else level
    log = logging.getLogger("impslam")
    log.setLevel(level)
    log.propagate = False
    log.handlers[:] = [LogLineHandler()]


def help_text(summary: str, command: str, *examples: str) -> str:
    """Return the help of a command; each example holds the arguments after the command's name."""
    lines = [f"- `{' '.join(f'imp {command} {arguments}'.split())}`" for arguments in examples]
    return "\n".join([summary, "", "For example:", "", *lines])


def stdout() -> Console:
    """Return the console for results, without markup."""
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
    """Print a table with its last `numbers` columns right-aligned."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title or None, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for i, name in enumerate(header):
        right = i >= len(header) - numbers
        table.add_column(Text(name), justify="right" if right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    print_table(table)


def print_table(table: Table) -> None:
    """Print a table of rich without trailing blanks."""
    console = stdout()
    with console.capture() as text:
        console.print(table)
    for line in text.get().splitlines():
        echo(line.rstrip())


def show_columns(rows: Sequence[Sequence[str]], indent: int) -> None:
    """Print rows as left-aligned columns; the last one is wrapped at the width of the output."""
    widths = [max(map(len, column)) + 2 for column in zip(*rows, strict=True)][:-1]
    width = get_terminal_size().columns if sys.stdout.isatty() else WIDTH
    left = width - indent - sum(widths)
    wrapper = TextWrapper(max(left, MIN_WRAPPED), break_on_hyphens=False)
    for *cells, text in rows:
        start = "".join(cell.ljust(w) for cell, w in zip(cells, widths, strict=True))
        for line in wrapper.wrap(text) or [""]:
            echo(f"{' ' * indent}{start}{line}".rstrip())
            start = " " * sum(widths)


def show_facts(facts: Mapping[str, str]) -> None:
    """Print names and values, one pair per line, in two left-aligned columns."""
    width = max(map(len, facts))
    for name, value in facts.items():
        echo(f"{name:<{width}}  {value}")


HARMLESS = frozenset(
    {
        "gap",
        "backward stamp",
        "repeated stamp",
        "odometry off",
        "no angle increment",
        "no time increment",
    }
)
"""Kinds of problems with a log that do not harm a run."""


def show_problem(kind: str, count: int, example: str) -> None:
    """Print a kind of problem with a log: its number of occurrences and the first of them."""
    echo(f"{'note' if kind in HARMLESS else 'problem'}: {count} x {kind}: {example}")


def show_finding(kind: str, text: str, *, harmful: bool) -> None:
    """Print a finding of the diagnosis, as a problem or as a note."""
    echo(f"{'problem' if harmful else 'note'}: {kind}: {text}")


def echo(*lines: str) -> None:
    """Print lines of output; long ones are not wrapped."""
    startup_notice.end()
    sys.stdout.write("".join(line + "\n" for line in lines))
