"""`imp --install-completion`: shell completion of commands and options."""

from __future__ import annotations

from typing import Literal, TypeAlias

from impslam.cli import console
from impslam.cli.console import Common
from impslam.errors import ImpError

Shell: TypeAlias = Literal["bash", "zsh", "fish", "powershell"]


def install_completion(*, shell: Shell | None = None, common: Common | None = None) -> None:
    """Install completion of commands and options for your shell.

    Parameters
    ----------
    shell
        The shell to install it for. Default: the current one.
    """
    from cyclopts.completion.detect import ShellDetectionError

    from impslam.cli.app import make_app

    try:
        script = make_app().install_completion(shell=shell)
    except ShellDetectionError:
        raise ImpError("cannot detect the current shell; name it, e.g. --shell bash") from None
    if common is None or not common.quiet:
        console.echo(f"{script}: installed; open a new shell to use it")
