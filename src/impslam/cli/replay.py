"""`imp run LOG --live`: replay a log on the robot's web page."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import TYPE_CHECKING

from impslam.cli import console
from impslam.cli.interruption import stopped_at_once
from impslam.errors import ConfigError, QuitError
from impslam.extras import install

if TYPE_CHECKING:
    from impslam.config import Config
    from impslam.health import LogFault
    from impslam.map import Map
    from impslam.observers.base import Observer
    from impslam.sources.base import Source

WEB = ("nicegui", "cryptography")


def need_web() -> None:
    """Raise `ConfigError` if the packages that serve the page are not installed."""
    missing = [name for name in WEB if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"the page needs {missing[0]}; install it with `{install('robot', 'web')}`"
        )


def replay(
    config: Config,
    source: Source,
    observers: Iterable[Observer],
    fault: LogFault,
    *,
    port: int,
    quiet: bool,
) -> Map:
    """Replay a log on the page until Ctrl-C; return the map.

    `fault` is one of the whole log, which affects all poses.

    Raises
    ------
    QuitError
        If the replay was stopped before the end of the log.
    """
    need_web()
    with stopped_at_once():  # until the page is served, which handles the signals
        from impslam.observers.live_view import LiveView
        from impslam.platform.console.model import Model  # needs the extra
        from impslam.platform.console.server import ServerSettings, listening, serve
        from impslam.platform.station.player import play_live

        view, settings = LiveView(), ServerSettings(port=port)
        with listening(settings) as listener:
            player = play_live(config, source, observers, view, fault)
            try:
                serve(
                    Model(source.path.name, view, player=player),
                    settings,
                    ready=lambda line: None if quiet else console.echo(line),
                    listener=listener,
                )
            finally:
                player.stop()
    known = player.wait(0.0)
    if known is None:
        raise QuitError("the replay was stopped before the end of the log; nothing was written")
    return known
