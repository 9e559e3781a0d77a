"""The model of the page: a live robot, or a log that is replayed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from impslam.observers.live_view import LiveView
from impslam.platform.station.player import Player
from impslam.platform.station.station import Station

if TYPE_CHECKING:
    from impslam.platform.virtual.process import VirtualRobot  # a replay loads faster without it


@dataclass(frozen=True, slots=True)
class Model:
    """The map, and either a station, which drives and records, or a player, which replays a log.

    Attributes
    ----------
    title : name of the robot or the log
    view : the present map
    station : the robot computer, None in a replay
    player : the player of a log, None on a robot
    virtual : the virtual robot, None on a real one
    """

    title: str
    view: LiveView
    station: Station | None = None
    player: Player | None = None
    virtual: VirtualRobot | None = None
