"""Detect a robot that was carried while its scans are matched.

A match may be found although the robot was carried, e.g. turned around in a corridor. Static objects that
vanish or appear between scans at matched poses prove it (see `jump`), if they cannot be a door, or a
person who stood still before.
"""

from __future__ import annotations

import math

from impslam.geometry.kernels import kernel
from impslam.health import CARRIED, CHANGED
from impslam.tracking.beams import BeamColumns
from impslam.tracking.jump import doubted_share, find_change, forget
from impslam.tracking.matching_state import State
from impslam.tracking.reference_scan import ranges_at_once
from impslam.tracking.steps import Steps

MIN_SHARE, MIN_EXTENT = 0.05, 1.5
"""Share of the beams, and m of extent of their points, that together prove a change: more than a door that
opens at once, or a person. In recorded buildings, changes that a second scan confirms are up to 0.047 of a
scan."""


@kernel
def notice_carried(beams: BeamColumns, k: int, state: State, duration: float, out: Steps) -> bool:
    """Return whether the robot was carried before sweep k; new maps then begin, and `out` records it.

    The sweep that shows it may not be matched; then the next matched sweep records it.
    """
    past, proven = state.lidar.past, state.proven
    state.time[0] += duration
    if past.place[0] != state.places[0]:  # this lidar has not seen the new place yet
        forget(past)
        past.place[0] = state.places[0]
    ranges = ranges_at_once(beams.ranges[k], beams.directions[k], beams.geometry)
    share, extent, confirmed = find_change(ranges, state.pose, state.time[0], past, beams.geometry)
    certain = share > MIN_SHARE and extent > MIN_EXTENT
    suspected = max(share if certain else 0.0, doubted_share(past, beams.geometry))
    if suspected > 0.0 and out.reasons[k] < CHANGED:
        out.reasons[k], out.amounts[k] = CHANGED, suspected
    if certain and confirmed:
        proven[0] = max(proven[0], share)
    if proven[0] == 0.0 or not out.reference[k] or out.reasons[k] > CHANGED:
        return False
    out.reasons[k], out.amounts[k] = CARRIED, proven[0]
    begin_place(state)
    return True


@kernel
def begin_place(state: State) -> None:
    """Begin new maps: the robot is at another place."""
    state.submaps.travelled[:], state.lidar.added[:] = math.nan, math.nan
    state.lidar.stall.flags[:] = False
    state.places[0] += 1
    state.proven[0] = 0.0
    state.reach[:] = 0.0
