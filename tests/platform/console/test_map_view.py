"""Frames of a map: exact enough, only changes, and never faster than a page draws them."""

import base64
import json
import math
import threading
import urllib.error
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from playwright.sync_api import expect
from tests.platform.console.browsing import until, visit

from impslam.observers.grid_picture import GridPicture
from impslam.observers.live_view import Snapshot
from impslam.platform.console import encoding
from impslam.platform.console.encoding import (
    STEP,
    SentState,
    common,
    difference,
    ellipse,
    mark,
    packed,
)
from impslam.platform.console.feed import Cached, Feed
from impslam.platform.console.model import Model
from impslam.platform.devices.base import now
from impslam.types import Landmark

EMPTY = Snapshot(
    0, 1, math.nan, 0, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((0, 2), np.float32),
    (), np.zeros((0, 2), np.float32), None, "TRACKING", "", math.nan, None, False,
)  # fmt: skip


def unpacked(sent, origin):
    xy = np.frombuffer(base64.b64decode(sent["xy"]), "<i2").reshape(-1, 2)
    return origin + sent["step"] * xy


def path_of(sent, before):
    tail = np.frombuffer(base64.b64decode(sent["xy"]), "<f4").reshape(-1, 2)
    return np.vstack((before[: sent["from"]], tail))


def post(number, x=1.0, seen=1):
    return Landmark(number, "cylinder", np.array([x, 2.0]), {}, np.eye(2) * 1e-4, None, seen, 0, 0)


def updates(snapshot, sent_state):
    return difference(snapshot, {one.id: mark(one) for one in snapshot.landmarks}, sent_state)


def grid(version):
    return GridPicture(b"png", version, np.array([-1.0, -2.0]), 0.05, (30, 20))


# --------------------------------------------------------------------------- numbers


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 1000.0))
def test_points_come_out_within_half_a_step(seed, reach):
    generator = np.random.default_rng(seed)
    origin = generator.uniform(-1e4, 1e4, 2)
    points = (origin + generator.uniform(-reach, reach, (50, 2))).astype(np.float32)
    sent = packed(points, origin)
    assert sent["step"] == pytest.approx(max(STEP, np.abs(points - origin).max() / 32767))
    assert np.abs(unpacked(sent, origin) - points).max() <= 0.5 * sent["step"] + 1e-9


def test_points_that_are_none_are_left_out():
    points = np.array([[1.0, 2.0], [np.nan, 1.0], [np.inf, 0.0]], np.float32)
    assert unpacked(packed(points, np.zeros(2)), np.zeros(2)) == pytest.approx(points[:1])
    assert packed(points[:0], np.zeros(2)) == {"step": STEP, "xy": ""}


def test_an_ellipse_has_the_axes_and_direction_of_the_covariance():
    a, b, direction = 0.3, 0.1, 0.5
    turn = np.array(
        [[math.cos(direction), -math.sin(direction)], [math.sin(direction), math.cos(direction)]]
    )
    found = ellipse(turn @ np.diag([a**2, b**2]) @ turn.T)
    assert found[:2] == pytest.approx([a, b])
    assert math.remainder(found[2] - direction, math.pi) == pytest.approx(0, abs=0.01)
    assert ellipse(np.full((2, 2), np.nan)) == [None, None, None]


def test_a_map_that_has_not_begun_is_json():
    frame = common(EMPTY) | updates(EMPTY, SentState())
    assert json.loads(json.dumps(frame, allow_nan=False))["t"] is None


# --------------------------------------------------------------------------- differences


def test_only_the_new_part_of_a_path_is_sent():
    sent_state, path = SentState(), np.cumsum(np.ones((100, 2), np.float32), 0)
    first = updates(replace(EMPTY, path=path[:50]), sent_state)
    assert first["path"]["from"] == 0
    second = updates(replace(EMPTY, path=path), sent_state)
    assert second["path"]["from"] == 49
    assert path_of(second["path"], path[:50]) == pytest.approx(path)
    thinned = updates(replace(EMPTY, path=path[::2]), sent_state)
    assert thinned["path"]["from"] == 0


