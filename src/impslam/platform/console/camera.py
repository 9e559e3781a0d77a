"""The camera's picture on the page, asked for by the page itself while it is in sight."""

from __future__ import annotations

from nicegui.element import Element

PERIOD = 0.2  # s between pictures, the camera's own


class Camera(Element, component="camera.js"):
    """Loads `/camera.jpg` when a beat tells of a new picture, never two at once."""

    def __init__(self) -> None:
        super().__init__()
        self._props["period"] = PERIOD
