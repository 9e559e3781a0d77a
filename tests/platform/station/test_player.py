"""Replay: the pace of the stamps, pause and step, and the same files as without."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from pydantic import PrivateAttr
from tests.recorded import Played, perfect
from tests.waiting import wait_until

from impslam.config import load
from impslam.errors import ImpError, QuitError, SourceError
from impslam.health import NO_FAULT
from impslam.observers.base import Observer
from impslam.observers.live_view import LiveView
from impslam.observers.recorder import Recorder
from impslam.open_log import open_log
from impslam.platform.station import player as module
from impslam.platform.station.pace import Pace
from impslam.platform.station.player import Player, play_live
from impslam.run import map_log
from impslam.simulation.world import load_world
from impslam.types import LaserScan

INF = math.inf


@pytest.fixture(scope="module")
def room():
    return perfect(load_world("room"))


class Moments(Observer):
    """Records the time of each result."""

    def __init__(self):
        self.stamps, self.moments, self.outcome = [], [], None

    def follow(self, track, path):
        self.stamps += path.stamps.tolist()
        self.moments += [time.monotonic()] * len(path.stamps)

    def revise(self, keyframe, revision, path):
        self.follow(None, path)

    def finish(self, known, outcome):
        self.outcome = outcome


def player(messages, tmp_path, observers=(), view=None):
    source = Played.of(messages, tmp_path)
    return Player(load("imp"), source, observers, view or LiveView(), lambda _: None)


def carmen(kind, stamp, metres):
    """Return a line of a CARMEN log: 181 equal ranges at the origin."""
    return f"{kind} 181 {f'{metres:.2f} ' * 181}0 0 0 0 0 0 {stamp:.2f} host {stamp:.2f}\n"


def scans(messages):
    return [m for m in messages if isinstance(m, LaserScan)]


def shifted(messages, by, begin, end=math.inf):
    """Return messages with the stamps of those from begin to end moved by some seconds."""
    first = messages[0].stamp
    return [
        replace(m, stamp=m.stamp + by) if begin <= m.stamp - first < end else m for m in messages
    ]


# --------------------------------------------------------------------------- the same run


def test_a_replay_writes_the_folder_of_a_run(room, tmp_path):
    config = load("imp")
    one, other = tmp_path / "one", tmp_path / "other"
    known = map_log(config, Played.of(room, tmp_path), [Recorder(one)])
    view = LiveView()
    playing = player(room, tmp_path, [Recorder(other)], view)
    assert playing.status().state == "ready"
    playing.set_speed(INF)
    playing.start()
    assert playing.wait(60.0).about == known.about
    different = {"summary.json", "report.html"}  # times
    assert {p.name for p in one.iterdir()} == {p.name for p in other.iterdir()}
    for path in one.iterdir():
        if path.name not in different:
            assert path.read_bytes() == (other / path.name).read_bytes(), path.name
    status, shown = playing.status(), view.snapshot()
    assert (status.state, status.detail) == ("ended", "")
    assert status.steps == shown.scans == len(scans(room))
    assert status.stamp == shown.stamp == scans(room)[-1].stamp
    assert status.seconds == pytest.approx(status.stamp - scans(room)[0].stamp)
    assert shown.finished
    assert len(shown.landmarks) == len(known.landmarks)
    assert shown.truth is not None


def test_play_live_starts_at_once(room, tmp_path, monkeypatch):
    monkeypatch.setattr(module.Player.__init__, "__defaults__", (lambda _: None, NO_FAULT))
    playing = play_live(load("imp"), Played.of(room, tmp_path), [], LiveView())
    wait_until(lambda: playing.status().steps > 0)
    playing.stop()
    assert playing.status().state == "stopped"


# --------------------------------------------------------------------------- pace


def test_a_paused_replay_is_not_shown_as_paused_while_it_seeks():
    pace = Pace()
    pace.pause()
    assert pace.paused
    pace.set_unpaced(True)
    assert not pace.paused
    pace.set_unpaced(False)
    assert pace.paused


@pytest.mark.realtime
@pytest.mark.parametrize(("speed", "steps"), [(1.0, 12), (8.0, 80)])
def test_scans_come_at_the_pace_of_their_stamps(room, tmp_path, speed, steps):
    kept = Moments()
    playing = player(room, tmp_path, [kept])
    playing.set_speed(speed)
    playing.start()
    wait_until(lambda: playing.status().steps >= steps)
    playing.stop()
    elapsed = np.array(kept.moments) - kept.moments[0]
    due = (np.array(kept.stamps) - kept.stamps[0]) / speed
    lag = elapsed - due
    assert lag.min() > -0.3  # never early, but for when the first was late
    assert elapsed[-1] > 0.8 * due[-1]
    # Not asked at 8 times: a scan is due each 12.5 ms, and a slow computer needs longer to map one.
    assert np.median(lag) < 0.3 or speed > 1.0


def test_a_changed_speed_counts_from_now(room, tmp_path):
    playing = player(room, tmp_path)
    playing.set_speed(0.1)
    playing.start()
    wait_until(lambda: playing.status().steps >= 1)
    begin = time.monotonic()
    playing.set_speed(100.0)  # the scan that was due in a second is due at once
    wait_until(lambda: playing.status().steps >= 50, 5.0)
    assert time.monotonic() - begin < 4.0
    playing.set_speed(0.1)  # and no step is due
    steps = playing.status().steps
    time.sleep(0.3)
    assert playing.status().steps <= steps + 2
    playing.stop()


@pytest.mark.parametrize("speed", [0.0, -1.0, 0.05, 101.0, math.nan, -INF])
def test_an_invalid_speed_is_refused(room, tmp_path, speed):
    playing = player(room, tmp_path)
    with pytest.raises(ImpError, match="is invalid"):
        playing.set_speed(speed)
    assert playing.status().speed == 1.0


def test_a_computer_that_is_too_slow_does_not_catch_up_in_a_rush():
    """At 100 times, each scan takes ten times too long; back at 1, the next one is not overdue."""
    pace = Pace()
    pace.set_speed(100.0)
    for i in range(10):
        assert pace.wait(0.1 * i) == "go"
        time.sleep(0.01)
    pace.set_speed(1.0)
    begin = time.monotonic()
    assert pace.wait(1.0) == "go"
    assert 0.08 < time.monotonic() - begin < 1.0


def test_a_late_scan_is_caught_up_with():
    """An occasional delay does not delay all later scans: 0.35 s, not 0.47."""

    def play():
        pace, begin = Pace(), None
        for i in range(8):
            pace.wait(0.05 * i)
            begin = time.monotonic() if begin is None else begin
            time.sleep(0.09 if i in {1, 3, 5} else 0.0)
        return time.monotonic() - begin

    taken = min(play() for _ in range(5))  # a busy machine may sleep longer
    assert 0.34 < taken < 0.43


# --------------------------------------------------------------------------- halt and step


class Counted(Played):
    """A source with a known total, which counts the messages read."""

    _read: int = PrivateAttr(default=0)
    total = property(lambda self: len(self._list))
    position = property(lambda self: self._read)

    def _messages(self):
        for self._read, located in enumerate(super()._messages()):
            yield located


def test_a_replay_reads_the_same_lidar_as_a_run(tmp_path):
    """The first scan of the log is not of the lidar that is read by default."""
    log = tmp_path / "two.log"
    lines = [
        carmen(kind, 0.2 * k, m) for k in range(20) for kind, m in (("RLASER", 2), ("FLASER", 3))
    ]
    log.write_text("".join(lines))
    both = ['source.wanted=["RLASER"]']
    known = map_log(*open_log(log, None, both))
    config, source = open_log(log, None, both)
    playing = Player(config, source, (), LiveView(), lambda _: None)
    playing.set_speed(INF)
    playing.start()
    replayed = playing.wait(20.0)
    np.testing.assert_array_equal(replayed.keyframes.points, known.keyframes.points)
    assert np.linalg.norm(known.keyframes.points[0]) == pytest.approx(3.0)


def test_seeking_plays_unpaced_and_pauses_at_the_target(room, tmp_path):
    playing = Player(load("imp"), Counted.of(room, tmp_path), (), LiveView(), lambda _: None)
    with pytest.raises(ImpError, match="not known yet"):
        playing.seek(0.5)
    playing.set_speed(0.1)
    playing.start()
    wait_until(lambda: playing.status().steps > 0)
    playing.pause()
    playing.seek(0.5)

    def share():
        status = playing.status()
        return status.position / status.total

    wait_until(lambda: share() >= 0.5)
    time.sleep(0.1)
    assert share() < 0.55
    assert playing.status().state == "paused"
    with pytest.raises(ImpError, match="cannot go back"):
        playing.seek(0.2)
    playing.seek(1.0)
    playing.resume()
    assert len(playing.wait(20.0).path()) > 50


def test_seeking_while_compiling_asks_to_wait(room, tmp_path):
    compiled = threading.Event()
    source = Played.of(room, tmp_path)
    playing = Player(load("imp"), source, (), LiveView(), lambda _: compiled.wait(10.0))
    playing.start()
    with pytest.raises(ImpError, match="not known yet; wait until it plays"):
        playing.seek(0.5)
    playing.stop()
    compiled.set()


def test_a_pause_is_immediate_and_a_step_is_one_scan(room, tmp_path):
    view = LiveView()
    playing = player(room, tmp_path, view=view)
    playing.set_speed(INF)
    playing.pause()
    playing.start()
    wait_until(lambda: playing.status().state == "paused")
    time.sleep(0.05)
    assert playing.status().steps == 0
    for wanted in range(1, 30):
        playing.step()
        wait_until(lambda wanted=wanted: playing.status().steps == wanted)
    time.sleep(0.05)
    assert playing.status().steps == view.snapshot().scans == 29
    assert playing.status().state == "paused"
    playing.resume()
    wait_until(lambda: playing.status().steps > 40)
    assert playing.wait(60.0) is not None


def test_the_newest_map_is_shown_while_paused(room, tmp_path):
    view = LiveView()
    playing = player(room, tmp_path, view=view)
    playing.set_speed(INF)
    playing.start()
    wait_until(lambda: playing.status().steps > 60)
    playing.pause()
    estimator = playing._run.estimator

    def seen(landmarks):
        return {mark.id: mark.observations for mark in landmarks}

    wait_until(lambda: seen(view.snapshot().landmarks) == seen(estimator.landmarks()), 5.0)
    assert max(seen(view.snapshot().landmarks).values()) > 5
    playing.stop()


@pytest.mark.parametrize("speed", [0.1, 1.0, INF])
def test_pausing_takes_less_than_a_tenth_of_a_second(room, tmp_path, speed):
    playing = player(room, tmp_path)
    playing.set_speed(speed)
    playing.start()
    wait_until(lambda: playing.status().steps >= 1)
    playing.pause()
    time.sleep(0.1)
    steps = playing.status().steps
    time.sleep(0.15)
    assert playing.status().steps == steps < len(scans(room))
    begin = time.monotonic()
    playing.stop()
    assert time.monotonic() - begin < 1.0
    assert playing.status().state == "stopped"


def test_a_paused_replay_uses_no_cpu_time(room, tmp_path):
    playing = player(room, tmp_path)
    playing.start()
    wait_until(lambda: playing.status().steps >= 2)
    playing.pause()
    time.sleep(0.1)
    begin = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - begin < 0.1
    playing.stop()


def test_a_stopped_replay_finishes_its_observers(room, tmp_path):
    kept = Moments()
    playing = player(room, tmp_path, [kept])
    playing.start()
    wait_until(lambda: playing.status().steps >= 2)
    playing.stop()
    with pytest.raises(QuitError, match="stopped before the end"):
        playing.wait(5.0)
    assert f"the first {len(kept.stamps)} scans" in kept.outcome.partial


# --------------------------------------------------------------------------- odd logs


def test_a_gap_is_skipped_at_once_and_reported(room, tmp_path):
    playing = player(shifted(room, 3600.0, 1.0), tmp_path)
    playing.set_speed(20.0)
    playing.start()
    assert playing.wait(30.0) is not None
    status = playing.status()
    assert status.skipped == pytest.approx(3600.0, abs=0.2)
    assert "skipped 3600.1 s" in status.detail
    assert status.seconds == pytest.approx(10.0, abs=0.3)


def test_stamps_that_jump_back_do_not_hang_it(room, tmp_path):
    playing = player(shifted(room, -500.0, 5.0), tmp_path)
    playing.set_speed(20.0)
    playing.start()
    assert playing.wait(30.0) is not None
    status = playing.status()
    assert status.steps == len(scans(room))
    assert "jump back" in status.detail
    assert status.stamp == scans(room)[-1].stamp - 500.0
    assert status.seconds == pytest.approx(10.0, abs=0.3)


def test_stamps_that_jitter_do_not_stretch_time():
    pace = Pace()
    pace.set_speed(INF)
    for i in range(100):
        pace.wait(0.1 * i - 0.15 * (i % 7 == 3))
    assert pace.place[1] == pytest.approx(9.9)


def test_stamps_that_are_nan_do_not_hang_it():
    pace = Pace()
    assert [pace.wait(stamp) for stamp in (1.0, math.nan, INF, 2.0)] == ["go"] * 4


def test_a_log_that_is_broken_fails_in_one_line(room, tmp_path):
    playing = player([m for m in room if not isinstance(m, LaserScan)], tmp_path)
    playing.start()
    with pytest.raises(SourceError, match="no usable scan"):
        playing.wait(20.0)
    status = playing.status()
    assert status.state == "failed"
    assert "no usable scan" in status.detail
    assert "\n" not in status.detail


def test_an_observer_that_fails_is_reported(room, tmp_path):
    class Broken(Observer):
        def revise(self, keyframe, revision, path):
            raise ValueError("two\nlines")

    playing = player(room, tmp_path, [Broken()])
    playing.start()
    with pytest.raises(ValueError, match="two"):
        playing.wait(20.0)
    assert playing.status().detail == "ValueError: two lines"


def test_calls_from_many_threads_leave_it_consistent(room, tmp_path):
    playing = player(room, tmp_path)
    playing.start()
    rng = np.random.default_rng(1)
    orders = [playing.pause, playing.resume, playing.step, lambda: playing.set_speed(INF)]
    choices = rng.integers(0, len(orders), (4, 200))
    threads = [
        threading.Thread(target=lambda row=row: [orders[k]() for k in row]) for row in choices
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    playing.set_speed(INF)
    playing.resume()
    assert len(playing.wait(60.0).stamps) == len(scans(room))


def test_stopping_waits_for_a_run_folder_that_is_being_written(room, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "STOP_TIMEOUT", 0.05)
    begun = threading.Event()

    class Slow(Observer):
        def finish(self, known, outcome):
            begun.set()
            time.sleep(0.5)

    replay = player(room, tmp_path, [Slow()])
    replay.set_speed(INF)
    replay.start()
    assert begun.wait(60.0)
    replay.stop()
    assert replay.wait(0.0) is not None
