"""Settings of OpenCV's FFmpeg, which are read from the environment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def silence() -> None:
    """Keep FFmpeg from writing to stderr; our errors report failures instead.

    OpenCV reads the setting once, when a process first opens a video, so call this before each opening. A
    user's own setting takes precedence.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@contextmanager
def without_delay() -> Iterator[None]:
    """Open streams so that FFmpeg neither probes ahead for their format nor buffers pictures.

    This saves a second of delay, but drops pictures of files. A user's own setting takes precedence.
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
