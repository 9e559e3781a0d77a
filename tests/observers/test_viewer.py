"""The map of the report: its data, and what it does in a browser."""

import base64
import json
import re
import time
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.observers import runs
from tests.platform.console import browsing

from impslam.geometry.se2 import between, compose
from impslam.health import BLIND, Health
from impslam.maps.files import FREE, OCCUPIED, UNKNOWN, MapImage
from impslam.observers import viewer
from impslam.observers.accuracy import align_truth
from impslam.observers.grid_picture import coarsened
from impslam.observers.history import History
from impslam.observers.recorder import Recorder
from impslam.observers.run_folder import write_run
from impslam.run import run
from impslam.types import Edges

KINDS = {"f4": "<f4", "i4": "<i4", "i2": "<i2", "u1": "u1"}
IMAGE = MapImage(np.full((4, 6), FREE, np.uint8), 0.5, np.array([-1.0, -2.0]))
BLIND_SCANS = slice(20, 30)


def unpacked(text):
    kind, data = text.split(":")
    return np.frombuffer(base64.b64decode(data), KINDS[kind])


def closed(known):
    """Give a map a motion and a loop that is 0.2 m off."""
    poses = known.keyframes.poses
    i, j = np.array([0, 10]), np.array([1, 22])
    off = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 2.0 * np.pi]])
    information = np.broadcast_to(np.diag([100.0, 100.0, 400.0]), (2, 3, 3))
    T = between(poses[i], poses[j]) + off
    return replace(known, edges=Edges(i, j, T, information, np.array([np.inf, 4.0])))


def made_up(n=50, frame=(0.0, 0.0, 0.0)):
    """Return the history and the facts of a run with a loop, a truth, and scans that saw nothing."""
    known = closed(runs.play([], n))
    truth = np.array([(pose.stamp, *pose.pose) for pose in runs.make_truth(n, frame)])
    reasons = np.zeros(n, np.int8)
    reasons[BLIND_SCANS] = BLIND
    health = Health(known.stamps, reasons, np.zeros(n))
    return History(known, truth), runs.make_outcome(n, health=health)


def drawn(history, outcome, image=IMAGE):
    scene = viewer.scene(history, outcome, image, align_truth(history))
    json.dumps(scene, allow_nan=False)
    for part in ("path", "scans", "loops"):
        columns = scene[part].items()
        scene[part] = {k: unpacked(v) if isinstance(v, str) else v for k, v in columns}
    return scene


def test_the_path_is_that_of_the_map():
    history, outcome = made_up(frame=(40.0, -7.0, 2.0))
    path = drawn(history, outcome)["path"]
    poses = np.column_stack([path[name] for name in "xyh"])
    np.testing.assert_allclose(poses, history.path[:, 1:], atol=1e-5)
    np.testing.assert_allclose(path["t"], 0.1 * np.arange(50), atol=1e-5)
    np.testing.assert_allclose(path["xy"], history.covariances[:, 0, 1], atol=1e-9)
    assert path["state"].tolist() == [0] * 20 + [1] * 10 + [0] * 20
    error = np.hypot(path["x"] - path["tx"], path["y"] - path["ty"])
    assert error.max() < 0.05  # the truth is laid on the first pose, whatever its frame


def test_the_scan_of_a_row_lies_on_the_walls():
    """The room is 6 m wide: each point is on a wall, from whichever keyframe it was seen."""
    history, outcome = made_up()
    scene = drawn(history, outcome)
    scans, rows = scene["scans"], scene["path"]["scan"]
    assert rows[0] == 0
    assert (np.diff(rows) >= 0).all()
    for i in np.unique(rows):
        begin, end = scans["starts"][[i, i + 1]]
        points = scans["points"].reshape(-1, 2)[begin:end] * scans["unit"]
        pose = np.array([scans[name][i] for name in "xyh"])
        at = compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]
        from_wall = np.minimum(abs(abs(at[:, 0]) - runs.HALF), abs(abs(at[:, 1] - 1.0) - runs.HALF))
        assert len(at) == len(runs.ANGLES)
        assert from_wall.max() < 0.1


def test_loops_are_the_edges_that_may_be_wrong_with_their_normalised_innovation():
    loops = drawn(*made_up())["loops"]
    assert (loops["i"].tolist(), len(loops["j"])) == ([10], 1)
    np.testing.assert_allclose(loops["nis"], 100.0 * 0.2**2, rtol=1e-5)  # a whole turn is none


