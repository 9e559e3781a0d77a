"""The page as a whole: offline, quiet, readable on a phone, and what its panels do."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace
from urllib.parse import urlsplit

import pytest
from nicegui import Client, ui
from playwright.sync_api import expect
from tests.platform.console import browsing
from tests.platform.console.browsing import until, visit

from impslam.platform.console.fault_panel import FAULTS
from impslam.platform.console.health_panel import (
    climate_row,
    device_row,
    event_row,
    mapper_row,
    page_row,
)
from impslam.platform.console.log_panel import LogPanel
from impslam.platform.console.mapping_panel import status_text
from impslam.platform.console.page import STYLE
from impslam.platform.console.replay_panel import controls
from impslam.platform.console.robot_panels import alarms
from impslam.platform.console.widgets import duration, size
from impslam.platform.devices.base import DeviceHealth
from impslam.platform.station.log_store import StoredLog
from impslam.platform.station.mapper_status import OFF
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import StationHealth
from impslam.platform.virtual.faults import parse_fault
from impslam.types import Climate, Event

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
ACROSS = {**PHONE, "viewport": {"width": 844, "height": 390}}
CUT_OFF = """() => [...document.querySelectorAll('.side, .panel, .tabs, .card')]
  .filter((e) => e.scrollWidth > e.clientWidth).map((e) => e.className)"""
"""Script: the parts of the page that are wider than their place."""


def test_sizes_and_durations_are_readable():
    assert [size(n) for n in (0, 999, 48_213_554, 23.4e9)] == ["0 B", "999 B", "48.2 MB", "23.4 GB"]
    assert [duration(s) for s in (0, 61.9, 7812, float("nan"))] == ["0:00", "1:01", "2:10:12", ""]


def test_texts_of_devices_are_escaped():
    evil = "<img src=x onerror=alert(1)>"
    health = DeviceHealth("lost", evil, {evil: 1.0}, {"lost" + evil: 1}, 0.0)
    for made in (device_row(evil, health), event_row(Event(0.0, evil, evil, evil))):
        assert "<img" not in made
        assert "&lt;img" in made


def luminance(colour):
    """Return the relative luminance of "#rrggbb" (WCAG 2.2)."""
    shares = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("theme", [":root", "body.body--dark"])
def test_texts_have_the_contrast_of_wcag_aa(theme):
    rule = re.search(re.escape(theme) + r" \{(.*?)\}", STYLE.read_text(), re.DOTALL)
    colours = dict(re.findall(r"--(\w+): (#\w{6})", rule[1]))
    for text in ("ink", "soft", "accent", "good", "warn", "bad", "point", "wall"):
        for ground in ("page", "card", "map"):
            light, dark = sorted((luminance(colours[text]), luminance(colours[ground])))[::-1]
            assert (light + 0.05) / (dark + 0.05) >= 4.5, (text, ground)


def test_the_climate_is_shown_and_its_age_checked():
    row = climate_row(Climate(100.0, 23.14, 0.448), 101.0)
    assert "23.1 °C" in row
    assert "45 % humidity" in row
    assert 'data-state="ok"' in row
    assert 'data-state="silent"' in climate_row(Climate(100.0, 23.14, 0.448), 120.0)


def test_a_state_has_text_icon_and_colour_and_only_problems_are_counted():
    row = device_row(
        "lidar", DeviceHealth("silent", "URG", {"LaserScan": 9.96}, {"LaserScan": 812}, 0.0)
    )
    assert 'data-state="silent"' in row
    assert "hourglass_empty" in row
    assert 'class="state warning"' in row
    assert "laser scan 10 Hz" in row
    assert "812" not in row
    counts = {"corrupt": 3, "lost": 0, "frames": 99}
    troubled = device_row("autopilot", DeviceHealth("ok", "", {}, counts, 0.0))
    assert "corrupt 3" in troubled
    assert "99" not in troubled
    assert "lost" not in troubled


@pytest.mark.parametrize(
    "problem",
    [
        "damaged scans",
        "missed scans",
        "malfunctions",
        "interruptions",
        "commands unanswered",
        "gaps",
    ],
)
def test_every_problem_that_a_device_counts_is_shown(problem):
    assert f">{problem} 7<" in device_row("lidar", DeviceHealth("ok", "", {}, {problem: 7}, 0.0))


@pytest.mark.parametrize(("number", "words"), [(1, "1 scan dropped"), (2, "2 scans dropped")])
def test_dropped_scans_are_counted_in_words(number, words):
    row = mapper_row(replace(OFF, state="running", steps=number, dropped_scans=number))
    assert f">{words}<" in row
    assert f">{words.removesuffix(' dropped')}<" in row


def test_alarms_are_whatever_the_driver_must_know():
    def health(mapping, recording, **states):
        devices = {n: DeviceHealth(s, "unplugged", {}, {}, 0.0) for n, s in states.items()}
        return StationHealth(devices, recording, mapping)

    ended = RecordingStatus(error="the disk is full")
    failed = replace(OFF, state="failed", detail="a bug")
    well = health(OFF, RecordingStatus(), lidar="ok", wheels="silent")
    assert alarms(well, "", {"wheels"}) == []
    assert alarms(health(failed, ended, lidar="lost", wheels="lost"), "blocked", {"wheels"}) == [
        "wheels lost: unplugged",
        "lidar lost: unplugged",
        "Blocked",
        "Mapping has failed: a bug",
        "Not recording: the disk is full",
    ]
    assert alarms(health(OFF, replace(ended, active=True)), "", ()) == []
    no_robot = alarms(health(OFF, RecordingStatus(), lidar="lost"), "", (), "the robot has ended")
    assert no_robot == ["The robot has ended"]


def test_the_map_panel_tells_what_is_wrong_only_while_mapping():
    mapping = replace(OFF, state="running", steps=2, detail="10 scans dropped")
    assert status_text(mapping) == "Mapping: 10 scans dropped"
    assert status_text(replace(mapping, state="off")) == "Not mapping · 2 scans"


def test_the_map_panel_names_the_map_while_the_estimator_is_compiled():
    compiling = replace(OFF, state="compiling", name="hall", frozen=True, placed=False)
    assert status_text(compiling).startswith("Localising in hall · Compiling")
    assert status_text(replace(compiling, name="")).startswith("Compiling")


def test_a_replay_that_will_begin_by_itself_offers_neither_play_nor_step():
    assert set(controls("ready")) == set(controls("paused")) == {"play", "step", "speed"}
    assert set(controls("playing")) == {"pause", "speed"}
    assert set(controls("compiling")) == {"speed"}
    assert not controls("ended")


def test_latency_is_shown_with_median_and_p99():
    row = page_row([0.01] * 99 + [1.0])
    assert 'data-median="0.0100"' in row
    assert 'data-count="100"' in row
    assert "not known" in page_row([])


@pytest.mark.browser
@pytest.mark.parametrize("context", [{}, PHONE, ACROSS], ids=["desktop", "phone", "across"])
def test_the_page_is_offline_quiet_and_fits(browser, robot, context):
    with visit(browser, robot, **context) as watched:
        page = watched.page
        for tab in ("drive", "record", "health", "camera"):
            if page.get_by_test_id(f"tab-{tab}").is_visible():
                page.get_by_test_id(f"tab-{tab}").click()
            page.wait_for_timeout(500)
            wide, high = page.evaluate(
                "[document.documentElement.scrollWidth, document.documentElement.scrollHeight]"
            )
            assert wide <= page.viewport_size["width"]
            assert high <= page.viewport_size["height"]
            assert page.evaluate(CUT_OFF) == []
            box = page.get_by_test_id("stop").bounding_box()
            assert box["width"] >= 100
            assert box["height"] >= 44
            assert box["x"] + box["width"] <= page.viewport_size["width"]
        expect(page).to_have_title("IMP")
        assert not watched.complaints
        here = urlsplit(robot.address).netloc
        hosts = {urlsplit(url).netloc for url in watched.requests if not url.startswith("data:")}
        assert hosts == {here}


@pytest.mark.browser
def test_on_narrow_phones_neither_stop_nor_the_drive_panel_is_cut_while_recording(browser, robot):
    with visit(browser, robot, **PHONE) as watched:
        page = watched.page
        page.get_by_test_id("tab-record").click()
        page.get_by_test_id("record").click()
        expect(page.get_by_test_id("chip-recording")).to_be_visible()
        page.get_by_test_id("tab-drive").click()
        page.get_by_test_id("take").click()
        for width in (320, 344, 360, 390):
            page.set_viewport_size({"width": width, "height": 640})
            for control in ("stop", "leave", "command"):
                expect(page.get_by_test_id(control)).to_be_in_viewport(ratio=1)
            assert page.evaluate(CUT_OFF) == []
        page.get_by_test_id("tab-record").click()
        page.get_by_test_id("record-stop").click()


@pytest.mark.browser
def test_a_phone_held_across_shows_each_panel_and_the_layers_beside_the_tools(browser, robot):
    with visit(browser, robot, **ACROSS) as watched:
        page = watched.page
        for tab, control in {"drive": "pad", "record": "record", "maps": "map-bin-summary"}.items():
            page.get_by_test_id(f"tab-{tab}").click()
            expect(page.get_by_test_id(control)).to_be_in_viewport(ratio=1)
        page.get_by_test_id("layers").click()
        legend = page.get_by_test_id("legend").bounding_box()
        for tool in ("follow", "fit", "closer", "farther"):
            box = page.get_by_test_id(tool).bounding_box()
            assert box["x"] >= legend["x"] + legend["width"]


@pytest.mark.browser
def test_texts_of_the_page_are_words(browser, robot):
    with visit(browser, robot) as watched:
        texts = watched.page.evaluate(
            "[...document.querySelectorAll('h1, h2, h3, button, summary, label')]"
            ".map((e) => e.textContent)"
        )
    assert {"Health", "Camera", "Noise"} <= {
        re.sub("^[a-z_]+(?=[A-Z])", "", text) for text in texts
    }
    assert not [text for text in texts if re.search("[A-Z][a-z]+[A-Z]", text)]


@pytest.mark.browser
def test_every_control_has_a_name(browser, robot):
    with visit(browser, robot) as watched:
        nameless = watched.page.evaluate(
            """() => [...document.querySelectorAll('button, a, input, select, canvas')].filter((e) =>
            !(e.ariaLabel || e.labels?.length || e.innerText?.trim() || e.textContent.trim()))
            .map((e) => e.outerHTML)"""
        )
        assert nameless == []
        assert watched.page.evaluate("document.documentElement.lang") == "en-US"


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_the_page_follows_the_theme_of_the_system_until_it_is_switched(browser, robot, scheme):
    """The browser then keeps the theme for the next visit."""
    with visit(browser, robot, color_scheme=scheme) as watched:
        page = watched.page
        dark = "document.body.classList.contains('body--dark')"
        assert page.evaluate(dark) == (scheme == "dark")
        for wanted in (True, False):
            page.get_by_test_id("theme").click()
            until(lambda wanted=wanted: page.evaluate(dark) == wanted)
            page.reload()
            expect(page.get_by_test_id("theme")).to_be_visible()
            assert page.evaluate(dark) == wanted
        page.get_by_test_id("theme").click()
        until(lambda: page.evaluate(dark) == (scheme == "dark"))
        assert not watched.complaints


@pytest.mark.browser
@pytest.mark.parametrize("who", ["driver", "watcher"])
def test_logging_out_ends_the_session_and_leaves_the_drive_control(browser, robot, who):
    with visit(browser, robot, who) as watched:
        page = watched.page
        if who == "driver":
            page.get_by_test_id("take").click()
            until(lambda: robot.state()["driver"] == "driver 1")
        page.get_by_test_id("logout").click()
        expect(page.get_by_text("logged out")).to_be_visible()
        assert page.url == f"{robot.address}/logout"
        until(lambda: robot.state()["driver"] == "")


@pytest.mark.browser
def test_recording(browser, robot):
    with visit(browser, robot) as watched, visit(browser, robot, "watcher") as watcher:
        page = watched.page
        page.get_by_test_id("record-name").fill("hall")
        page.get_by_test_id("record").click()
        expect(page.get_by_test_id("recording")).to_have_text(re.compile(r"^0:\d\d · .* kB$"))
        expect(page.get_by_test_id("chip-recording")).to_contain_text("REC")
        expect(watcher.page.get_by_test_id("chip-recording")).to_be_visible()
        expect(watcher.page.get_by_test_id("record-stop")).to_be_hidden()
        page.get_by_test_id("record-stop").click()
        expect(page.get_by_test_id("chip-recording")).to_be_hidden()
        newest = page.get_by_test_id("stored-log").first
        expect(newest.locator(".name")).to_contain_text("-hall.mcap")
        link = newest.get_by_test_id("download")
        name = newest.get_attribute("data-name")
        assert link.get_attribute("href") == f"/logs/{name}"
        page.get_by_test_id("record-name").fill("full")
        page.get_by_test_id("record").click()
        expect(page.get_by_text("the disk is full")).to_be_visible()


def test_a_list_of_logs_is_only_rebuilt_if_it_shows_something_else():
    """Buttons that are replaced every second while a log grows would lose clicks and the focus."""
    viewer = SimpleNamespace(session=SimpleNamespace(may_drive=True))
    with Client(ui.page("/logs"), request=None) as client:
        panel = LogPanel(SimpleNamespace(logs=None), SimpleNamespace(store=None), viewer)
    old = StoredLog("old.mcap", 2_000_000, 60.0, False, False, 12.0)
    new = StoredLog("new.mcap", 1000, 120.0, True, False, math.nan)
    panel._show([new, old], [])
    before = set(client.elements)
    panel._show([replace(new, size=5000, modified=121.0), old], [])
    assert set(client.elements) == before
    panel._show([replace(new, size=5000, modified=121.0, recording=False, duration=1.0), old], [])
    assert set(client.elements) != before


@pytest.mark.browser
def test_a_log_is_deleted_restored_and_purged(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        name = "20261119-093012.mcap"
        row = page.locator(f"[data-testid=stored-log][data-name='{name}']")
        row.get_by_test_id("delete").click()
        page.get_by_test_id("cancel").click()
        expect(page.get_by_test_id("cancel")).to_be_hidden()
        assert name in robot.state()["logs"]
        row.get_by_test_id("delete").click()
        page.get_by_test_id("confirm").click()
        expect(row).to_have_count(0)
        page.get_by_test_id("log-bin-summary").click()
        binned = page.locator(f"[data-testid=binned][data-name='{name}']")
        binned.get_by_test_id("restore").click()
        expect(row).to_have_count(1)
        row.get_by_test_id("delete").click()
        page.get_by_test_id("confirm").click()
        expect(binned).to_be_visible()
        page.get_by_test_id("purge").click()
        page.get_by_test_id("confirm").click()
        expect(page.get_by_test_id("binned")).to_have_count(0)
        expect(page.get_by_test_id("log-bin-summary")).to_have_text("Recycle bin is empty")
        assert name not in robot.state()["logs"]
        assert not watched.complaints


@pytest.mark.browser
def test_maps_are_listed_deleted_and_restored(browser, robot):
    with visit(browser, robot) as watched, visit(browser, robot, "watcher") as watcher:
        page = watched.page
        page.get_by_test_id("tab-maps").click()
        rows = page.get_by_test_id("stored-map")
        expect(rows).to_have_count(3)
        making, hall, broken = rows.all()
        expect(making).to_contain_text("in progress")
        expect(making.get_by_test_id("delete")).to_have_count(0)
        expect(hall).to_contain_text("1.9 MB · 8512 scans · with report")
        expect(broken).to_contain_text("damaged")
        name = hall.get_attribute("data-name")
        link = hall.get_by_test_id("download")
        expect(link).to_have_attribute("href", f"/maps/{name}.zip")
        hall.get_by_test_id("delete").click()
        page.get_by_test_id("confirm").click()
        expect(rows).to_have_count(2)
        page.get_by_test_id("map-bin-summary").click()
        page.get_by_test_id("map-bin").get_by_test_id("restore").click()
        expect(rows).to_have_count(3)
        expect(page.get_by_test_id("map-bin-summary")).to_have_text("Recycle bin is empty")
        watcher.page.get_by_test_id("tab-maps").click()
        expect(watcher.page.get_by_test_id("stored-map")).to_have_count(3)
        expect(watcher.page.get_by_test_id("delete")).to_have_count(0)
        assert not watched.complaints


@pytest.mark.browser
def test_a_map_is_continued_and_a_click_gives_a_hint(browser, robot):
    with visit(browser, robot) as watched, visit(browser, robot, "watcher") as watcher:
        page = watched.page
        page.get_by_test_id("tab-maps").click()
        making, hall, broken = page.get_by_test_id("stored-map").all()
        expect(making.get_by_test_id("continue")).to_have_count(0)
        expect(broken.get_by_test_id("localise")).to_have_count(0)
        hall.get_by_test_id("localise").click()
        expect(page.get_by_text("The map does not change.")).to_contain_text(
            "after some 10 m of driving"
        )
        page.get_by_test_id("confirm").click()
        expect(page.get_by_test_id("sought")).to_contain_text(
            "Drive on for some 10 m, or click where it is."
        )
        expect(watcher.page.get_by_test_id("sought")).not_to_contain_text("click")
        expect(page.get_by_test_id("pose-x")).to_have_count(0)
        page.get_by_test_id("tab-record").click()
        status = page.get_by_test_id("mapping")
        expect(status).to_contain_text("Localising in map-20261120-141503, not found in it yet")
        expect(page.get_by_test_id("map-save")).to_be_hidden()
        canvas = page.get_by_test_id("map").locator("canvas")
        for looked in (watcher.page.get_by_test_id("map").locator("canvas"), canvas):
            assert robot.state()["hints"] == []
            box = looked.bounding_box()
            looked.click(position={"x": box["width"] / 2, "y": box["height"] / 2})
        expect(page.get_by_test_id("pose-x")).to_be_visible()
        ((x, y),) = robot.state()["hints"]
        assert -2.0 < x < 8.0  # the middle of the map, or near it
        assert -2.0 < y < 6.0
        expect(status).to_contain_text("Localising in map-20261120-141503 ·")
        assert not watched.complaints


@pytest.mark.browser
def test_the_map_tells_that_the_estimator_is_being_compiled(browser, robot):
    """Whatever tab is open, as that of the maps after a press on Localise."""
    with visit(browser, robot) as watched:
        page = watched.page
        page.get_by_test_id("tab-maps").click()
        robot.ask("compile?on=1")
        expect(page.get_by_test_id("notice")).to_have_text(
            "Compiling for this machine; once, up to a minute"
        )
        robot.ask("compile?on=0")
        expect(page.get_by_test_id("notice")).to_have_count(0)
        expect(page.get_by_test_id("pose-x")).to_be_visible()


@pytest.mark.browser
@pytest.mark.parametrize("context", [{}, PHONE], ids=["desktop", "phone"])
def test_a_page_that_is_loaded_again_shows_the_same_panel(browser, robot, context):
    with visit(browser, robot, **context) as watched:
        page = watched.page
        page.get_by_test_id("tab-health").click()
        page.reload()
        expect(page.get_by_test_id("panel-health")).to_be_visible()
        expect(page.get_by_test_id("tab-health")).to_have_attribute("aria-selected", "true")
        page.evaluate("sessionStorage.setItem('imp-tab', 'of an earlier version')")
        page.reload()
        expect(page.get_by_test_id("panel-health")).to_be_hidden()


@pytest.mark.browser
def test_mapping_is_restarted_and_saved(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        starts = robot.state()["starts"]
        page.get_by_test_id("map-new").click()
        page.get_by_test_id("confirm").click()
        until(lambda: robot.state()["starts"] == starts + 1)
        page.get_by_test_id("map-save").click()
        expect(page.get_by_test_id("map-saved")).to_contain_text("maps/map-20261121-101500")
        link = page.get_by_test_id("map-download")
        expect(link).to_have_attribute("href", "/maps/map-20261121-101500.zip")
        page.get_by_test_id("map-end").click()
        expect(page.get_by_test_id("mapping")).to_contain_text("Not mapping")
        expect(page.get_by_test_id("map-end")).to_be_hidden()
        expect(page.get_by_test_id("notice")).to_contain_text("Mapping has ended")
        expect(page.get_by_test_id("pose-state")).to_have_count(0)  # LOST would be an alarm
        expect(page.get_by_test_id("map-saved")).to_be_visible()
        page.get_by_test_id("map-start").click()
        expect(page.get_by_test_id("mapping")).to_contain_text("Mapping")
        expect(page.get_by_test_id("notice")).to_have_count(0)
        expect(page.get_by_test_id("map-saved")).to_be_hidden()  # it is that of the map before


def test_every_fault_on_the_page_exists_in_a_virtual_robot():
    asked = [parse_fault(f.model_dump()) for faults in FAULTS.values() for f in faults.values()]
    kinds = {"noise", "delay", "unplug", "reboot", "malfunction", "stall", "carry"}
    assert {fault.fault for fault in asked} == kinds


@pytest.mark.browser
def test_faults_of_a_virtual_robot(browser, robot):
    with visit(browser, robot) as watched, visit(browser, robot, "watcher") as other:
        page = watched.page
        page.get_by_test_id("tab-health").click()
        page.get_by_test_id("faults").click()
        page.get_by_test_id("fault-lidar-unplug").click()
        page.get_by_test_id("fault-motors-stall").click()
        until(lambda: len(robot.state()["faults"]) == 2)
        assert robot.state()["faults"] == [
            {"fault": "unplug", "seconds": 2.0, "device": "lidar"},
            {"fault": "stall", "side": "both", "seconds": 2.0},
        ]
        page.get_by_test_id("fault-lidar-malfunction").click()
        expect(page.get_by_text("only a URG tells statuses")).to_be_visible()
        other.page.get_by_test_id("tab-health").click()
        expect(other.page.get_by_test_id("health-lidar")).to_be_visible()
        expect(other.page.get_by_test_id("panel-faults")).to_have_count(0)


@pytest.mark.browser
def test_health_alarms_and_events(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        page.get_by_test_id("tab-health").click()
        expect(page.get_by_test_id("tab-health")).to_have_attribute("aria-selected", "true")
        row = page.get_by_test_id("health-autopilot")
        expect(row).to_contain_text("wheel angles 100 Hz")
        expect(row.locator("[data-state=ok]")).to_be_visible()
        expect(page.get_by_test_id("events")).to_contain_text("the robot is ready")
        robot.ask("lose?why=unplugged")
        expect(page.get_by_test_id("alarm")).to_have_text("warningautopilot lost: unplugged")
        expect(row.locator("[data-state=lost]")).to_be_visible()
        robot.ask("lose?why=")
        expect(page.get_by_test_id("alarm")).to_have_count(0)
        robot.ask("hinder?why=the%20robot%20is%20blocked")
        expect(page.get_by_test_id("alarm")).to_have_text("warningThe robot is blocked")
        robot.ask("hinder")
        expect(page.get_by_test_id("alarm")).to_have_count(0)
        latency = page.get_by_test_id("latency")
        expect(latency).to_contain_text("scan to page")
        assert 0 < float(latency.get_attribute("data-median")) < 2
        assert len(robot.state()["latencies"]) > 10


@pytest.mark.browser
def test_the_picture_is_loaded_only_while_it_is_visible(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page

        def asked():
            page.wait_for_timeout(100)  # what was asked is told while the browser is waited for
            return sum("camera.jpg" in url for url in watched.requests)

        page.wait_for_timeout(1000)
        assert asked() == 0
        page.get_by_test_id("tab-camera").click()
        until(lambda: asked() > 3)
        assert page.evaluate("document.querySelector('.camera img').naturalWidth") == 640
        page.get_by_test_id("tab-record").click()
        page.wait_for_timeout(300)
        before = asked()
        page.wait_for_timeout(1000)
        assert asked() == before


@pytest.mark.browser
def test_a_replay_is_controlled_and_shows_no_robot(browser):
    with browsing.robot("--replay") as replay, visit(browser, replay) as watched:
        page = watched.page
        expect(page.get_by_test_id("stop")).to_have_count(0)
        expect(page.get_by_test_id("record")).to_have_count(0)
        expect(page.get_by_test_id("replay")).to_contain_text("30 %")
        page.get_by_test_id("step").click()
        until(lambda: replay.state()["player"] == ["paused", 1.0, 121])
        page.get_by_test_id("replay-speed").select_option("5")
        until(lambda: replay.state()["player"][1] == 5)
        page.get_by_test_id("play").click()
        expect(page.get_by_test_id("pause")).to_be_visible()
        expect(page.get_by_test_id("replay")).to_contain_text("Playing at 5×")
        page.get_by_test_id("pause").click()
        until(lambda: replay.state()["player"][0] == "paused")
        expect(page.get_by_test_id("step")).to_be_visible()
        with visit(browser, replay, "watcher") as watcher:
            expect(watcher.page.get_by_test_id("play")).to_be_hidden()
        assert not watched.complaints
