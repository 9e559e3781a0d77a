"""The axes and the key around the picture of a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from impslam.evaluation.colours import INK, PALE
from impslam.observers.canvas import Canvas, text_size
from impslam.observers.page import round_numbers
from impslam.types import Array

LEFT, RIGHT, BELOW = 90, 40, 75
"""Margins of the map, for the numbers of the axes, pixels."""
ROW, STROKE, SPACE = 44, 46, 40
"""Height of a row of the key, length of a stroke, and space between entries, pixels."""
FONT_SIZE = 0.75
"""Font size in OpenCV's units."""
CIRCLE = np.column_stack([f(np.linspace(0.0, 2.0 * np.pi, 48, False)) for f in (np.cos, np.sin)])
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Outlines (n, 2) of markers with unit radius or half side."""


class Key(NamedTuple):
    """An entry of the key: a stroke `width` pixels wide, a marker (n, 2), or a marker's outline."""

    text: str
    code: str
    width: float = 0.0
    outline: Array | None = None


class MapAxes:
    """The axes and the key of a canvas that shows the rectangle left, right, bottom, top, m.

    The canvas becomes part of a larger sheet: drawing on it also draws on the sheet.
    """

    def __init__(
        self, canvas: Canvas, bounds: tuple[float, float, float, float], keys: Sequence[Key]
    ) -> None:
        self._map, self._bounds = canvas, bounds
        left, right, bottom, top = bounds
        counts = [max(2.0, 7.0 * side / max(canvas.pixels.shape)) for side in self._size]
        self._x = [v for v in round_numbers(left, right, counts[0]) if left <= v <= right]
        self._y = [v for v in round_numbers(bottom, top, counts[1]) if bottom <= v <= top]
        columns, rows = self._size
        width = max(LEFT + columns + RIGHT, 620)
        self._keys = list(_wrapped(keys, width - 2 * RIGHT))
        self._height = BELOW + rows + ROW * len(self._keys) + RIGHT
        sheet = (0.0, width, 0.0, self._height)
        self._sheet = Canvas(sheet, max(width, self._height), "#ffffff")  # a pixel is 1 m wide
        above = self._height - BELOW - rows
        part = self._sheet.pixels[above : above + rows, LEFT : LEFT + columns]
        part[:] = canvas.pixels
        canvas.pixels = part

    @property
    def _size(self) -> tuple[int, int]:
        """Columns and rows of the map."""
        rows, columns, _ = self._map.pixels.shape
        return columns, rows

    def draw_lines(self) -> None:
        """Draw pale lines at round coordinates."""
        left, right, bottom, top = self._bounds
        before = self._map.pixels.copy()
        for x in self._x:
            self._map.line(np.array([[x, bottom], [x, top]]), INK, 1)
        for y in self._y:
            self._map.line(np.array([[left, y], [right, y]]), INK, 1)
        self._map.fade(before, 0.12)

    def finished(self) -> Canvas:
        """Return the sheet: the map with its axes, and the key above."""
        columns, rows = self._size
        sheet = self._sheet
        corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]])
        sheet.line(corners + np.array([LEFT, BELOW]), "#d4d9de", 2, closed=True)
        self._draw_numbers(sheet)
        for i, line in enumerate(self._keys):
            _draw_keys(sheet, line, self._height - ROW * (i + 0.7))
        return sheet

    def _draw_numbers(self, sheet: Canvas) -> None:
        """Write the coordinates below and to the left of the map."""
        columns = self._map.to_pixels(np.array([[x, 0.0] for x in self._x]))[:, 0] + LEFT
        for x, column in zip(self._x, columns, strict=True):
            wide, high = text_size(f"{x:g}", FONT_SIZE)
            sheet.line(np.array([[column, BELOW], [column, BELOW - 7.0]]), PALE, 1)
            at = np.array([column - 0.5 * wide, BELOW - 16.0 - high])
            sheet.label(at, f"{x:g}", INK, FONT_SIZE)
        rows = self._map.to_pixels(np.array([[0.0, y] for y in self._y]))[:, 1]
        for y, level in zip(self._y, BELOW + self._size[1] - rows, strict=True):
            wide, high = text_size(f"{y:g}", FONT_SIZE)
            sheet.line(np.array([[LEFT, level], [LEFT - 7.0, level]]), PALE, 1)
            at = np.array([LEFT - 16.0 - wide, level - 0.5 * high])
            sheet.label(at, f"{y:g}", INK, FONT_SIZE)
        middle = LEFT + 0.5 * self._size[0]
        sheet.label(np.array([middle - 40.0, 12.0]), "x, y in m", INK, FONT_SIZE)


def _length(key: Key) -> float:
    return STROKE + 12.0 + text_size(key.text, FONT_SIZE)[0]


def _wrapped(keys: Sequence[Key], width: float) -> Iterator[list[Key]]:
    """Yield the entries of each row of the key."""
    line: list[Key] = []
    for key in keys:
        if line and sum(map(_length, (*line, key))) + SPACE * len(line) > width:
            yield line
            line = []
        line.append(key)
    yield line


def _draw_keys(sheet: Canvas, keys: Sequence[Key], level: float) -> None:
    """Draw a row of the key, centred, at a height in pixels."""
    length = sum(map(_length, keys)) + SPACE * (len(keys) - 1)
    x = 0.5 * (sheet.pixels.shape[1] - length)
    for key in keys:
        middle = np.array([x + 0.5 * STROKE, level])
        if key.outline is None:
            ends = np.array([[-0.5 * STROKE, 0.0], [0.5 * STROKE, 0.0]])
            sheet.line(middle + ends, key.code, key.width)
        elif key.width:
            sheet.line(middle + key.outline, key.code, key.width, closed=True)
        else:
            sheet.fill(middle + key.outline, key.code)
        high = text_size(key.text, FONT_SIZE)[1]
        at = np.array([x + STROKE + 12.0, level - 0.5 * high])
        sheet.label(at, key.text, INK, FONT_SIZE)
        x += _length(key) + SPACE
