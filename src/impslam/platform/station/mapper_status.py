"""The status of live mapping, for the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

State: TypeAlias = Literal["off", "compiling", "running", "failed"]


@dataclass(frozen=True, slots=True)
class MapperStatus:
    """The status of live mapping.

    Attributes
    ----------
    state : "off" (never started, or stopped), "compiling" (before the first scan; a minute at worst,
        on a fresh machine only), "running", or "failed"
    steps : scans mapped
    dropped_scans : scans that came too fast to be mapped
    waiting : scans that wait to be mapped
    behind : s since the newest mapped scan arrived, NaN before the first; normally one sweep
    latency : s from the newest mapped scan's arrival to the end of its mapping, NaN before the first
    detail : one line: why it failed, what was dropped, by how much odometry is off; "" if all is well
    refused : unusable scans: without beams
    name, frozen : the continued map, and whether it is only localised in; "" for a new one
    placed : whether the robot is located in the map
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

    @property
    def on(self) -> bool:
        """Whether a map is being made, or will be after compiling."""
        return self.state in {"running", "compiling"}


def scans_text(number: int) -> str:
    """Return a number of scans with its unit."""
    return "1 scan" if number == 1 else f"{number} scans"


OFF = MapperStatus("off", 0, 0, 0, float("nan"), float("nan"), "")
