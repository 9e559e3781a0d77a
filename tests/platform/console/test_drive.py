"""The drive panel: drive control, commands, and everything that must stop the robot."""

import math
import time

import pytest
from playwright.sync_api import expect
from tests.platform.console import browsing
from tests.platform.console.browsing import until, visit

from impslam.platform.console.drive_pad import pad_command
from impslam.platform.console.link import age
from impslam.platform.devices.base import now

NEWEST = "window.impLink.clock()"


def milliseconds(ago: float = 0.0) -> int:
    return round(1000 * (time.monotonic() - ago))


def test_a_command_is_two_fractions_and_the_robots_clock():
    soon = pytest.approx(0.05, abs=0.05)
    assert pad_command([0.5, -1, milliseconds()]) == (0.5, -1.0, soon)
    assert pad_command([7.0, -7.0, milliseconds()]) == (1.0, -1.0, soon)


@pytest.mark.parametrize(
    "bad",
    [
        *(None, 1, [], [1, 1], {}, "100", [1, 1, 1, 1], ["1", 1, 0], [None, 1, 0], [[1], 1, 0]),
        *([math.nan, 0, 0], [math.inf, 0, 0], [0, -math.inf, 0]),
    ],
)
def test_a_malformed_command_is_none(bad):
    if isinstance(bad, list) and len(bad) == 3:
        bad = [*bad[:2], milliseconds()]
    assert pad_command(bad) is None


def test_the_age_of_a_command_is_measured():
    assert pad_command([1.0, 0.0, milliseconds(0.7)])[2] == pytest.approx(0.74, abs=0.06)
    assert pad_command([1.0, 0.0, milliseconds(-5.0)]) is None, "a beat that was never sent"
    assert pad_command([1.0, 0.0, None]) is None
    assert math.isnan(age(float(milliseconds())))
    assert age(milliseconds(-0.002)) == 0.0


@pytest.fixture(scope="module")
def shared():
    with browsing.robot() as made:
        yield made


def middle(page):
    box = page.get_by_test_id("pad").bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def press_forward(page):
    """Hold the joystick fully forward."""
    x, y = middle(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y - 200)


def take(page):
    page.get_by_test_id("take").click()
    expect(page.get_by_test_id("driver")).to_have_text("You drive")


def moves(robot):
    return robot.state()["speed"] > 0


def is_stationary(robot):
    state = robot.state()
    return state["speed"] == 0 and state["turn_rate"] == 0


@pytest.mark.browser
def test_the_joystick_drives_and_its_release_stops(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        press_forward(page)
        page.wait_for_timeout(400)
        page.mouse.up()
        assert robot.state()["told"] == [], "nobody has taken control"
        take(page)
        press_forward(page)
        until(lambda: robot.state()["speed"] == pytest.approx(0.3))  # half of the limit of 0.6
        page.wait_for_timeout(1000)
        assert moves(robot), "held on, it must go on beyond the dead man"
        expect(page.get_by_test_id("command")).to_contain_text("0.30")
        page.mouse.up()
        released = now()
        until(lambda: is_stationary(robot))
        told = robot.state()["told"]
        assert told[-1][1:] == [0.0, 0.0]
        assert told[-1][0] - released < 0.25, "a release must not wait for the dead man"
        x, y = middle(page)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 300, y)
        until(lambda: robot.state()["turn_rate"] == pytest.approx(0.75))  # to the left
        assert robot.state()["speed"] == pytest.approx(0.0, abs=0.02)
        page.mouse.up()
        until(lambda: is_stationary(robot))
        assert not watched.complaints


