"""Live mapping: the same map as of a log, never behind, every scan accounted for."""

import json
import logging
import math
import re
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import PrivateAttr
from tests.recorded import Played, perfect
from tests.rings import GRAPH, ring
from tests.waiting import wait_until

from impslam.component import parameter, register
from impslam.config import load
from impslam.errors import ImpError
from impslam.estimators import graph
from impslam.extractors.base import Extractor
from impslam.observers.live_view import LiveView
from impslam.observers.recorder import Recorder
from impslam.platform.devices.base import now
from impslam.platform.station import mapper as module
from impslam.platform.station import warm_up as warm
from impslam.platform.station.inbox import Inbox
from impslam.platform.station.mapper import LiveMapper
from impslam.recognition import global_search
from impslam.run import map_log
from impslam.simulation.world import load_world
from impslam.types import Climate, DeviceTime, LaserScan, TruePose, WheelAngles


@register("test_slow")
class Slow(Extractor):
    """Finds nothing, slowly, or fails at a scan."""

    seconds: float = parameter(0.0, "s", "how long a scan takes")
    fails_at: int = parameter(-1, "1", "the scan at which it fails")
    _seen: int = PrivateAttr(default=0)

    def extract(self, scan, rng):
        self._seen += 1
        if self._seen == self.fails_at:
            raise ZeroDivisionError("two\nlines")
        time.sleep(self.seconds)
        return []


EVERY_SCAN = ["keyframes.distance=0", "keyframes.angle=0", "keyframes.seconds=0"]


def slow(seconds=0.0, fails_at=-1):
    """Return a config whose only extractor is the slow one."""
    none = [f"sensors.lidar.extractors.{n}.kind=none" for n in ("walls", "cylinders", "corners")]
    own = "sensors.lidar.extractors.slow"
    return load(
        "imp",
        [*EVERY_SCAN, *none, f"{own}.kind=test_slow", f"{own}.seconds={seconds}",
         f"{own}.fails_at={fails_at}"],
    )  # fmt: skip


class Ready(LiveMapper):
    """A mapper without compilation: messages after its start are mapped."""

    def start(self, continued=None):
        ended = super().start(continued)
        wait_until(lambda: self.status().state != "compiling")
        return ended


def live(config, view=None):
    return Ready(config, view or LiveView(), lambda _: None)


@pytest.fixture(scope="module")
def room():
    return [m for m in perfect(load_world("room")) if isinstance(m, LaserScan | WheelAngles)]


def hand(mapper, messages):
    """Put messages no faster than they are taken."""
    for message in messages:
        mapper.put(message)
        if isinstance(message, LaserScan):
            wait_until(lambda: mapper.status().waiting == 0)


def drain(mapper):
    """Wait until the estimator has processed all messages."""
    mapping = mapper._mapping
    wait_until(lambda: mapping._inbox.empty)
    with mapping._next_turn, mapping._busy:
        pass
    time.sleep(0.01)  # it may have been between the two


def scans(messages):
    return [m for m in messages if isinstance(m, LaserScan)]


# --------------------------------------------------------------------------- the inbox


def test_the_inbox_keeps_all_motion_and_the_newest_scans():
    inbox = Inbox(scans=2)
    for i in range(10):
        inbox.put(WheelAngles(i, 0.0, 0.0), i, False)
        inbox.put(DeviceTime(i, "scan", 0.0), i, True)
    assert (inbox.waiting, inbox.dropped) == (2, 8)
    taken = []
    while not inbox.empty:
        taken.append(inbox.take(0.0))
    assert [m.stamp for m, _ in taken if isinstance(m, WheelAngles)] == list(range(10))
    assert [(m.stamp, at) for m, at in taken if isinstance(m, DeviceTime)] == [(8, 8), (9, 9)]
    assert [at for _, at in taken] == sorted(at for _, at in taken)
    assert inbox.waiting == 0


def test_wake_ends_waiting_at_the_inbox():
    inbox, got = Inbox(), []
    thread = threading.Thread(target=lambda: got.append(inbox.take()))
    thread.start()
    inbox.wake()
    thread.join(5.0)
    assert got == [None]
    assert inbox.take(0.01) is None