def test_long_runs_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(viewer, "MAX_ROWS", 10)
    monkeypatch.setattr(viewer, "MAX_POINTS", 1000)
    history, outcome = made_up()
    scene = drawn(history, outcome)
    assert np.ptp(np.diff(scene["path"]["t"])) < 1e-4
    assert len(scene["path"]["t"]) == 10
    assert scene["path"]["x"][-1] == np.float32(history.path[-1, 1])
    scans, kept = scene["scans"], np.diff(scene["scans"]["starts"])
    assert 2 * scans["starts"][-1] == len(scans["points"]) <= 2000
    assert kept.max() - kept.min() <= 1
    everywhere = history.known.keyframes.points[:: -(-len(history.known.keyframes.points) // 1000)]
    np.testing.assert_allclose(
        scans["points"].reshape(-1, 2) * scans["unit"], everywhere, atol=scans["unit"]
    )


@pytest.mark.parametrize("n", [0, 1])
def test_runs_of_hardly_any_scans_have_data(n):
    known = runs.play([], n, landmarks=())
    empty = MapImage(np.full((1, 1), UNKNOWN, np.uint8), 0.05, np.zeros(2))
    scene = drawn(History(known, np.empty((0, 4))), runs.make_outcome(n), empty)
    assert len(scene["path"]["t"]) == n


def test_a_coarser_grid_lies_where_the_fine_one_does_and_keeps_what_is_occupied():
    fine = np.full((5, 7), FREE, np.uint8)
    fine[0, 0], fine[4, 6] = OCCUPIED, UNKNOWN
    image = MapImage(fine, 0.1, np.array([2.0, 3.0]))
    coarse = coarsened(image, 12)
    assert coarse.pixels.tolist() == [
        [OCCUPIED, FREE, FREE, UNKNOWN],
        *[[FREE] * 3 + [UNKNOWN]] * 1,
        [UNKNOWN] * 4,
    ]
    assert coarse.resolution == pytest.approx(0.2)
    np.testing.assert_allclose(coarse.extent[::3], image.extent[::3])
    assert coarsened(image, 35) is image


@pytest.fixture(scope="module")
def browser(chromium):
    with browsing.browser(chromium) as made:
        yield made


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    history, outcome = made_up()
    landmarks = runs.make_landmarks()
    known = replace(history.known, landmarks=landmarks)
    write_run(folder, known, replace(outcome, log=folder / "</script>.log"), history.true_path)
    return folder / "report.html"


@contextmanager
def opened(browser, file, **context):
    context.setdefault("viewport", {"width": 1280, "height": 900})
    made = browser.new_context(**context)
    watched = browsing.Watched(made.new_page())
    watched.page.goto(file.as_uri())
    watched.page.wait_for_function("document.querySelector('.clock').textContent !== ''")
    try:
        yield watched.page
    finally:
        made.close()
    assert watched.complaints == []
    assert [url for url in watched.requests if not url.startswith(("file:", "data:"))] == []


def picture(page):
    """Return the canvas as it is drawn, after the next frame."""
    page.wait_for_timeout(100)
    data = page.locator(".stage canvas").screenshot()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def changed(page, action):
    before = picture(page)
    action()
    return float((picture(page) != before).any(axis=2).mean())


def centre(page):
    box = page.locator(".stage canvas").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def seconds(page):
    return float(page.locator(".clock").text_content().split()[0])


@pytest.mark.browser
def test_the_map_moves_zooms_and_hides_its_layers(browser, report):
    with opened(browser, report) as page:
        page.locator(".viewer").scroll_into_view_if_needed()
        labels = page.locator(".layers").text_content()
        assert "Odometry alone" in labels, "as on the robot's page"
        assert "Labels" in labels
        page.mouse.move(*centre(page))
        assert changed(page, lambda: page.mouse.wheel(0, -400)) > 0.1

        def drag():
            page.mouse.down()
            page.mouse.move(*(v + 80 for v in centre(page)), steps=3)
            page.mouse.up()

        assert changed(page, drag) > 0.1
        page.locator(".viewer").focus()
        assert changed(page, lambda: page.keyboard.press("0")) > 0.1
        for layer in page.locator(".layers input").all():
            if layer.get_attribute("data-layer") != "odometry":
                assert layer.is_checked()
            name = layer.get_attribute("data-layer")
            assert changed(page, layer.click) > 1e-4, name
            layer.click()
        page.locator(".viewer").focus()
        assert changed(page, lambda: page.keyboard.press("1")) > 0.1  # the grid
        for colour in ("time", "health", "uncertainty", "error"):
            choose = page.locator(".colour").select_option
            assert changed(page, lambda c=colour, choose=choose: choose(c)) > 1e-4, colour
        assert "cm" in page.locator(".legend").text_content()


@pytest.mark.browser
def test_the_slider_the_keys_and_the_health_band_lead_to_a_time(browser, report):
    with opened(browser, report) as page:
        assert seconds(page) == 4.9
        page.locator(".viewer").focus()
        page.keyboard.press("ArrowLeft")
        assert seconds(page) == 4.8
        page.keyboard.press("Home")
        assert seconds(page) == 0.0
        page.locator(".time input").focus()
        page.keyboard.press("ArrowRight")
        assert seconds(page) == 0.1
        band = page.locator(".plot.health")
        band.scroll_into_view_if_needed()
        box = band.bounding_box()
        page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 10)
        assert seconds(page) == pytest.approx(2.45, abs=0.11)
        assert "DEGRADED: the lidar sees nothing" in page.locator(".readout").text_content()
        assert "from the truth" in page.locator(".readout").text_content()
        assert page.locator(".cursor").count() > 3
        page.locator(".speed").select_option("10")
        page.locator('[data-key=" "]').click()
        page.wait_for_function("document.querySelector('.clock').textContent === '4.9 s'")
        assert page.locator('[data-key=" "]').get_attribute("aria-label") == "Play"


@pytest.mark.browser
def test_values_are_shown_at_the_pointer(browser, report):
    with opened(browser, report) as page:
        page.locator(".viewer").scroll_into_view_if_needed()
        box = page.locator(".stage canvas").bounding_box()
        told = set()
        for x in [0.5, *np.linspace(0.3, 0.8, 50)]:
            page.mouse.move(box["x"] + x * box["width"], box["y"] + box["height"] / 2)
            if page.locator(".tip").is_visible():
                told.add(page.locator(".tip").text_content())
        text = "\n".join(told)
        for words in ("cylinder 7", "radius 0.100 m", "wall 8", "TRACKING", "heading"):
            assert words in text, words


@pytest.mark.browser
def test_values_are_shown_at_a_tap(browser, report):
    with opened(browser, report, has_touch=True) as page:
        page.locator(".viewer").scroll_into_view_if_needed()
        box = page.locator(".stage canvas").bounding_box()
        told = set()
        for x in np.linspace(0.3, 0.8, 50):
            page.touchscreen.tap(box["x"] + x * box["width"], box["y"] + box["height"] / 2)
            if page.locator(".tip").is_visible():
                told.add(page.locator(".tip").text_content())
        text = "\n".join(told)
        for words in ("cylinder 7", "wall 8", "TRACKING"):
            assert words in text, words


@pytest.mark.browser
def test_on_a_phone_nothing_is_cut_and_two_fingers_zoom(browser, report):
    phone = {"viewport": {"width": 360, "height": 740}, "has_touch": True}
    with opened(browser, report, **phone) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == 360
        page.locator(".viewer").scroll_into_view_if_needed()
        x, y = centre(page)
        client = page.context.new_cdp_session(page)

        def fingers(kind, apart):
            spots = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
            touch = {"type": kind, "touchPoints": spots if kind != "touchEnd" else []}
            client.send("Input.dispatchTouchEvent", touch)

        def pinch():
            fingers("touchStart", 20)
            for apart in (40, 70, 100):
                fingers("touchMove", apart)
            fingers("touchEnd", 0)

        assert changed(page, pinch) > 0.1


@pytest.mark.browser
def test_a_dark_page_has_a_dark_map(browser, report):
    light = {}
    for scheme in ("light", "dark"):
        with opened(browser, report, color_scheme=scheme) as page:
            page.locator(".viewer").scroll_into_view_if_needed()
            light[scheme] = picture(page).mean()
    assert light["light"] > 180
    assert light["dark"] < 90


@pytest.mark.browser
@pytest.mark.real
def test_the_report_of_a_building_is_small_and_answers_within_two_seconds(
    browser, data_folder, tmp_path
):
    run(data_folder / "intel" / "intel.log", observers=[Recorder(tmp_path)])
    assert (tmp_path / "report.html").stat().st_size < 5e6
    seconds = []
    for _ in range(3):  # another process may hold the processor for a while
        begin = time.monotonic()
        with opened(browser, tmp_path / "report.html") as page:
            seconds.append(time.monotonic() - begin)
            assert re.search(r"TRACKING", page.locator(".readout").text_content())
    assert min(seconds) < 2.0
