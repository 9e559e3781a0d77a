"""A camera's settings of FFmpeg: for it alone, and nothing on stderr whatever was opened before."""

import os
import subprocess
import sys

import pytest

from impslam import ffmpeg

OPTIONS, LOG = "OPENCV_FFMPEG_CAPTURE_OPTIONS", "OPENCV_FFMPEG_LOGLEVEL"
BOTH = """
import sys
from pathlib import Path
import cv2
import numpy as np
from impslam.observers.video import _writer
from impslam.overhead.video import VideoFile
from impslam.platform.devices.base import DeviceError
from impslam.platform.devices.camera import Camera

path, rng = Path(sys.argv[1]), np.random.default_rng(0)
writer = _writer(path, (64, 48))
for _ in range(25):
    writer.write(rng.integers(0, 255, (48, 64, 3), np.uint8))
writer.release()
for _ in range(2):
    try:
        Camera(source="http://127.0.0.1:9/stream")._open()
    except DeviceError:
        with VideoFile(path) as video:
            print(sum(1 for _ in video))
"""


@pytest.mark.parametrize("own", [None, "rtsp_transport;tcp"])
def test_options_are_those_of_before_once_a_stream_is_open(own, monkeypatch):
    monkeypatch.delenv(OPTIONS, raising=False)
    if own is not None:
        monkeypatch.setenv(OPTIONS, own)
    with ffmpeg.without_delay():
        assert os.environ[OPTIONS] == (own or "fflags;nobuffer|flags;low_delay")
    assert os.environ.get(OPTIONS) == own


def test_a_users_own_log_level_wins(monkeypatch):
    monkeypatch.setenv(LOG, "32")
    ffmpeg.silence()
    assert os.environ[LOG] == "32"


def test_a_video_is_read_whole_and_silently_beside_a_camera(tmp_path):
    words = [sys.executable, "-c", BOTH, str(tmp_path / "run.mp4")]
    ended = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    assert ended.stdout.split() == ["25", "25"]
    assert ended.stderr == ""