# --------------------------------------------------------------------------- the map


def test_a_live_map_is_that_of_the_log(room, tmp_path):
    config = load("imp")
    log, saved = tmp_path / "log", tmp_path / "live"
    of_log = map_log(config, Played.of(room, tmp_path), [Recorder(log)])
    view = LiveView()
    mapper = live(config, view)
    mapper.start()
    hand(mapper, room)
    drain(mapper)
    assert mapper.save(saved) == saved
    assert mapper.status().state == "running"
    mapper.stop()
    same = {
        "trajectory.tum",
        "trajectory.live.tum",
        "trajectory.csv",
        "odometry.tum",
        "landmarks.csv",
        "map.pgm",
    }
    for name in same | {"map.yaml", "config.toml", "report.png"}:
        assert (saved / name).read_bytes() == (log / name).read_bytes(), name
    assert {p.name for p in saved.iterdir()} == {p.name for p in log.iterdir()}
    facts, known = (json.loads((f / "summary.json").read_text()) for f in (saved, log))
    for key in ("counts", "landmarks", "path_length_m", "state_size", "config_sha256", "dropped"):
        assert facts[key] == known[key]
    shown = view.snapshot()
    assert shown.scans == len(of_log.stamps)
    known_ids = {mark.id for mark in of_log.landmarks}
    assert len(known_ids & {mark.id for mark in shown.landmarks}) > 4  # it may be 0.2 s older


def test_a_map_is_saved_while_scans_come(room, tmp_path):
    """Every saved path is the beginning of the last one, and mapping continues meanwhile."""
    mapper = live(load("imp"))
    with pytest.raises(ImpError, match="no map to save"):
        mapper.save(tmp_path / "early")
    mapper.start()
    hand(mapper, room[:200])
    wait_until(lambda: mapper.status().steps > 3)
    thread = threading.Thread(target=hand, args=(mapper, room[200:]))
    thread.start()
    saved = [mapper.save(tmp_path / str(i)) for i in range(2)]
    thread.join(60.0)
    wait_until(lambda: mapper.status().steps >= len(scans(room)) - 1)
    mapper.stop()
    saved.append(mapper.save(tmp_path / "stopped"))
    paths = [(folder / "trajectory.tum").read_text() for folder in saved]
    assert paths[2].startswith(paths[0])
    assert paths[2].startswith(paths[1])
    assert len(paths[0]) <= len(paths[1]) <= len(paths[2])
    assert len(paths[2].splitlines()) == mapper.status().steps
    for folder in saved:
        rows = (folder / "trajectory.csv").read_text().splitlines()
        assert len(rows) == 1 + json.loads((folder / "summary.json").read_text())["counts"]["steps"]


def test_a_map_with_loops_is_saved_as_at_the_end_of_a_log(tmp_path):
    drive = [m for m in ring() if isinstance(m, LaserScan | WheelAngles)]
    map_log(GRAPH, Played.of(drive, tmp_path), [Recorder(tmp_path / "log")])
    mapper = live(GRAPH)
    mapper.start()
    hand(mapper, drive)
    drain(mapper)
    poses = mapper._mapping.run.keyframes().poses
    mapper.save(tmp_path / "live")
    mapper.save(tmp_path / "again")
    np.testing.assert_array_equal(mapper._mapping.run.keyframes().poses, poses)
    mapper.stop()
    names = ("trajectory.tum", "trajectory.live.tum", "landmarks.csv", "map.pgm", "graph.g2o")
    for name in names:
        expected = (tmp_path / "log" / name).read_bytes()
        assert (tmp_path / "live" / name).read_bytes() == expected, name
        assert (tmp_path / "again" / name).read_bytes() == expected, name
    assert (tmp_path / "log" / "graph.g2o").read_text().count("EDGE_SE2") > 20


