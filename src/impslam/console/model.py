"""What the page shows: a robot that lives, or a log that plays."""

from __future__ import annotations

from dataclasses import dataclass

from impslam.observers.live_view import LiveView
from impslam.platform.player import Player
from impslam.platform.station import Station


@dataclass(frozen=True, slots=True)
class Model:
    """A page has a map; a station with it drives and records, a player with it replays a log.

    Attributes
    ----------
    title : the robot's or the log's name
    view : the map as it is by now
    station : the robot computer, None in a replay
    player : the log that plays, None on a robot
    """

    title: str
    view: LiveView
    station: Station | None = None
    player: Player | None = None
