"""The button that switches between dark and light: it is up to the browser alone."""

from __future__ import annotations

from nicegui.element import Element


class ThemeButton(Element, component="theme_button.js"):
    """Switches from the theme of the system to dark, to light, and back; the browser keeps the choice."""
