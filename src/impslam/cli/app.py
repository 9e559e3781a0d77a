"""The commands by name, and how a failure ends: one line, and an exit code that says what it was."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence

from cyclopts import App, CycloptsError

import impslam
from impslam.cli import pipes, waiting
from impslam.cli.console import configure, described
from impslam.errors import ImpError, Interrupted, QuitError

OK, UNEXPECTED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


COMMANDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "demo": (
        "demo:demo",
        "Simulate the arena of the thesis, map it, and score the map.",
        ("", "--seed 3 -o demo", "-c thesis-both"),
    ),
    "run": (
        "run:run",
        "Map a log: write its path, landmarks, grid and report into a folder.",
        (
            "monday.mcap -o monday",
            "drive.bag -c myrobot.toml --topic scan=/front/scan",
            "tuesday.mcap --map monday/map.imp --frozen -o tuesday",
        ),
    ),
    "simulate": (
        "simulate:simulate",
        "Simulate a drive in a world, and write its log and truth.",
        ("office -o office.mcap", "hall.toml -o hall.mcap --seed 1 --set lidar.range_max=10"),
    ),
    "evaluate": (
        "evaluate:evaluate",
        "Score runs against the truth or measured relations.",
        ("first second -o compare.png", "first --truth truth.tum --json first.json"),
    ),
    "sweep": (
        "sweep:sweep",
        "Run logs x configs x settings x seeds, and tabulate the errors.",
        ("monday.log tuesday.log -c default -c mine.toml -o sweep", "arena --seeds 20 -o arena"),
    ),
    "tune": (
        "tune:tune",
        "Find noise and gates by many runs, and write a config.",
        (
            "monday.log -c mine.toml --score likelihood -o tune",
            "monday.log --holdout tuesday.log --search association.gate=0.9,0.99,0.999",
        ),
    ),
    "track": (
        "track:track",
        "Find the robot's true path in the video of an overhead camera.",
        ("overhead.mp4 -o truth.tum", "overhead.mp4 --setup camera.toml -o truth.tum"),
    ),
    "reproduce": (
        "reproduce:reproduce",
        "Run the thesis's experiments: its tables and figures.",
        ("points --seeds 1", "corridor --full -o corridor"),
    ),
    "robot": (
        "robot:app",
        "Drive, record and map from a page that the robot serves.",
        ("--virtual", "-c robot.toml --record --map"),
    ),
    "map": (
        "map:app",
        "Inspect, straighten, compare, merge and export maps.",
        ("info office.imp", "merge one.imp two.imp -o all.imp"),
    ),
    "inspect": (
        "inspect:inspect",
        "Print what is in a log, and what is wrong with it.",
        ("drive.mcap", "drive.mcap -c myrobot.toml"),
    ),
    "calibrate": (
        "calibrate:calibrate",
        "Find wheels, laser pose, latency and noise of a robot from its logs.",
        ("drive.mcap -o mine.toml", "one.bag two.bag -c myrobot.toml --keep track -o mine.toml"),
    ),
    "list": (
        "list:list_components",
        "Print the components of each role and their parameters.",
        ("presets", "filter"),
    ),
    "config": (
        "config:config",
        "Print every parameter of a preset or file, as TOML.",
        ("imp", "myrobot.toml --set filter.kind=ekf"),
    ),
    "--install-completion": (
        "completion:install_completion",
        "Install the completion of commands and options for your shell.",
        ("", "--shell zsh"),
    ),
}
"""Where each command is, imported when it is called, so that `imp --help` need not wait; what it does;
and examples."""


def make_app() -> App:
    """Return the command line."""
    app = App(
        name="imp",
        help=described(
            "SLAM for small wheeled robots with a 2D lidar: a log in, a path and a map out.",
            "",
            "demo",
            "run mylog.mcap -o office",
            "run --help",
        ),
        version=lambda: impslam.__version__,  # 25 ms, for --version alone
    )
    for number, (name, (place, sentence, examples)) in enumerate(COMMANDS.items()):
        shown = described(sentence, name, *examples)
        app.command(f"impslam.cli.{place}", name=name, help=shown, sort_key=number)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: done; 1: a fault of the program; 2: input that cannot be used; 130: interrupted; 143:
    terminated; 129: the terminal was closed.
    """
    if arguments is None:
        pipes.outlive_readers()
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    try:
        _check(words)
        _call(words)
        sys.stdout.flush()
    except KeyboardInterrupt as error:
        code = error.code if isinstance(error, Interrupted) else INTERRUPTED
        said = str(error) or "interrupted; what is written so far is valid"
        return _end(code, error, said, debug)
    except QuitError as error:
        return _end(INTERRUPTED, error, str(error), debug)
    except (ImpError, CycloptsError) as error:
        return _end(UNUSABLE, error, f"error: {error}", debug)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _end(
            UNUSABLE, error, f"error: {where}{error.strerror or error}; check the path", debug
        )
    except Exception as error:  # whatever else happens is ours, and must not end in a wall of text
        what = f"{type(error).__name__}: {error}"
        return _end(
            UNEXPECTED, error, f"error: {what}; run again with --debug and report it", debug
        )
    return OK


def _check(words: list[str]) -> None:
    """Refuse names that cannot be written down: they stand in reports and summaries."""
    for word in words:
        if not word.isascii() and "\\udc" in (said := ascii(word)):
            raise ImpError(f"{said[:100]}: is not UTF-8; rename it")


def _call(words: list[str]) -> None:
    command, bound, _ = make_app().parse_args(words, exit_on_error=False, print_error=False)
    configure(bound.arguments.get("common"))
    run: Callable[..., object] = command
    waiting.begin(words)
    try:
        run(*bound.args, **bound.kwargs)
    finally:
        waiting.end()


def _end(code: int, error: BaseException, message: str, debug: bool) -> int:
    """Say on stderr, in one line, why the command ends and what it leaves."""
    if debug:
        traceback.print_exception(error)
    said = "; ".join([message, *getattr(error, "__notes__", ())])
    sys.stderr.write(f"imp: {' '.join(said.split())}\n")
    return code
