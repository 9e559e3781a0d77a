"""The whole robot: log in, drive round the arena, record, stop, download, and map the log."""

import os
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect
from tests.platform.console.pilot import ARENA, Pilot
from tests.platform.console.robot_process import PASSWORD, RobotProcess, imp

from impslam.evaluation.landmarks import corners, score_landmarks
from impslam.maps.landmark_table import read_landmarks
from impslam.simulation.world import load_world

pytestmark = pytest.mark.browser

SHOTS = os.environ.get("IMPSLAM_SHOTS")  # a folder for the pictures of the docs


def log_in(browser: Browser, address: str, **context) -> Page:
    page = browser.new_context(**context).new_page()
    page.goto(address)
    assert page.url.endswith("/login")
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Log in").click()
    expect(page.get_by_test_id("map")).to_be_visible(timeout=20_000)
    return page


def shoot(page: Page, name: str) -> None:
    if SHOTS:
        page.screenshot(path=str(Path(SHOTS) / f"{name}.png"))


def errors(score) -> dict[str, float]:
    return {error.name: error.distance for error in score.found}


def test_a_newcomer_drives_records_and_maps_the_arena(browser, tmp_path):
    config, logs = tmp_path / "config", tmp_path / "logs"
    imp("robot", "password", config=config, text=PASSWORD + "\n")
    with RobotProcess(config=config, folder=logs) as robot:
        page = log_in(browser, robot.address, viewport={"width": 1440, "height": 900})
        page.get_by_test_id("map-start").click()
        page.get_by_test_id("record").click()
        page.wait_for_function(
            "Number(document.querySelector('[data-testid=map]').dataset.scans) > 5", timeout=90_000
        )
        page.get_by_test_id("take").click()
        pilot = Pilot(page)
        pilot.drive(ARENA[:9])
        shoot(page, "console-desktop")
        phone = log_in(
            browser,
            robot.address,
            viewport={"width": 390, "height": 844},
            device_scale_factor=2,
            has_touch=True,
            is_mobile=True,
        )
        phone.wait_for_timeout(1500)
        shoot(phone, "console-phone")
        phone.close()
        pilot.drive(ARENA[9:])
        page.get_by_test_id("leave").click()
        page.get_by_test_id("record-stop").click()
        with page.expect_download() as coming:
            page.get_by_test_id("panel-logs").get_by_test_id("download").first.click()
        log = tmp_path / "round.mcap"
        coming.value.save_as(log)
        page.get_by_test_id("map-save").click()
        expect(page.get_by_test_id("map-saved")).to_contain_text("map-", timeout=60_000)
    assert log.stat().st_size == next(logs.glob("*.mcap")).stat().st_size
    run = tmp_path / "run"
    start = "start=[0.0, 0.0, 1.5707963267948966]"
    imp("run", str(log), "-o", str(run), "--set", start, config=config)
    truth = load_world("arena").landmarks()
    score = score_landmarks(read_landmarks(run / "landmarks.csv"), [*truth, *corners(truth)])
    found = errors(score)
    assert {mark.name for mark in truth} <= found.keys()
    assert max(found[mark.name] for mark in truth) <= 0.03
    assert not score.false
    assert not score.doubles
    live = next((logs / "maps").glob("map-*"))
    assert np.loadtxt(live / "trajectory.tum").shape[0] > 100
