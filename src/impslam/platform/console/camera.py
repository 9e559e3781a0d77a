"""The camera picture of the page, requested by the browser while it is visible."""

from __future__ import annotations

from nicegui.element import Element

PERIOD = 0.2  # s between pictures, as of the camera


class CameraView(Element, component="camera.js"):
    """Loads `/camera.jpg` when a beat announces a new picture, one at a time."""

    def __init__(self) -> None:
        super().__init__()
        self._props["period"] = PERIOD