def test_only_changed_and_removed_landmarks_are_sent():
    sent_state = SentState()
    assert (
        len(updates(replace(EMPTY, landmarks=(post(1), post(2))), sent_state)["marks"]["set"]) == 2
    )
    assert "marks" not in updates(replace(EMPTY, landmarks=(post(1), post(2))), sent_state)
    moved = updates(replace(EMPTY, landmarks=(post(1), post(2, 1.0001))), sent_state)
    assert "marks" not in moved, "a tenth of a millimetre is not to be seen"
    change = updates(replace(EMPTY, landmarks=(post(2, 1.5),)), sent_state)["marks"]
    assert [one[0] for one in change["set"]] == [2]
    assert change["gone"] == [1]


def test_a_grid_is_sent_once_per_version_and_again_for_a_new_map():
    sent_state = SentState()
    snapshot = replace(EMPTY, grid=grid(3), landmarks=(post(1),), path=np.ones((4, 2), np.float32))
    assert updates(snapshot, sent_state)["grid"]["v"] == 3
    assert "grid" not in updates(snapshot, sent_state)
    again = updates(replace(snapshot, run=2), sent_state)
    assert again["grid"]["v"] == 3
    assert len(again["marks"]["set"]) == 1
    assert again["path"]["from"] == 0


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3), st.integers(0, 40)), max_size=12))
def test_differences_add_up_to_the_map(changes):
    """The sum of all differences is the map, whatever happens to it."""
    sent_state, marks, path = SentState(), {}, np.zeros((0, 2), np.float32)
    for version, (count, shift, length) in enumerate(changes, 1):
        landmarks = tuple(post(number, number + 0.1 * shift) for number in range(count))
        walked = np.cumsum(np.full((length, 2), 0.1 + shift, np.float32), 0)
        sent = updates(
            replace(EMPTY, version=version, landmarks=landmarks, path=walked), sent_state
        )
        for one in sent.get("marks", {}).get("set", []):
            marks[one[0]] = one
        for number in sent.get("marks", {}).get("gone", []):
            del marks[number]
        path = path_of(sent["path"], path)
        assert marks == {one.id: mark(one) for one in landmarks}
        assert np.array_equal(path, walked)


# --------------------------------------------------------------------------- the feed


class View:
    def __init__(self, snapshot):
        self.now = snapshot

    def snapshot(self):
        return self.now


def test_shared_data_is_made_once(monkeypatch):
    made = []
    monkeypatch.setattr(
        "impslam.platform.console.feed.common", lambda one: made.append(1) or encoding.common(one)
    )
    view = View(replace(EMPTY, version=5, landmarks=(post(1),)))
    feed = Feed(Model("x", view))
    pages = [SentState(), SentState(), SentState()]
    assert all(feed.frame(sent_state)["seq"] == 5 for sent_state in pages)
    assert len(made) == 1
    assert feed.frame(pages[0]) is None
    view.now = replace(view.now, version=6)
    assert feed.frame(pages[0])["seq"] == 6
    assert feed.frame(pages[1])["seq"] == 6
    assert len(made) == 2


def test_latency_counts_from_the_scans_arrival_and_only_for_what_was_sent():
    view = View(replace(EMPTY, version=1, arrived=now() - 0.25))
    feed = Feed(Model("x", view, station=object()))
    feed.frame(SentState())
    feed.drawn(1)
    feed.drawn(2)
    feed.drawn(-1)
    assert feed.latencies() == pytest.approx([0.25], abs=0.1)


def test_latencies_and_pending_snapshots_are_bounded():
    view = View(EMPTY)
    feed = Feed(Model("x", view, station=object()))
    sent_state = SentState()
    for version in range(1, 1500):
        view.now = replace(EMPTY, version=version, arrived=now())
        feed.frame(sent_state)
        feed.drawn(version)
    assert len(feed.latencies()) == 1000
    assert len(feed._arrived) <= 64


def test_a_replays_scans_have_no_latency():
    feed = Feed(Model("x", View(replace(EMPTY, version=1, arrived=now()))))
    feed.frame(SentState())
    feed.drawn(1)
    assert len(feed.latencies()) == 0


