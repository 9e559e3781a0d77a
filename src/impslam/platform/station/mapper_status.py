"""How live mapping is doing, for the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

State: TypeAlias = Literal["off", "compiling", "running", "failed"]


@dataclass(frozen=True, slots=True)
class MapperStatus:
    """How mapping is doing.

    Attributes
    ----------
    state : "off" (never started, or stopped), "compiling" (before the first scan; a minute at worst,
        on a fresh machine only), "running", or "failed"
    steps : scans mapped
    dropped_scans : scans that came too fast to be mapped
    waiting : scans that wait to be mapped
    behind : s since the newest mapped scan arrived, NaN before the first; one sweep when all is well
    latency : s from the newest mapped scan's arrival to its being mapped, NaN before the first
    detail : one line: why it failed, what was dropped, by how much odometry is off; "" where all is well
    refused : scans that could not be used: without beams
    name, frozen : the map that is gone on with, or only localised in; "" for a new one
    placed : whether it is known where in the map the robot is
    """

    state: State
    steps: int
    dropped_scans: int
    waiting: int
    behind: float
    latency: float
    detail: str
    refused: int = 0
    name: str = ""
    frozen: bool = False
    placed: bool = True


OFF = MapperStatus("off", 0, 0, 0, float("nan"), float("nan"), "")
