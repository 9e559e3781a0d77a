"""What the page shows: a robot that lives, or a log that plays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from impslam.observers.live_view import LiveView
from impslam.platform.station.player import Player
from impslam.platform.station.station import Station

Fault: TypeAlias = Callable[..., None]
"""Lets something go wrong on a virtual robot: fault("unplug", device="lidar", seconds=2.0)."""


@dataclass(frozen=True, slots=True)
class Model:
    """A page has a map; a station with it drives and records, a player with it replays a log.

    Attributes
    ----------
    title : the robot's or the log's name
    view : the map as it is by now
    station : the robot computer, None in a replay
    player : the log that plays, None on a robot
    fault : what a virtual robot offers to go wrong, None on a real one
    """

    title: str
    view: LiveView
    station: Station | None = None
    player: Player | None = None
    fault: Fault | None = None
