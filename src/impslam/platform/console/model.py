"""The model of the page: a live robot, or a log that is replayed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from impslam.observers.live_view import LiveView
from impslam.platform.station.player import Player
from impslam.platform.station.station import Station

Fault: TypeAlias = Callable[..., None]
"""Triggers a fault of a virtual robot: fault("unplug", device="lidar", seconds=2.0)."""


@dataclass(frozen=True, slots=True)
class Model:
    """The map, and either a station, which drives and records, or a player, which replays a log.

    Attributes
    ----------
    title : name of the robot or the log
    view : the present map
    station : the robot computer, None in a replay
    player : the player of a log, None on a robot
    fault : triggers a fault of a virtual robot, None on a real one
    """

    title: str
    view: LiveView
    station: Station | None = None
    player: Player | None = None
    fault: Fault | None = None
