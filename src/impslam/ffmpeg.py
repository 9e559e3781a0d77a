"""Settings of the FFmpeg within OpenCV, which reads them from the environment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def silence() -> None:
    """Keep FFmpeg from writing on stderr; what goes wrong is told by our errors instead.

    OpenCV reads this once, where a process first opens a video: call it before each opening. A user's
    own setting wins.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@contextmanager
def without_delay() -> Iterator[None]:
    """Open streams so that FFmpeg does not look ahead for their format, and keeps no picture back.

    It is a second less of delay, but files then miss pictures. A user's own setting wins.
    """
    name = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
    if name in os.environ:
        yield
        return
    os.environ[name] = "fflags;nobuffer|flags;low_delay"
    try:
        yield
    finally:
        del os.environ[name]
