"""The tabs of the panels: which panel is visible is up to the browser alone."""

from __future__ import annotations

from collections.abc import Mapping

from nicegui.element import Element


class Tabs(Element, component="tabs.js"):
    """Sets the name of the chosen tab on the page's body; the style shows its panel.

    Parameters
    ----------
    tabs : icon and title of each tab by name
    """

    def __init__(self, tabs: Mapping[str, tuple[str, str]]) -> None:
        super().__init__()
        self._props["tabs"] = [[name, *shown] for name, shown in tabs.items()]
