"""Health of devices, recorder, mapper and page, and recent events."""

from __future__ import annotations

import html
import re
import time
from collections.abc import Iterable

import numpy as np
from nicegui import ui

from impslam.platform.console.feed import Feed
from impslam.platform.console.widgets import card, milliseconds, size, tagged
from impslam.platform.devices.base import DeviceHealth, now
from impslam.platform.station.mapper_status import MapperStatus, scans_text
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import StationHealth
from impslam.types import Climate, Event

MAX_EVENTS = 40  # events
CLIMATE_TIMEOUT = 10.0  # s: ten readings
STYLES = {
    "ok": ("check_circle", "ok"),
    "silent": ("hourglass_empty", "warning"),
    "opening": ("sync", "warning"),
    "lost": ("error", "error"),
    "stopped": ("stop_circle", "idle"),
    "recording": ("fiber_manual_record", "ok"),
    "running": ("check_circle", "ok"),
    "compiling": ("sync", "warning"),
    "failed": ("error", "error"),
    "off": ("radio_button_unchecked", "idle"),
}
"""State -> icon and colour."""
LEVELS = {"info": "info", "warning": "warning", "error": "error"}
HIDDEN_TYPES = {"DeviceTime", "Event"}
"""Messages about messages: their content is shown elsewhere."""
USUAL_COUNTERS = frozenset(
    {
        *("frames", "commands", "other sentences"),
        # While a connection begins, and until then:
        *("fragment", "before HELLO", "before the clock", "commands not sent"),
    }
)
"""Counters of what happens without a problem. All others are shown, except messages, which have a rate."""


class HealthPanel:
    """A row for each device, the recorder, the mapper, the page and the climate."""

    def __init__(self, feed: Feed, health: StationHealth) -> None:
        self._feed = feed
        self._rows: dict[str, ui.html] = {}
        with card("Health", "monitor_heart", "health"):
            for name in (*health.devices, "recorder", "mapper", "page", "climate"):
                self._rows[name] = ui.html("", sanitize=False)
                tagged(self._rows[name], f"health-{name}").classes("health")
        self.update(health)

    def update(self, health: StationHealth) -> None:
        """Show the present status; unchanged rows send nothing."""
        for name, device in health.devices.items():
            self._rows[name].content = device_row(name, device)
        self._rows["recorder"].content = recorder_row(health.recording)
        self._rows["mapper"].content = mapper_row(health.mapping)
        self._rows["page"].content = page_row(self._feed.latencies())
        if health.climate is not None:
            self._rows["climate"].content = climate_row(health.climate, now())


class EventPanel:
    """The latest events, newest first."""

    def __init__(self) -> None:
        self._newest: tuple[int, float] = (0, 0.0)
        with card("Events", "list_alt", "events"):
            self._list = ui.html('<p class="soft">No events yet.</p>', sanitize=False)
            tagged(self._list, "events").classes("events")
            self._list.props["role"] = "log"

    def update(self, events: list[Event]) -> None:
        """Show the events, if there are new ones."""
        newest = (len(events), events[-1].stamp if events else 0.0)
        if newest != self._newest:
            self._newest = newest
            self._list.content = "".join(event_row(one) for one in reversed(events[-MAX_EVENTS:]))


def device_row(name: str, health: DeviceHealth) -> str:
    """Return a device's state, rates, problems and detail as HTML."""
    rates = (
        f"{_words(kind)} {rate:.{_digits(rate)}f} Hz"
        for kind, rate in health.rates.items()
        if kind not in HIDDEN_TYPES
    )
    troubles = (
        f"{kind} {count}"
        for kind, count in health.counts.items()
        if count and kind not in USUAL_COUNTERS and kind not in health.rates
    )
    return _row(name, health.state, rates, troubles, health.detail)


def recorder_row(status: RecordingStatus) -> str:
    """Return the recorder's state as HTML."""
    dropped = (f"{n} {_words(kind)} dropped" for kind, n in status.dropped.items() if n)
    facts = [f"{size(status.free)} free"]
    if status.active:
        facts.insert(0, f"{size(status.size)} written")
    state = "recording" if status.active else "failed" if status.error else "off"
    return _row("recorder", state, facts, dropped, status.error)


def mapper_row(status: MapperStatus) -> str:
    """Return the mapper's state as HTML."""
    facts = [scans_text(status.steps), f"scan to map {milliseconds(status.latency)}"]
    dropped = [f"{scans_text(status.dropped_scans)} dropped"] if status.dropped_scans else []
    behind = status.behind > 1.0 and status.state == "running"
    if behind:
        dropped.append(f"newest scan is {status.behind:.1f} s old")
    return _row("mapper", status.state, facts if status.steps else [], dropped, status.detail)


def climate_row(climate: Climate, moment: float) -> str:
    """Return temperature and humidity at the autopilot as HTML; silent if they are old."""
    facts = [f"{climate.temperature:.1f} °C", f"{100.0 * climate.humidity:.0f} % humidity"]
    return _row(
        "climate", "ok" if moment - climate.stamp < CLIMATE_TIMEOUT else "silent", facts, []
    )


def page_row(latencies: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    """Return the latency of drawing as HTML, with the figures as data attributes."""
    if not len(latencies):
        return _row("page", "ok", ["scan to page: not known yet"], [], "")
    median, p99 = np.percentile(latencies, (50, 99))
    row = _row("page", "ok", [f"scan to page {milliseconds(median)}, p99 {milliseconds(p99)}"], [])
    data = f'data-median="{median:.4f}" data-p99="{p99:.4f}" data-count="{len(latencies)}"'
    return f'<div data-testid="latency" {data}>{row}</div>'


def event_row(event: Event) -> str:
    """Return an event as HTML, with its time of day by the robot's clock."""
    style = LEVELS.get(event.level, "info")
    moment = time.strftime("%H:%M:%S", time.localtime(event.stamp))
    content = f"<b>{html.escape(event.source)}</b> {html.escape(event.text)}"
    return (
        f'<div class="event {style}"><time>{moment}</time>{_icon(style)}<span>'
        f'<span class="sr">{style}: </span>{content}</span></div>'
    )


def _row(
    name: str, state: str, facts: Iterable[str], troubles: Iterable[str], detail: str = ""
) -> str:
    icon, style = STYLES.get(state, ("help", "warning"))
    facts = [f"<span>{html.escape(fact)}</span>" for fact in facts]
    facts += [f'<span class="trouble">{html.escape(one)}</span>' for one in troubles]
    more = f'<div class="facts">{"".join(facts)}</div>' if facts else ""
    if detail:
        more += f'<div class="detail">{html.escape(detail)}</div>'
    return (
        f'<div class="state {style}" data-state="{html.escape(state)}">{_icon(icon)}'
        f"<b>{html.escape(name)}</b><em>{html.escape(state)}</em></div>{more}"
    )


def _icon(name: str) -> str:
    return f'<i class="q-icon material-icons notranslate" aria-hidden="true">{name}</i>'


def _words(kind: str) -> str:
    """Return a message type as words: "WheelAngles" is "wheel angles"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", kind).lower()


def _digits(rate: float) -> int:
    return 0 if rate >= 9.95 else 1
