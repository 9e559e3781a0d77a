"""The robot as a systemd service: its unit file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from impslam.errors import ConfigError

WATCHDOG = 10  # s without a sign of life until systemd starts it anew; the robot stands after 0.5 s

# What useradd(8) takes by default, and nothing that could end the line.
_USER = re.compile(r"[a-z_][a-z0-9_-]{0,30}\$?")


def unit(program: Path, user: str, folder: Path, arguments: Sequence[str] = ()) -> str:
    """Return the text of a unit file that runs `program arguments...` as a user.

    Parameters
    ----------
    program : absolute path of what is run, e.g. `/home/imp/venv/bin/imp`
    user : whose it is; serial ports and cameras are allowed to it by the unit
    folder : absolute path where logs and maps are kept; it is also the working directory
    arguments : anything; what means something to systemd is escaped

    Raises
    ------
    ConfigError
        If a path is not absolute, there is no such user, or something holds a control character.
    """
    for path in (program, folder):
        if not path.is_absolute():
            raise ConfigError(f"{path}: a service needs absolute paths; give the whole path")
    for word in (str(program), str(folder), *arguments):
        if not word.isprintable():
            raise ConfigError(f"{word!r}: a unit file takes no such characters; rename it")
    template = Template((files("impslam.platform.station") / "imp.service").read_text("utf-8"))
    return template.substitute(
        # systemd puts no variables into the program's own path, only into its arguments.
        command=" ".join(
            [_quoted(str(program)), *(_quoted(a).replace("$", "$$") for a in arguments)]
        ),
        user=user,
        workplace=_plain(str(folder)),
        folder=_quoted(str(folder)),
        accounts=_plain(str(_home(user) / ".config" / "impslam")).replace(" ", "\\x20"),
        watchdog=WATCHDOG,
    )


def _home(user: str) -> Path:
    if _USER.fullmatch(user) is None:
        raise ConfigError(f"{user!r} is no user's name; give --user the one that runs the robot")
    try:
        return Path(f"~{user}").expanduser()
    except RuntimeError:
        raise ConfigError(f"there is no user {user!r}; make one: sudo adduser {user}") from None


def _plain(text: str) -> str:
    """Return text in which systemd.unit(5) finds no specifier."""
    return text.replace("%", "%%")


def _quoted(text: str) -> str:
    """Return one word, whatever is in it (systemd.syntax(7))."""
    return '"' + _plain(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'