def test_a_cached_value_is_made_once_a_period():
    made = []
    value = Cached(lambda: made.append(1) or len(made), 60.0)
    assert (value(), value()) == (1, 1)
    assert Cached(lambda: made.append(1) or len(made), 0.0)() == 2


def test_expiring_a_value_that_is_being_made_does_not_block():
    """If the disk hangs, threads may wait, but not the event loop."""
    entered, go_on, made = threading.Event(), threading.Event(), []

    def make():
        made.append(1)
        entered.set()
        assert go_on.wait(10.0)
        return len(made)

    value = Cached(make, 60.0)
    thread = threading.Thread(target=value)
    thread.start()
    assert entered.wait(5.0)
    expiring = threading.Thread(target=value.expire, daemon=True)
    expiring.start()
    expiring.join(2.0)
    waited = expiring.is_alive()
    go_on.set()
    thread.join(5.0)
    assert not waited
    assert value() == 2  # what was being made is older than the change


# --------------------------------------------------------------------------- on the page


def frames(watched):
    return [text for text in watched.frames if r"\"frame\"" in text]


def colours(page):
    """Return how many colours are on the canvas."""
    return page.evaluate(
        """() => { const c = document.querySelector('canvas');
        const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
        return new Set(new Uint32Array(d.buffer)).size; }"""
    )


@pytest.mark.browser
def test_the_map_element_has_the_shown_pose(browser, robot):
    with visit(browser, robot) as watched:
        shown = watched.page.get_by_test_id("map")
        expect(shown).to_have_attribute("data-landmarks", "7")
        x, y, heading = robot.state()["pose"]
        data = shown.evaluate("e => ({...e.dataset})")
        assert float(data["x"]) == pytest.approx(x, abs=1e-3)
        assert float(data["y"]) == pytest.approx(y, abs=1e-3)
        assert float(data["heading"]) == pytest.approx(heading, abs=1e-3)
        assert int(data["scans"]) > 400
        expect(watched.page.get_by_test_id("pose-x")).to_have_text(f"{x:.3f}")
        shown = float(watched.page.get_by_test_id("pose-heading").inner_text())
        assert shown == pytest.approx(math.degrees(heading), abs=0.11)
        until(lambda: colours(watched.page) > 10)
        assert not watched.complaints


