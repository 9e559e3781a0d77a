"""A log format in one file: CSV with a scan and both wheel angles a row.

    stamp,left,right,-90,-89,...,90
    12.30,0.00,0.00,1.214,1.213,...,0.871

The header gives each beam's direction in degrees, counter-clockwise; wheel angles are in rad, ranges
in m, an empty cell is a beam without return.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from impslam.component import register
from impslam.errors import MessageError
from impslam.sources.base import Stream
from impslam.sources.parts import Located
from impslam.sources.text import TextSource, finite, head
from impslam.types import LaserScan, WheelAngles

START = [b"stamp", b"left", b"right"]


@register("csv")
class CsvLog(TextSource):
    """CSV with the columns stamp, left, right and one for each beam."""

    default_preset = "imp"

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Tell by the header."""
        lines = head(path)
        return bool(lines) and lines[0].strip().split(b",")[:3] == START

    def _messages(self) -> Iterator[Located]:
        """Yield the wheels' reading before the scan that was taken with it."""
        angles = np.empty(0)
        for number, line in self._lines(self.path):
            cells = line.strip().split(b",")
            try:
                if number == 1:
                    angles = np.radians([float(cell) for cell in cells[3:]])
                    continue
                values = np.array([float(cell or "nan") for cell in cells])
                stamp, left, right = map(float, values[:3])
                finite("stamp or wheel angle", stamp, left, right)
            except (ValueError, MessageError) as error:
                self._reject("row", self.path, number, error)
                continue
            if len(values) != 3 + len(angles):
                self._reject("row", self.path, number, "not as many cells as the header")
                continue
            yield Located(WheelAngles(stamp, left, right), number, "wheels", checked=False)
            scan = LaserScan(stamp, angles, values[3:], np.zeros(len(angles)))
            yield Located(scan, number, "scan")

    def streams(self) -> list[Stream]:
        """Return wheels and scans, one of each a row."""
        rows = sum(self._first_words(self.path).values()) - 1
        return [
            Stream("wheels", "WheelAngles", rows, True, "left, right: rad", default=True),
            Stream("scan", "LaserScan", rows, True, "beams", default=True),
        ]
