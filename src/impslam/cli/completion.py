"""`imp --install-completion`: let the shell complete commands and options."""

from __future__ import annotations

from typing import Literal, TypeAlias

from impslam.cli import console
from impslam.cli.console import Common
from impslam.errors import ImpError

Shell: TypeAlias = Literal["bash", "zsh", "fish", "powershell"]


def install_completion(*, shell: Shell | None = None, common: Common | None = None) -> None:
    """Install the completion of commands and options for your shell.

    Parameters
    ----------
    shell
        The shell to install it for. Default: the one that is in use.
    """
    from cyclopts.completion.detect import ShellDetectionError

    from impslam.cli.app import make_app

    try:
        script = make_app().install_completion(shell=shell)
    except ShellDetectionError:
        raise ImpError("the shell in use is unknown; name it with --shell bash") from None
    if common is None or not common.quiet:
        console.say(f"{script}: written; open a new shell to use it")
