"""The widgets of the panels; those that tests use have a `data-testid`."""

from __future__ import annotations

import math
from typing import Any, Literal

from nicegui import html, ui
from nicegui.element import Element
from nicegui.events import Handler

Style = Literal["plain", "primary", "danger", "quiet"]


def tagged(element: Element, testid: str) -> Element:
    """Set the test id of an element, and return it."""
    element.props["data-testid"] = testid
    return element


def card(title: str, icon: str, name: str) -> Element:
    """Return a titled panel to fill; `name` sets its test id and class."""
    panel: Element = html.section().classes(f"card card-{name}")
    panel.props["aria-label"] = title
    with tagged(panel, f"panel-{name}"), html.h2():
        symbol(icon)
        html.span(title)
    return panel


def line(classes: str = "") -> Element:
    """Return a row to fill."""
    return ui.element("div").classes(f"line {classes}")


def symbol(name: str) -> Element:
    """Return an icon of the bundled Material font."""
    icon: Element = html.i(name).classes("q-icon material-icons notranslate")
    icon.props["aria-hidden"] = "true"
    return icon


def text(testid: str, value: str = "", classes: str = "") -> ui.label:
    """Return a label; setting the text that it already has sends nothing."""
    label = ui.label(value).classes(classes)
    tagged(label, testid)
    return label


def button(
    label: str, testid: str, act: Handler[Any], style: Style = "plain", icon: str = ""
) -> Element:
    """Return a button; `act` may be a coroutine function."""
    made: Element = html.button().classes(f"button {style}").on("click", act, [])
    made.props["type"] = "button"
    with tagged(made, testid):
        if icon:
            symbol(icon)
        if style == "quiet":  # only the icon is visible
            made.props["aria-label"] = made.props["title"] = label
        else:
            html.span(label)
    return made


def show(element: Element, visible: bool) -> None:
    """Show or hide an element; a hidden one handles no events, and no change sends nothing."""
    element.visible = visible


def size(number: float) -> str:
    """Return a number of bytes with its unit."""
    for unit in ("B", "kB", "MB"):
        if number < 1000:
            return f"{number:.0f} {unit}" if unit == "B" else f"{number:.1f} {unit}"
        number /= 1000
    return f"{number:.1f} GB"


def duration(seconds: float) -> str:
    """Return a time in s as h:mm:ss, or m:ss below an hour; "" if it is unknown."""
    if not math.isfinite(seconds):
        return ""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def milliseconds(seconds: float) -> str:
    """Return a time in s as ms, "–" if it is unknown."""
    return f"{1000 * seconds:.0f} ms" if math.isfinite(seconds) else "–"