@pytest.mark.browser
def test_keys_drive_where_no_text_is_written(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        page.get_by_test_id("record-name").focus()
        page.keyboard.type("wasd")
        page.wait_for_timeout(300)
        assert robot.state()["told"] == []
        page.get_by_test_id("map").click(position={"x": 300, "y": 300})
        page.keyboard.down("w")
        page.keyboard.down("ArrowLeft")
        until(lambda: robot.state()["turn_rate"] > 0 and moves(robot))
        page.keyboard.up("ArrowLeft")
        until(lambda: robot.state()["turn_rate"] == 0)
        assert moves(robot)
        page.keyboard.up("w")
        until(lambda: is_stationary(robot))
        page.keyboard.down("s")
        until(lambda: robot.state()["speed"] < 0)
        page.keyboard.up("s")
        until(lambda: is_stationary(robot))


@pytest.mark.browser
@pytest.mark.parametrize("leave", ["blur", "pagehide", "visibilitychange"])
def test_leaving_a_page_releases_control_at_once(browser, robot, leave):
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        page.keyboard.down("w")
        until(lambda: moves(robot))
        target = "document" if leave == "visibilitychange" else "window"
        page.evaluate(f"{target}.dispatchEvent(new Event('{leave}'))")
        left = now()
        until(lambda: is_stationary(robot))
        assert robot.state()["told"][-1][0] - left < 0.25
        page.wait_for_timeout(500)
        assert is_stationary(robot), "the key is still down, but must be pressed anew"
        page.keyboard.up("w")
        page.keyboard.down("w")
        until(lambda: moves(robot))


@pytest.mark.browser
@pytest.mark.parametrize("how", ["button", "Space", "Escape", "box"])
def test_anyone_stops_and_only_the_driver_releases(browser, robot, how):
    with visit(browser, robot) as driver, visit(browser, robot, "watcher") as watcher:
        page = driver.page
        take(page)
        press_forward(page)
        until(lambda: moves(robot))
        if how == "button":
            watcher.page.get_by_test_id("stop").click()
        elif how == "box":  # which has the focus, and which the space bar would tick again
            watcher.page.get_by_test_id("layer-dead").click()
            watcher.page.keyboard.press("Space")
            expect(watcher.page.get_by_test_id("layer-dead")).to_be_checked()
        else:
            watcher.page.keyboard.press(how)
        until(lambda: robot.state()["stopped"])
        assert is_stationary(robot)
        expect(page.get_by_test_id("stopped")).to_have_text("Emergency stop by watcher 3")
        expect(page.get_by_test_id("stop")).to_have_attribute("data-stopped", "true")
        page.mouse.up()
        press_forward(page)
        page.wait_for_timeout(400)
        assert is_stationary(robot)
        page.mouse.up()
        expect(watcher.page.get_by_test_id("stopped")).to_be_visible()
        expect(watcher.page.get_by_test_id("release")).to_be_hidden()
        page.get_by_test_id("release").click()
        until(lambda: not robot.state()["stopped"])
        assert is_stationary(robot)
        expect(page.get_by_test_id("stop")).to_have_attribute("data-stopped", "false")
        press_forward(page)
        until(lambda: moves(robot))


@pytest.mark.browser
def test_the_stop_is_in_reach_over_a_dialog(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        page.get_by_test_id("panel-logs").get_by_test_id("delete").first.click()
        expect(page.get_by_test_id("confirm")).to_be_visible()
        page.get_by_test_id("stop").click()
        until(lambda: robot.state()["stopped"] == "emergency stop by driver 1")


@pytest.mark.browser
def test_one_drives_and_the_others_see_who(browser, robot):
    with visit(browser, robot) as first:
        take(first.page)
        with visit(browser, robot, "second") as second:
            expect(second.page.get_by_test_id("driver")).to_have_text("driver 1 drives")
            expect(second.page.get_by_test_id("take")).to_be_hidden()
            first.page.get_by_test_id("leave").click()
            take(second.page)
            expect(first.page.get_by_test_id("driver")).to_have_text("driver 2 drives")
        until(lambda: robot.state()["driver"] == "")  # the page of who drove is closed


@pytest.mark.browser
def test_two_pages_of_one_login_do_not_drive_at_once(browser, robot):
    with visit(browser, robot) as first, visit(browser, robot) as second:
        take(first.page)
        expect(second.page.get_by_test_id("driver")).to_have_text("You drive on another page")
        second.page.keyboard.down("w")
        second.page.wait_for_timeout(400)
        assert robot.state()["told"] == []
        second.page.keyboard.up("w")
        take(second.page)
        expect(first.page.get_by_test_id("driver")).to_have_text("You drive on another page")
        first.page.keyboard.down("w")
        first.page.wait_for_timeout(400)
        assert robot.state()["told"] == []


@pytest.mark.browser
def test_a_session_that_ends_releases_control_and_commands_no_more(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        press_forward(page)
        until(lambda: moves(robot))
        page.context.request.get(f"{robot.address}/fake/end?as=driver")
        until(lambda: robot.state()["driver"] == "")
        until(lambda: is_stationary(robot))
        # Chromium never answers to a close in the middle of a reload: see the reload to its end
        expect(page.get_by_text("log in again")).to_be_visible()


@pytest.mark.browser
def test_a_real_robot_offers_no_faults(browser, robot):
    with visit(browser, robot) as watched:
        watched.page.get_by_test_id("tab-health").click()
        expect(watched.page.get_by_test_id("panel-events")).to_be_visible()
        expect(watched.page.get_by_test_id("panel-faults")).to_have_count(0)


FORGE = """(args) => {
  let sent = 0;
  for (const [id, element] of Object.entries(mounted_app.elements))
    for (const event of element.events ?? []) {
      if (event.type === 'stop') continue;
      const names = { id: +id, client_id: window.clientId, listener_id: event.listener_id };
      window.socket.emit('event', { ...names, args });
      sent += 1;
    }
  return sent;
}"""


@pytest.mark.browser
def test_a_watcher_changes_nothing_whatever_is_sent(browser, robot):
    with visit(browser, robot, "watcher") as watched:
        page = watched.page
        expect(page.get_by_test_id("watching")).to_be_visible()
        expect(page.get_by_test_id("pad")).to_have_count(0)
        before = robot.state()
        for args in ([f"[1,0,{page.evaluate(NEWEST)}]"], ["true"], ['"x"'], []):
            assert page.evaluate(FORGE, args) > 10
        page.wait_for_timeout(800)
        after = robot.state()
        for what in ("told", "driver", "stopped", "starts", "recording", "logs", "releases"):
            assert after[what] == before[what]


@pytest.mark.browser
def test_an_ended_session_cannot_command(browser, robot):
    """The page still has all its buttons and ids, but rights are checked at each command."""
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        page.keyboard.down("w")
        until(lambda: moves(robot))
        robot.ask("demote")
        until(lambda: is_stationary(robot))
        for _ in range(5):
            page.evaluate(FORGE, [f"[1,0,{page.evaluate(NEWEST)}]"])
            page.wait_for_timeout(100)
        assert is_stationary(robot)
        assert not robot.state()["recording"]
        assert robot.state()["starts"] == 0


@pytest.mark.browser
def test_a_lost_link_is_shown_and_leaves_the_drive_control(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        page.keyboard.down("w")
        until(lambda: moves(robot))
        with robot.frozen():
            frozen = time.monotonic()
            expect(page.get_by_test_id("link-lost")).to_contain_text("robot stops by itself")
            assert 0.5 < time.monotonic() - frozen < 4.0
            box = page.get_by_test_id("link-lost").bounding_box()
            assert box["width"] == page.viewport_size["width"]
            expect(page.get_by_test_id("link-lost")).to_contain_text("3 s")
            for part in (page.get_by_test_id("map"), page.locator(".panel-drive")):
                assert "grayscale" in part.evaluate("e => getComputedStyle(e).filter")
            thawed = now()
        expect(page.get_by_test_id("link-lost")).to_have_count(0)
        page.wait_for_timeout(600)
        late = [told for told in robot.state()["told"] if told[0] > thawed and told[1] > 0]
        assert not late, "what was sent before or while the link was dead must not move the robot"
        assert is_stationary(robot)
        page.keyboard.up("w")
        expect(page.get_by_test_id("driver")).to_have_text("You drive")
        page.keyboard.down("w")
        until(lambda: moves(robot))


@pytest.mark.browser
def test_a_page_whose_session_is_over_when_the_link_is_back_leads_to_the_login(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        page.route("**/grid.png*", lambda route: route.fulfill(status=401))
        page.route(f"{robot.address}/", lambda route: route.fulfill(body="the login"))
        with robot.frozen():
            expect(page.locator("body")).to_have_text("the login")


@pytest.mark.browser
def test_commands_that_waited_on_a_slow_link_do_not_move_the_robot(browser, robot):
    with visit(browser, robot) as watched:
        page = watched.page
        take(page)
        page.keyboard.down("w")
        until(lambda: moves(robot))
        with robot.frozen():
            page.wait_for_timeout(250)
            page.keyboard.up("w")
            page.wait_for_timeout(400)
            thawed = now()
        page.wait_for_timeout(600)
        late = [told for told in robot.state()["told"] if told[0] > thawed and told[1] > 0]
        assert not late
        assert is_stationary(robot)
        expect(page.get_by_test_id("link-lost")).to_have_count(0)


@pytest.mark.browser
def test_a_thumb_drives(browser, robot):
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with visit(browser, robot, **phone) as watched:
        page = watched.page
        page.get_by_test_id("take").tap()
        x, y = middle(page)
        touch = page.context.new_cdp_session(page)

        def send(kind, *points):
            at = [{"x": px, "y": py, "id": i} for i, (px, py) in enumerate(points)]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

        expect(page.get_by_test_id("driver")).to_have_text("You drive")
        send("touchStart", (x, y))
        send("touchMove", (x, y - 100))
        until(lambda: robot.state()["speed"] == pytest.approx(0.3))
        assert page.evaluate("scrollY") == 0
        send("touchEnd")
        until(lambda: is_stationary(robot))
        send("touchStart", (x, y - 60))
        until(lambda: moves(robot))
        send("touchCancel")
        until(lambda: is_stationary(robot))
