"""The command line: its commands, and how failures map to one-line messages and exit codes."""

from __future__ import annotations

import errno
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

from cyclopts import App, CycloptsError, MissingArgumentError, UnusedCliTokensError

import impslam
from impslam.cli import pipes, startup_notice
from impslam.cli.commands import COMMANDS, USAGES
from impslam.cli.console import configure_logging, help_text
from impslam.cli.interruption import stopped_at_once
from impslam.errors import ImpError, Interrupted, QuitError

OK, UNEXPECTED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130


def make_app() -> App:
    """Return the command-line application."""
    app = App(
        name="imp",
        help=help_text(
            "2D lidar SLAM for small wheeled robots: turn a log into a path and a map.",
            "",
            "demo",
            "run mylog.mcap -o office",
            "run --help",
        ),
        version=lambda: impslam.__version__,  # reading it takes 25 ms, so only for --version
    )
    for number, (name, (function, summary, examples)) in enumerate(COMMANDS.items()):
        text = help_text(summary, name, *examples)
        more: dict[str, Any] = {"usage": USAGES[name]} if name in USAGES else {}
        app.command(f"impslam.cli.{function}", name=name, help=text, sort_key=number, **more)
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code.

    0: success; 1: an internal error; 2: unusable input; 130: interrupted; 143: terminated; 129: the
    terminal was closed.
    """
    if arguments is None:
        pipes.ignore_broken_pipes()
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    try:
        with stopped_at_once():
            _check_encoding(words)
            _run_command(words)
            sys.stdout.flush()
    except KeyboardInterrupt as error:
        code = error.code if isinstance(error, Interrupted) else INTERRUPTED
        message = str(error) or "interrupted; the files written so far are valid"
        return _fail(code, error, message, debug)
    except QuitError as error:
        return _fail(INTERRUPTED, error, str(error), debug)
    except ImpError as error:
        return _fail(UNUSABLE, error, f"error: {error}", debug)
    except OSError as error:
        path = f"{error.filename}: " if error.filename else ""
        advice = "free disk space" if error.errno in _FULL else "check the path"
        return _fail(UNUSABLE, error, f"error: {path}{error.strerror or error}; {advice}", debug)
    except Exception as error:  # a bug in this program; users get one line, not a traceback
        place = _plugin(error)
        advice = (
            f"raised by {place}; see --debug" if place else "run again with --debug and report it"
        )
        return _fail(UNEXPECTED, error, f"error: {type(error).__name__}: {error}; {advice}", debug)
    return OK


_FULL = frozenset({errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)})


def _plugin(error: BaseException) -> str:
    """Return the component of a plug-in in which an error arose, with its file and line, or ""."""
    component = sys.modules.get("impslam.component")  # not loaded by commands without components
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        kind: type[Any] = type(frame.f_locals.get("self"))
        file = frame.f_code.co_filename  # not that of a base class
        outside = not kind.__module__.startswith("impslam.") and file == _file(kind)
        if component is not None and outside and issubclass(kind, component.Component):
            return f"{kind.role} {kind.name!r} of the plug-in {file}, line {line}"
    return ""


def _file(kind: type[Any]) -> str:
    """Return the file in which a class is defined, or ""."""
    return getattr(sys.modules.get(kind.__module__), "__file__", None) or ""


def _check_encoding(words: list[str]) -> None:
    """Reject arguments that are not valid UTF-8: reports and summaries could not contain them."""
    for word in words:
        if not word.isascii() and "\\udc" in (escaped := ascii(word)):
            raise ImpError(f"{escaped[:100]}: is not UTF-8; rename it")


def _run_command(words: list[str]) -> None:
    try:
        command, bound, _ = make_app().parse_args(words, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        raise ImpError(_usage_error(error)) from error
    configure_logging(bound.arguments.get("common"))
    run: Callable[..., object] = command
    startup_notice.begin(words)
    try:
        run(*bound.args, **bound.kwargs)
    finally:
        startup_notice.end()


def _usage_error(error: CycloptsError) -> str:
    """Return one line that names the command and what is wrong with its arguments."""
    name = " ".join(("imp", *(error.command_chain or ())))
    advice = f"see {name} --help"
    if isinstance(error, UnusedCliTokensError):
        unused = " ".join(error.unused_tokens or ())
        return f"{name} takes no further argument, but got {unused}; {advice}"
    if isinstance(error, MissingArgumentError):
        what = error.argument.names[0] if error.argument is not None else "an argument"
        lack = "needs a value" if error.keyword else "is missing"
        return f"{name}: {what} {lack}; {advice}"
    text = str(error).partition(" Available commands")[0].rstrip(".")  # the advice shows them all
    said = f"{name}: {text[:1].lower()}{text[1:]}"
    return f"{said} S{advice[1:]}" if text.endswith("?") else f"{said}; {advice}"


def _fail(code: int, error: BaseException, message: str, debug: bool) -> int:
    """Print the message and the error's notes on stderr, as one line; return the exit code."""
    if debug:
        traceback.print_exception(error)
    text = "; ".join([message, *getattr(error, "__notes__", ())])
    sys.stderr.write(f"imp: {' '.join(text.split())}\n")
    return code
