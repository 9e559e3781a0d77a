"""The server of the page: loopback alone, or TLS with a password; everything behind the guard."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from impslam.console.model import Model


@dataclass(frozen=True, slots=True)
class ServerSettings:
    """Where the page is served, and by which papers.

    Attributes
    ----------
    host : address to listen on; beyond loopback a drive password must be set, and TLS is always on
    port : TCP port
    certificate, key : PEM files; without them a certificate is made, and kept beside the accounts
    accounts : file of the passwords; None is `~/.config/impslam/accounts.json`
    names : further names that the robot is reached by, as in `robot.example.org`
    """

    host: str = "127.0.0.1"
    port: int = 8080
    certificate: Path | None = None
    key: Path | None = None
    accounts: Path | None = None
    names: tuple[str, ...] = ()


def serve(
    model: Model, settings: ServerSettings, *, ready: Callable[[str], None] = lambda line: None
) -> None:
    """Serve the page until SIGINT or SIGTERM; open sockets are cut within 2 s.

    Parameters
    ----------
    model : what the page shows
    settings : where, and by which papers
    ready : called once with each line that a user should see when the page can be opened: its
        address, the one-time link where no password is set, the certificate's fingerprint

    Raises
    ------
    ImpError
        Where it may not or cannot listen: one line that says what to do.
    """
    raise NotImplementedError
