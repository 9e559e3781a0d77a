"""Limits of watchers: turns, pages, sockets."""

import asyncio
import contextlib
import gc
import itertools
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from fastapi import Request
from nicegui import Client, ui
from tests.platform.console.serving import WATCH, serving
from tests.platform.console.test_security import opened, page_of, soon, status

from impslam.platform.console import admission, page_limits
from impslam.platform.console.admission import MAX_PER_CLIENT, Lane
from impslam.platform.console.page_limits import MAX_PAGES, MAX_UNOPENED, MAX_WATCHER_PAGES

BUILD = 0.1  # s that a page takes to build, as on an ARM board


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A server with a page that is slow to build, and records the times."""
    built = []

    def build(_):
        @ui.page("/")
        def page(request: Request):
            time.sleep(BUILD)
            ui.button("go", on_click=lambda: None)
            built.append(request.state.session)

    with serving(tmp_path_factory.mktemp("robot"), build=build) as running:
        running.built = built
        yield running


def owned(session_may_drive):
    """Return the existing pages of watchers, or of drivers."""
    found = [getattr(page.request.state, "session", None) for page in Client.instances.values()]
    return [one for one in found if one is not None and one.may_drive is session_may_drive]


def statuses(client, path, number):
    """Request a path many times at once; return the answers."""
    with ThreadPoolExecutor(number) as pool:
        return [one.status_code for one in pool.map(lambda _: client.get(path), range(number))]


class TestLane:
    pytestmark = pytest.mark.anyio

    @pytest.fixture
    def anyio_backend(self):
        return "asyncio"

    async def test_one_at_a_time_in_their_order_with_a_pause(self, monkeypatch):
        monkeypatch.setattr(admission, "PAUSE_RATIO", 2.0)
        lane, spans = Lane(), []

        async def work(key):
            turn = await lane.turn(key)
            begun = time.monotonic()
            await asyncio.sleep(0.02)
            spans.append((key, begun, time.monotonic()))
            turn.end()
            turn.end()  # the second one does nothing

        await asyncio.gather(*[work(f"{k}") for k in range(4)])
        assert [key for key, _, _ in spans] == ["0", "1", "2", "3"]
        for (_, begun, ended), (_, after, _) in itertools.pairwise(spans):
            assert after - ended >= 1.9 * (ended - begun)

    async def test_one_session_may_not_fill_it(self):
        lane = Lane()
        first = await lane.turn("a")
        waiting = [asyncio.ensure_future(lane.turn("a")) for _ in range(MAX_PER_CLIENT)]
        await asyncio.sleep(0)
        assert await lane.turn("a") is None
        other = asyncio.ensure_future(lane.turn("b"))
        await asyncio.sleep(0)
        assert not other.done()
        first.end()
        for one in [*waiting, other]:
            (await one).end()
        assert not lane._waiting

    async def test_all_together_are_bounded(self, monkeypatch):
        monkeypatch.setattr(admission, "WAIT_TIMEOUT", 0.05)
        lane = Lane()
        await lane.turn("held")
        waiting = [asyncio.ensure_future(lane.turn(f"{k}")) for k in range(admission.MAX_WAITING)]
        await asyncio.sleep(0)
        assert await lane.turn("another") is None
        assert set(await asyncio.gather(*waiting)) == {None}  # none waits for ever


class TestRequests:
    def test_requests_of_a_driver_are_not_delayed_by_a_watcher(self, served):
        with served.logged_in() as driver, served.logged_in(WATCH) as watcher:
            driver.get("/camera.jpg")
            with ThreadPoolExecutor(6) as pool:
                asked = [pool.submit(watcher.get, "/") for _ in range(6)]
                before = len(served.built)
                soon(lambda: len(served.built) > before)
                for _ in range(3):
                    count = len(served.built)
                    assert driver.get("/camera.jpg").status_code == 200
                    assert len(served.built) <= count + 1  # not behind all that wait
                assert {one.result().status_code for one in asked} == {200}

    def test_too_many_requests_at_once_are_refused(self, served, caplog):
        with served.logged_in(WATCH) as watcher:
            codes = statuses(watcher, "/", 20)
            assert set(codes) == {200, 503}
            assert codes.count(200) >= MAX_PER_CLIENT
        assert "too many requests at once" in caplog.text

    def test_a_driver_is_not(self, served):
        with served.logged_in() as driver:
            assert statuses(driver, "/", 20) == [200] * 20

    def test_a_stranger_does_not_delay_watchers_or_other_strangers(self, served):
        with served.client() as stranger, served.logged_in(WATCH) as watcher:
            assert set(statuses(stranger, "/login", 30)) <= {200, 503}
            assert watcher.get("/camera.jpg").status_code == 200
            assert stranger.get("/login").status_code == 200

    def test_a_browser_s_six_connections_are_never_refused(self, served):
        with served.logged_in(WATCH) as watcher, ThreadPoolExecutor(6) as pool:
            codes = list(pool.map(lambda _: watcher.get("/camera.jpg").status_code, range(60)))
        assert codes == [200] * 60


class TestPages:
    def test_unopened_pages_do_not_pile_up(self, served):
        with served.logged_in(WATCH) as watcher:
            for _ in range(MAX_UNOPENED + 4):
                assert watcher.get("/").status_code == 200
            mine = served.built[-1]
            assert owned(False).count(mine) == MAX_UNOPENED

    def test_pages_that_were_left_are_deleted_once(self, served, monkeypatch, caplog):
        monkeypatch.setattr(page_limits, "MAX_UNOPENED", 1)
        with served.logged_in(WATCH) as watcher:
            page, _ = page_of(watcher)
            with opened(served, watcher, page=page):
                soon(lambda: Client.instances[page].has_socket_connection)
            soon(lambda: not Client.instances[page].has_socket_connection)
            for _ in range(3):
                assert watcher.get("/").status_code == 200
            soon(lambda: page not in Client.instances)
        assert not [record for record in caplog.records if record.name == "nicegui"]

    def test_open_pages_are_kept_and_bounded(self, served, monkeypatch, caplog):
        monkeypatch.setattr(page_limits, "MAX_PAGES", 2)
        with served.logged_in(WATCH) as watcher, contextlib.ExitStack() as stack:
            for _ in range(2):
                stack.enter_context(opened(served, watcher, page=page_of(watcher)[0]))
            soon(lambda: sum(page.has_socket_connection for page in Client.instances.values()) >= 2)
            assert watcher.get("/").status_code == 503
            assert "too many pages" in caplog.text

    def test_all_watchers_together_are_bounded(self, served, monkeypatch):
        monkeypatch.setattr(page_limits, "MAX_WATCHER_PAGES", 4)
        for _ in range(4):
            with served.logged_in(WATCH) as watcher:
                for _ in range(2):
                    assert watcher.get("/").status_code == 200
                assert len(owned(False)) <= 4

    def test_drivers_have_room(self, served):
        before = len(owned(True))
        with served.logged_in() as driver:
            for _ in range(MAX_PAGES + 2):
                assert driver.get("/").status_code == 200
        assert len(owned(True)) >= before + MAX_PAGES
        assert MAX_WATCHER_PAGES > MAX_PAGES > MAX_UNOPENED


class TestSockets:
    def test_a_watcher_has_a_few(self, served, caplog):
        with served.logged_in(WATCH) as watcher, contextlib.ExitStack() as stack:
            for _ in range(MAX_PER_CLIENT):
                stack.enter_context(opened(served, watcher))
            assert status(served, watcher) == 503
            assert "too many sockets" in caplog.text
            stack.close()
            soon(lambda: not served.server.config.app._sockets._open)
            with opened(served, watcher):
                pass

    def test_a_driver_has_more(self, served):
        with served.logged_in() as driver, contextlib.ExitStack() as stack:
            for _ in range(MAX_PER_CLIENT + 2):
                stack.enter_context(opened(served, driver))


def test_loaded_modules_are_frozen_for_the_garbage_collector(served):
    """A collection over all imported objects would delay commands by 0.1 s."""
    assert gc.get_freeze_count() > 100_000


def test_garbage_of_pages_is_collected_although_commands_of_imp_seldom_do(tmp_path):
    before = gc.get_threshold()
    gc.set_threshold(1_000_000, 20, 20)  # as by `impslam.cli`
    try:
        with serving(tmp_path):
            assert gc.get_threshold() == (700, 10, 10)
        assert gc.get_threshold() == (1_000_000, 20, 20)
    finally:
        gc.set_threshold(*before)
