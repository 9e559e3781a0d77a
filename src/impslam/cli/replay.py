"""`imp run LOG --live`: a log played on the page that a robot serves."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import TYPE_CHECKING

from impslam.cli import console
from impslam.errors import ConfigError, QuitError
from impslam.extras import install

if TYPE_CHECKING:
    from impslam.config import Config
    from impslam.health import Standing
    from impslam.map import Map
    from impslam.observers.base import Observer
    from impslam.sources.base import Source

WEB = ("nicegui", "cryptography")


def need_web() -> None:
    """Raise `ConfigError` where what serves the page is not installed."""
    missing = [name for name in WEB if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"the page needs {missing[0]}; install it with `{install('robot', 'web')}`"
        )


def replay(
    config: Config,
    source: Source,
    observers: Iterable[Observer],
    health: Standing,
    *,
    port: int,
    quiet: bool,
) -> Map:
    """Play a log on the page until it is left with Ctrl-C; return the map.

    `health` is what is wrong with the log throughout.

    Raises
    ------
    QuitError
        If it was left before the log's end.
    """
    need_web()
    from impslam.observers.live_view import LiveView
    from impslam.platform.console.model import Model  # needs the extra
    from impslam.platform.console.server import ServerSettings, listening, serve
    from impslam.platform.station.player import play_live

    view, settings = LiveView(), ServerSettings(port=port)
    with listening(settings) as listener:
        player = play_live(config, source, observers, view, health)
        try:
            serve(
                Model(source.path.name, view, player=player),
                settings,
                ready=lambda line: None if quiet else console.say(line),
                listener=listener,
            )
        finally:
            player.stop()
    known = player.wait(0.0)
    if known is None:
        raise QuitError("the replay was stopped before the end of the log; nothing is written")
    return known
