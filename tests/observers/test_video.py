"""A run as a video: it plays, and shows what was known at the time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.observers import runs

from impslam.errors import ImpError
from impslam.health import UNPLACED, Health
from impslam.observers import video
from impslam.observers.canvas import colour
from impslam.observers.video import Video

SCANS = 50


def frames(path):
    played = cv2.VideoCapture(str(path))
    while True:
        read, picture = played.read()
        if not read:
            return
        yield picture


def near(picture, code):
    """Return how many pixels have about a colour: the codec changes them."""
    return int((np.abs(picture.astype(int) - colour(code)).max(axis=2) < 40).sum())


def made_up():
    known = runs.play([], SCANS)
    reasons = np.zeros(SCANS, np.int8)
    reasons[40:] = UNPLACED
    health = Health(known.stamps, reasons, np.zeros(SCANS))
    return known, runs.make_outcome(SCANS, health=health)


def test_the_video_plays_and_the_path_grows(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "RATE", 5.0)
    monkeypatch.setattr(video, "SIZE", 321)  # odd: codecs take even sizes alone
    shares = []
    Video(tmp_path / "run.mp4", shares.append).finish(*made_up())
    pictures = list(frames(tmp_path / "run.mp4"))
    assert len(pictures) == len(shares) == 25  # 4.9 s
    assert (shares[-1], shares == sorted(shares)) == (1.0, True)
    assert all(side % 2 == 0 for side in pictures[0].shape[:2])
    path = [near(picture, video.PATH) for picture in pictures]
    assert path[0] < 0.2 * path[-1]
    assert path[len(path) // 2] == pytest.approx(0.5 * path[-1], rel=0.3)
    lost = [near(picture[:40], video.STATE_COLOURS[2]) for picture in pictures]
    assert max(lost[: int(0.75 * len(lost))]) < 0.2 * lost[-1]


def test_a_wall_is_drawn_once_it_has_been_observed(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "RATE", 5.0)
    monkeypatch.setattr(video, "SIZE", 320)
    known, outcome = made_up()
    late = replace(runs.make_landmarks()[1], first_stamp=float(known.stamps[25]))
    Video(tmp_path / "run.mp4").finish(replace(known, landmarks=(late,)), outcome)
    walls = [near(picture, video.WALL) for picture in frames(tmp_path / "run.mp4")]
    assert max(walls[: int(0.45 * len(walls))]) == 0
    assert min(walls[int(0.55 * len(walls)) :]) > 100


def test_long_runs_take_no_longer_and_the_clock_never_runs_backwards():
    stamps = np.concatenate([np.arange(0.0, 500.0), [3.0], np.arange(500.0, 2000.0)])
    rows = video._rows(stamps, np.zeros(len(stamps), np.int64))
    assert len(rows) == video.MAX_SECONDS * video.RATE
    assert (np.diff(rows) >= 0).all()
    assert (rows[0], rows[-1]) == (0, len(stamps) - 1)
    assert len(video._rows(np.zeros(1), np.zeros(1, np.int64))) == 2


@pytest.mark.parametrize("begin", [0.0, 50.0, 86400.0])
def test_all_drives_of_a_continued_map_are_shown_whatever_their_clocks(begin):
    one = np.arange(0.0, 100.0, 0.1)
    rows = video._rows(np.concatenate([one, begin + one]), np.repeat([0, 1], len(one)))
    assert int(rows[-1]) == 2 * len(one) - 1
    assert np.sum(rows < len(one)) == pytest.approx(len(rows) / 2, abs=1)


def test_a_missing_folder_is_an_error(tmp_path):
    with pytest.raises(ImpError, match="cannot be written as a video"):
        Video(tmp_path / "none" / "run.mp4").finish(*made_up())
