"""A log format in one file: JSON lines with a scan and both wheel angles a line.

    {"stamp": 12.3, "wheels": [0.0, 0.0], "ranges": [1.214, 1.213, null, 0.871]}

Wheel angles are in rad, ranges in m, null is a beam without return. The beams are equally spaced over
half a turn, from the right to the left.
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from impslam.component import register
from impslam.errors import MessageError
from impslam.sources.base import Stream
from impslam.sources.parts import LocatedMessage
from impslam.sources.text import TextSource, check_finite, head
from impslam.types import LaserScan, WheelAngles

START = b'{"stamp":'


@register("json_lines")
class JsonLines(TextSource):
    """JSON lines with stamp, wheels and ranges."""

    default_preset = "imp"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Tell by the beginning of the first line."""
        lines = head(path)
        return bool(lines) and lines[0].startswith(START)

    def _messages(self) -> Iterator[LocatedMessage]:
        """Yield the wheels' reading before the scan that was taken with it."""
        for number, line in self._lines(self.path):
            try:
                row = json.loads(line)
                stamp, (left, right) = float(row["stamp"]), map(float, row["wheels"])
                ranges = np.array([math.nan if r is None else r for r in row["ranges"]], np.float64)
                check_finite("stamp or wheel angle", stamp, left, right)
            except (ValueError, TypeError, KeyError, MessageError) as error:
                self._reject("row", self.path, number, error)
                continue
            angles = np.linspace(-math.pi / 2, math.pi / 2, len(ranges))
            yield LocatedMessage(WheelAngles(stamp, left, right), number, "wheels", checked=False)
            yield LocatedMessage(
                LaserScan(stamp, angles, ranges, np.zeros(len(ranges))), number, "scan"
            )

    def streams(self) -> list[Stream]:
        """Return wheels and scans, one of each a row."""
        rows = sum(self._first_words(self.path).values())
        return [
            Stream("wheels", "WheelAngles", rows, True, "left, right: rad", default=True),
            Stream("scan", "LaserScan", rows, True, "beams", default=True),
        ]