@pytest.mark.browser
def test_a_page_that_stops_drawing_gets_no_frames(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        page.wait_for_timeout(1200)
        assert len(frames(watched)) > 5
        page.evaluate("() => { window.requestAnimationFrame = () => 0 }")
        page.wait_for_timeout(300)
        before = len(frames(watched))
        page.wait_for_timeout(1500)
        assert len(frames(watched)) <= before + 1


@pytest.mark.browser
def test_a_frame_of_a_known_map_is_small_and_the_grid_comes_when_it_is_new(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        page.wait_for_timeout(3500)
        later = frames(watched)[5:]
        assert sum(map(len, later)) / len(later) < 6000
        requests = [url for url in watched.requests if "grid.png" in url]
        assert 2 <= len(requests) <= 8
        assert len(set(requests)) == len(requests)


@pytest.mark.browser
def test_pan_zoom_follow_and_layers(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        until(lambda: colours(page) > 10)
        follow, fit = page.get_by_test_id("follow"), page.get_by_test_id("fit")
        expect(fit).to_have_attribute("aria-pressed", "true")
        picture = page.get_by_test_id("map").locator("canvas")
        whole = picture.screenshot()
        page.mouse.move(500, 500)
        page.mouse.down()
        page.mouse.move(600, 450)
        page.mouse.up()
        expect(fit).to_have_attribute("aria-pressed", "false")
        assert picture.screenshot() != whole
        page.mouse.wheel(0, -400)
        follow.click()
        expect(follow).to_have_attribute("aria-pressed", "true")
        page.mouse.wheel(0, -100)
        expect(follow).to_have_attribute("aria-pressed", "true")
        fit.click()
        for layer in ("grid", "path", "scan", "marks"):
            page.get_by_test_id(f"layer-{layer}").uncheck()
        page.wait_for_timeout(300)
        assert colours(page) > 2, "the robot stays"
        bare = page.evaluate("document.querySelector('canvas').toDataURL().length")
        page.get_by_test_id("layer-grid").check()
        until(lambda: page.evaluate("document.querySelector('canvas').toDataURL().length") > bare)


@pytest.mark.browser
def test_the_tip_names_a_wall_wherever_it_is_touched(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        until(lambda: colours(page) > 10)
        page.wait_for_timeout(500)
        place, wall = page.evaluate(
            """() => {
            const elements = Object.keys(mounted_app.elements).map((id) => getElement(+id));
            const map = elements.find((e) => e?.view?.scale);
            const [mark] = [...map.map.marks.values()].filter((m) => m[5]);
            const box = map.$el.getBoundingClientRect();
            const place = (x, y) => [
              box.left + map.width / 2 + (x - map.view.x) * map.view.scale,
              box.top + map.height / 2 - (y - map.view.y) * map.view.scale];
            const [x0, y0, x1, y1] = mark[5];
            return [place(x0 + 0.3 * (x1 - x0), y0 + 0.3 * (y1 - y0)), mark[0]];
            }"""
        )
        page.mouse.move(*place)
        expect(page.locator(".tip")).to_contain_text(f"wall {wall} · seen")


@pytest.mark.browser
def test_what_rounds_to_zero_has_no_sign(browser, robot):
    with visit(browser, robot) as watched:
        texts = watched.page.evaluate(
            """() => {
            const elements = Object.keys(mounted_app.elements).map((id) => getElement(+id));
            const map = elements.find((e) => e?.view?.scale);
            return [-0.0004, 0.0004, -0.0006, -0].map((value) => map.fixed(value, 3));
            }"""
        )
    assert texts == ["0.000", "0.000", "-0.001", "0.000"]


@pytest.mark.browser
def test_pages_have_views_of_their_own(browser, robot):
    with visit(browser, robot) as one, visit(browser, robot, "watcher") as other:
        one.page.get_by_test_id("follow").click()
        one.page.wait_for_timeout(300)
        expect(other.page.get_by_test_id("fit")).to_have_attribute("aria-pressed", "true")


@pytest.mark.browser
def test_a_new_map_replaces_the_one_before_on_a_page_that_shows_all(browser, robot):
    """The view of all follows the grid, whose picture is loaded later than the frame."""
    with visit(browser, robot, "watcher") as watched:
        page = watched.page
        expect(page.get_by_test_id("fit")).to_have_attribute("aria-pressed", "true")
        until(lambda: any("/grid.png" in url for url in watched.requests))
        page.wait_for_timeout(1000)
        run = int(page.get_by_test_id("map").get_attribute("data-run"))
        robot.ask("begin")
        expect(page.get_by_test_id("map")).to_have_attribute("data-run", str(run + 1))
        page.wait_for_function(
            "Number(document.querySelector('[data-testid=map]').dataset.scans) > 5"
        )
        assert not watched.complaints


@pytest.mark.browser
def test_the_grid_is_asked_for_without_its_picture(robot):
    asked = urllib.request.Request(f"{robot.address}/grid.png", method="HEAD")

    def answer():
        try:
            with urllib.request.urlopen(asked, timeout=5) as found:
                return found.status, found.read()
        except urllib.error.HTTPError as refused:
            return refused.code, b""

    until(lambda: answer() != (404, b""))  # before the first grid
    assert answer() == (200, b"")


@pytest.mark.browser
def test_two_fingers_zoom(browser, robot):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with visit(browser, robot, **phone) as watched:
        page = watched.page
        page.wait_for_timeout(500)
        read = """Object.keys(mounted_app.elements).map((id) => getElement(+id)?.view?.scale)
            .find((scale) => scale)"""
        before = page.evaluate(read)
        touch = page.context.new_cdp_session(page)
        for kind, apart in (("touchStart", 40), ("touchMove", 80), ("touchMove", 120)):
            at = [{"x": 190 + s * apart / 2, "y": 300, "id": i} for i, s in enumerate((-1, 1))]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        assert page.evaluate(read) == pytest.approx(3 * before, rel=0.1)
        assert page.evaluate("visualViewport.scale") == 1
