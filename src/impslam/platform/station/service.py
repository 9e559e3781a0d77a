"""The robot as a systemd service: its unit file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

from impslam.errors import ConfigError

WATCHDOG = 10  # s without a keep-alive until systemd restarts it; the robot stops after 0.5 s

# What useradd(8) takes by default, and nothing that could end the line.
_USER = re.compile(r"[a-z_][a-z0-9_-]{0,30}\$?")


def unit(program: Path, user: str, folder: Path, arguments: Sequence[str] = ()) -> str:
    """Return the text of a unit file that runs `program arguments...` as a user.

    Parameters
    ----------
    program : absolute path of the program, e.g. `/home/imp/venv/bin/imp`
    user : runs the program; the unit gives it access to serial ports and cameras
    folder : absolute path of logs and maps, and the working directory
    arguments : any text; characters that are special to systemd are escaped

    Raises
    ------
    ConfigError
        If a path is not absolute, there is no such user, or a word has a control character.
    """
    for path in (program, folder):
        if not path.is_absolute():
            raise ConfigError(f"{path}: a service needs absolute paths; give the whole path")
    for word in (str(program), str(folder), *arguments):
        if not word.isprintable():
            raise ConfigError(f"{word!r}: a unit file cannot contain such characters; rename it")
    template = Template((files("impslam.platform.station") / "imp.service").read_text("utf-8"))
    return template.substitute(
        # systemd expands variables only in arguments, not in the path of the program.
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
        raise ConfigError(f"{user!r} is not a user name; give --user the user that runs the robot")
    try:
        return Path(f"~{user}").expanduser()
    except RuntimeError:
        raise ConfigError(f"there is no user {user!r}; create it: sudo adduser {user}") from None


def _plain(text: str) -> str:
    """Return text without specifiers of systemd.unit(5)."""
    return text.replace("%", "%%")


def _quoted(text: str) -> str:
    """Return a text as one quoted word (systemd.syntax(7))."""
    return '"' + _plain(text.replace("\\", "\\\\").replace('"', '\\"')) + '"'