def test_scans_do_not_wait_while_a_map_is_refined(tmp_path, monkeypatch):
    """The saved map is that at the time of the request, however long refining takes."""
    drive = [m for m in ring() if isinstance(m, LaserScan | WheelAngles)]
    refining, go = threading.Event(), threading.Event()
    refine = graph.Graph.refine

    def late(self):
        refining.set()
        assert go.wait(20.0)
        return refine(self)

    monkeypatch.setattr(graph.Graph, "refine", late)
    mapper = live(GRAPH)
    mapper.start()
    hand(mapper, drive[: len(drive) // 2])
    drain(mapper)
    before = mapper.status().steps
    saver = threading.Thread(target=mapper.save, args=(tmp_path / "half",))
    saver.start()
    assert refining.wait(10.0)
    hand(mapper, drive[len(drive) // 2 :])
    drain(mapper)
    assert mapper.status().steps > 1.5 * before
    go.set()
    saver.join(30.0)
    mapper.stop()
    assert len((tmp_path / "half" / "trajectory.tum").read_text().splitlines()) == before
    facts = json.loads((tmp_path / "half" / "summary.json").read_text())
    assert (facts["counts"]["steps"], facts["counts"]["loops closed"]) == (before, 0)
    assert facts["time"]["stages_ms"]["refine"]["mean"] > 0.0


def test_a_folder_that_cannot_be_created_is_a_one_line_error(room, tmp_path):
    mapper = live(load("imp"))
    mapper.start()
    hand(mapper, room[:300])
    wait_until(lambda: mapper.status().steps > 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(ImpError, match="cannot be created"):
        mapper.save(tmp_path / "file" / "map")
    mapper.stop()


def silence(snapshot):
    return int(re.search(r"(\d+) s", snapshot.why)[1])


def test_the_pose_is_dead_reckoned_while_the_lidar_is_silent(tmp_path):
    everything = list(perfect(load_world("room")))
    truth = {m.stamp: m.pose for m in everything if isinstance(m, TruePose)}
    messages = [m for m in everything if isinstance(m, LaserScan | WheelAngles)]
    third = len(messages) // 3
    blind = [m for m in messages[third : 2 * third] if isinstance(m, WheelAngles)]
    view = LiveView()
    mapper = live(load("imp"), view)
    mapper.start()
    hand(mapper, messages[:third])
    drain(mapper)
    before = view.snapshot()
    assert (before.state, before.why) == ("TRACKING", "")
    hand(mapper, blind)
    wait_until(lambda: view.snapshot().stamp >= blind[-1].stamp)
    shown = view.snapshot()
    seconds = silence(shown)
    assert shown.state == "DEGRADED"
    assert shown.why == f"lidar silent for {seconds} s; the pose is dead-reckoned"
    assert np.linalg.norm(shown.pose[:2] - before.pose[:2]) > 0.5
    assert np.abs(shown.pose - truth[shown.stamp])[:2].max() < 0.01
    assert np.trace(shown.covariance) > np.trace(before.covariance)
    assert (len(before.points) > 0, len(shown.points)) == (True, 0)
    assert (shown.scans, math.isnan(shown.arrived)) == (before.scans, True)
    wait_until(lambda: silence(view.snapshot()) > seconds)  # also without odometry
    hand(mapper, messages[2 * third :])
    drain(mapper)
    after = view.snapshot()
    assert (after.why, len(after.points) > 0) == ("", True)
    mapper.save(tmp_path / "live")
    mapper.stop()
    recorder = Recorder(tmp_path / "log")
    received = [*messages[:third], *blind, *messages[2 * third :]]
    map_log(load("imp"), Played.of(received, tmp_path), [recorder])
    paths = [(tmp_path / name / "trajectory.tum").read_text() for name in ("live", "log")]
    assert paths[0] == paths[1], "showing the pose changes nothing"


def test_a_new_map_begins_at_the_origin(room):
    view = LiveView()
    mapper = live(load("imp"), view)
    mapper.start()
    hand(mapper, room)
    wait_until(lambda: mapper.status().steps > 90)
    first = view.snapshot()
    mapper.start()
    wait_until(lambda: mapper.status().state == "running")
    assert mapper.status().steps == 0
    assert (view.snapshot().run, view.snapshot().landmarks) == (first.run + 1, ())
    hand(mapper, room[-150:])
    wait_until(lambda: mapper.status().steps > 0)
    assert np.abs(view.snapshot().pose).max() < 0.5 < np.abs(first.pose).max()
    mapper.stop()
    assert mapper.status().state == "off"
    steps = mapper.status().steps
    hand(mapper, room[:50])
    assert mapper.status().steps == steps


def test_messages_of_other_types_are_ignored(room):
    mapper = live(load("imp"))
    mapper.put(room[0])  # off: nothing happens
    mapper.start()
    others = (Climate(0.0, 20.0, 0.5), DeviceTime(0.0, "x", 1.0))
    for message in others * 1000:
        mapper.put(message)
    hand(mapper, room[:400])
    wait_until(lambda: mapper.status().steps > 3)
    assert {"WheelAngles", "LaserScan"} <= set(mapper._mapping.run.robot.counts)
    assert not {"Climate", "DeviceTime"} & set(mapper._mapping.run.robot.counts)
    mapper.stop()


# --------------------------------------------------------------------------- too slow


def test_a_slow_computer_drops_whole_scans_and_stays_near(room, caplog):
    """Each scan takes three sweeps: two of three are dropped, and the map stays current."""
    seconds, period = 0.15, 0.05
    view = LiveView()
    mapper = live(slow(seconds), view)
    mapper.start()
    behind, latency = [], []
    begin, count = time.monotonic(), 60
    with caplog.at_level(logging.WARNING, "impslam"):
        for i in range(count):
            stamp = i * period
            for k in range(5):
                mapper.put(WheelAngles(stamp + k * 0.01, (i * 5 + k) * 0.01, (i * 5 + k) * 0.01))
            mapper.put(LaserScan(stamp, np.zeros(4), np.ones(4), np.zeros(4)))
            time.sleep(max(0.0, begin + (i + 1) * period - time.monotonic()))
            status = mapper.status()
            assert status.waiting <= 3
            behind.append(status.behind)
            latency.append(status.latency)
        mapper.put(WheelAngles(count * period, count * 0.05, count * 0.05))
        drain(mapper)
        mapper.stop()
        mapper._mapping.thread.join()
    status = mapper.status()
    left = mapper._mapping.run.robot.pending
    assert status.steps + status.dropped_scans + left == count
    assert left <= 1
    assert 8 <= status.steps <= 35
    # It waits for three sweeps at most, and for the one at work and itself to be done.
    bound = 3 * period + 2 * seconds + 0.6  # and the delays of a busy computer; 2 s without drops
    assert np.nanmax(latency) < bound
    assert np.nanmax(behind) < bound + seconds + period
    counts = mapper._mapping.run.robot.counts
    assert counts["WheelAngles"] == 5 * count + 1
    travel_error = view.snapshot().odometry[0] - 0.0635 * view.snapshot().stamp
    assert abs(travel_error) < 1e-6  # the motion is complete despite dropped scans
    assert f"{status.dropped_scans} scans dropped" in status.detail
    reports = [r for r in caplog.records if "scans dropped" in r.message]
    assert len(reports) == 1  # of 40, within 10 s


def test_odometry_that_is_off_is_shown_and_logged_once(room, caplog, monkeypatch):
    monkeypatch.setattr(module.Run, "odometry_notice", "the track is 9 % wider than configured")
    mapper = live(load("imp"))
    with caplog.at_level(logging.WARNING, "impslam"):
        mapper.start()
        hand(mapper, room[:60])
        drain(mapper)
    assert mapper.status().detail == "the track is 9 % wider than configured"
    mapper.stop()
    assert len([r for r in caplog.records if "wider than configured" in r.message]) == 1


def test_the_map_begins_when_the_estimator_is_ready(room):
    """Earlier odometry does not make its origin uncertain."""
    compiled, view = threading.Event(), LiveView()
    mapper = LiveMapper(load("imp"), view, lambda _: compiled.wait(20.0))
    mapper.start()
    for i in range(400):  # a wheel's reading that trembles for four seconds
        mapper.put(WheelAngles(-4.0 + 0.01 * i, 0.01 * (i % 2), 0.0))
    mapper.put(scans(room)[0])
    status = mapper.status()
    assert (status.state, status.waiting, status.dropped_scans) == ("compiling", 0, 0)
    assert math.isnan(status.behind)
    compiled.set()
    wait_until(lambda: mapper.status().state == "running")
    for message in room[:30]:
        mapper.put(message)
    wait_until(lambda: mapper.status().steps > 0)
    assert math.sqrt(view.snapshot().covariance[2, 2]) < 1e-3
    mapper.stop()


def test_scans_are_mapped_when_the_encoders_are_lost(room, monkeypatch):
    """They are used in time with the motion so far: none waits for 25 others."""
    monkeypatch.setattr(module, "ODOMETRY_TIMEOUT", 0.05)
    mapper = live(load("imp"))
    mapper.start()
    middle = len(room) // 2
    hand(mapper, room[:middle])
    wait_until(lambda: mapper.status().steps > 20)
    before = mapper.status().steps
    sweep = scans(room[:middle])[-1]
    for i in range(10):
        mapper.put(replace(sweep, stamp=sweep.stamp + 0.1 * (i + 1)))
        wait_until(lambda before=before: mapper.status().steps > before, 2.0)
        before = mapper.status().steps
        assert mapper.status().latency < 0.5
    mapper.stop()


@pytest.mark.parametrize("wheels", [True, False])
def test_missing_odometry_is_reported(room, monkeypatch, wheels):
    monkeypatch.setattr(module, "ODOMETRY_TIMEOUT", 0.02)
    mapper = live(load("imp"))
    mapper.start()
    hand(mapper, room if wheels else scans(room)[:20])
    wait_until(lambda: mapper.status().steps >= module.MIN_SCANS_WITHOUT_ODOMETRY)
    assert mapper.status().state == "running"
    assert ("no WheelAngles has come" in mapper.status().detail) is not wheels
    mapper.stop()


# --------------------------------------------------------------------------- faults


def test_a_failing_estimator_is_a_one_line_error_and_can_be_restarted(room, caplog):
    view = LiveView()
    mapper = live(slow(fails_at=5), view)
    mapper.start()
    with caplog.at_level(logging.ERROR, "impslam"):
        for message in room:
            mapper.put(message)
            if mapper.status().state == "failed":
                break
            time.sleep(0.001)
        wait_until(lambda: mapper.status().state == "failed")
    status = mapper.status()
    assert status.detail.startswith("ZeroDivisionError: two lines;")
    wait_until(lambda: view.snapshot().finished)
    assert view.snapshot().why == "mapping has failed; the robot is not tracked"
    assert len([r for r in caplog.records if r.levelno >= logging.ERROR]) == 1
    mapper.put(room[0])
    mapper.stop()
    assert mapper.status().state == "failed"
    mapper.start()
    wait_until(lambda: mapper.status().state == "running")
    mapper.stop()


def test_a_flood_that_is_not_taken_fails_instead_of_filling_the_memory(monkeypatch):
    monkeypatch.setattr("impslam.platform.station.inbox.MAX_MESSAGES", 50)
    mapper = live(load("imp"))
    mapper.start()
    with mapper._mapping._busy:  # the estimator hangs
        for i in range(60):
            mapper.put(WheelAngles(0.01 * i, 0.0, 0.0))
        assert mapper.status().state == "failed"
        assert "start a new map" in mapper.status().detail
    mapper.stop()


def test_bad_messages_do_not_end_the_map(room):
    mapper = live(load("imp"))
    mapper.start()
    nothing = np.empty(0)
    for i, message in enumerate(room[:500]):
        if isinstance(message, LaserScan) and i % 2:
            spoiled = replace(message, angles=nothing, ranges=nothing, time_offsets=nothing)
        elif isinstance(message, WheelAngles) and i % 50 == 0:
            spoiled = replace(message, left=math.nan)
        else:
            spoiled = message
        hand(mapper, [spoiled])
    drain(mapper)
    status = mapper.status()
    left = mapper._mapping.run.robot.pending
    assert status.state == "running"
    assert status.refused > 0
    assert status.steps + status.refused + left == len(scans(room[:500]))
    mapper.stop()


def test_arrival_and_latency_are_reported(room):
    view = LiveView()
    mapper = live(load("imp"), view)
    mapper.start()
    given = now() - 5.0
    for message in room[:200]:
        mapper.put(message, given)
        if isinstance(message, LaserScan):
            wait_until(lambda: mapper.status().waiting == 0)
    wait_until(lambda: mapper.status().steps > 0)
    assert view.snapshot().arrived == given
    assert 5.0 <= mapper.status().latency < 30.0
    mapper.stop()


def test_the_estimator_is_compiled_in_a_subprocess(monkeypatch, tmp_path):
    calls = []
    monkeypatch.setattr(warm, "_done", set())
    monkeypatch.setattr(warm, "run_until_either_ends", calls.append)
    config = load("imp")
    warm.warm_up(config)
    warm.warm_up(config)
    assert len(calls) == 1
    assert calls[0][1:3] == ["-m", "impslam.platform.station.warm_up"]
    assert not Path(calls[0][3]).exists()
    warm.warm_up(load("default"))  # other odometry: the true path plays its part
    assert len(calls) == 2


def test_a_process_that_ends_before_its_parent_reports_no_error():
    """Its thread that waits for the end of the parent is then still reading."""
    code = f"import time; from {warm.__name__} import end_with_parent; end_with_parent(); time.sleep(0.3)"
    warm.run_until_either_ends([sys.executable, "-c", code])  # raises an error if it fails


def test_compiling_may_be_done_ahead(caplog):
    done = threading.Event()
    LiveMapper(load("imp"), LiveView(), lambda _: done.set()).warm_up()
    assert done.wait(10.0)

    def fail(_):
        raise OSError("no disk")

    with caplog.at_level(logging.WARNING, "impslam"):
        LiveMapper(load("imp"), LiveView(), fail).warm_up()
        wait_until(lambda: "no disk" in caplog.text)


def test_the_estimator_is_compiled_in_place_if_the_subprocess_fails(monkeypatch, caplog):
    def fail(*_, **__):
        raise OSError("no process")

    done = set()
    monkeypatch.setattr(warm, "_done", done)
    monkeypatch.setattr(warm.subprocess, "Popen", fail)
    with caplog.at_level(logging.WARNING, "impslam"):
        warm.warm_up(load("imp"))
    assert len(done) == 1
    assert "in place" in caplog.text


@pytest.mark.parametrize(("sent", "reports"), [(signal.SIGTERM, 0), (signal.SIGKILL, 1)])
def test_a_signal_that_ends_the_program_as_well_is_no_failure_to_compile(
    monkeypatch, caplog, sent, reports
):
    """A shell and systemd send it to all processes."""
    monkeypatch.setattr(warm, "rehearse", lambda *_: None)
    monkeypatch.setattr(warm, "_done", set())
    code = f"import os; os.kill(os.getpid(), {sent:d})"
    run = warm.run_until_either_ends
    monkeypatch.setattr(warm, "run_until_either_ends", lambda _: run([sys.executable, "-c", code]))
    warm.warm_up(load("imp"))
    assert len(caplog.records) == reports


def test_a_rehearsal_closes_loops_refines_and_locates_the_robot(monkeypatch):
    """Otherwise, the first loop closure, or the first search for the robot, would wait for the compiler."""
    made, sought = [], []

    class Kept(warm.Run):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            made.append(self)

    find_everywhere = global_search._search

    def search(*args):
        sought.append(len(made))
        return find_everywhere(*args)

    monkeypatch.setattr(warm, "Run", Kept)
    monkeypatch.setattr(global_search, "_search", search)
    warm.rehearse(load("imp", ["tracker.kind=scan_to_map", "estimator.kind=graph"]))
    assert made[0].estimator.counts()["loops closed"] > 0
    assert "refine" in made[0].clock.stages
    assert 2 in sought
