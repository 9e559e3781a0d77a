"""Track a robot in a video: calibrate the camera, find the marker, solve for the poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from impslam.errors import ImpError
from impslam.overhead.boards import find_boards
from impslam.overhead.calibration import MIN_POINTS, BoardView, CameraCalibration, calibrate
from impslam.overhead.discs import MeasuredCylinder, find_cylinders
from impslam.overhead.markers import MarkerFinder, middle
from impslam.overhead.poses import Poses, corners_in_base, find_poses
from impslam.overhead.setup import MARKER_SIGMA, Setup
from impslam.overhead.video import VideoFile, read_pictures
from impslam.types import Array

MAX_VIEWS = 40  # of the board
STILLS = 15  # pictures whose median shows the scene without moving objects

Progress = Callable[[str, int, int], None]
"""Called with the name of a stage, the finished and the total number of its parts."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """The result of tracking a video.

    Attributes
    ----------
    stamps : (n,) s, of the pictures with a pose
    found : the poses in them
    hidden : (h,) s, stamps of pictures without the marker
    unfit : (u,) s, stamps of pictures with corners that fit no level marker, or with two markers
    calibration : of the camera
    unseen : numbers of markers on the floor that were not found
    cylinders : those with discs
    still : the scene without moving objects, (height, width, 3)
    """

    stamps: Array
    found: Poses
    hidden: Array
    unfit: Array
    calibration: CameraCalibration
    unseen: list[int]
    cylinders: list[MeasuredCylinder]
    still: Any


def track(path: Path, setup: Setup, beside: Path, progress: Progress) -> Tracked:
    """Track the robot in a video.

    Parameters
    ----------
    setup : measurements of the scene
    beside : folder to which paths in the setup are relative

    Raises
    ------
    ImpError
        If the video or the board cannot be read, the camera cannot be calibrated, or no picture shows the
        marker.
    """
    with VideoFile(path) as video:
        size = video.width, video.height
        boards = _boards(setup, size, beside, progress)
        stills = video.sample(STILLS)
        ground, sigma, unseen = _ground(stills, setup)
        calibration = calibrate(size, boards, ground, setup.floor.sigma, sigma)
        times, corners, hidden, doubled = _follow(video, setup, progress)
    if not len(times):
        raise ImpError(
            f"{path}: marker {setup.marker.id} of {setup.marker.dictionary} is in no picture; check "
            "marker.id and marker.dictionary, and that it is 16 pixels wide and has a white margin"
        )
    marker, camera = setup.marker, calibration.camera
    base = corners_in_base(marker.size, np.array(marker.mount))
    found = find_poses(camera, corners, base, marker.height, marker.height_sigma)
    unfit = np.sort(np.concatenate([times[~found.good], doubled]))
    still = np.median(np.stack(stills), axis=0).astype(np.uint8)
    cylinders = [] if setup.discs is None else find_cylinders(still, camera, setup.discs)
    kept, start = found.only(found.good), setup.start
    return Tracked(
        start + times[found.good], kept, start + hidden, start + unfit, calibration, unseen, cylinders,
        still,
    )  # fmt: skip


def _boards(
    setup: Setup, size: tuple[int, int], beside: Path, progress: Progress
) -> list[BoardView]:
    if setup.board is None:
        return []
    place = beside / setup.board.views
    pictures = read_pictures(place, MAX_VIEWS)
    progress("board", 0, len(pictures))
    views = []
    for number, picture in enumerate(pictures, 1):
        found = find_boards([picture], setup.board)
        height, width = picture.shape[:2]
        if found and (width, height) != size:
            raise ImpError(
                f"{place}: has pictures of {width} x {height} px, but the video has {size[0]} x {size[1]} "
                "px; take them with the settings of the video, as they change the lens"
            )
        views += found
        progress("board", number, len(pictures))
    if len(views) < 3:
        raise ImpError(
            f"{place}: the board of {setup.board.columns} x {setup.board.rows} squares is in "
            f"{len(views)} of {len(pictures)} pictures; at least 3 must show all of it"
        )
    return views


def _ground(stills: list[Any], setup: Setup) -> tuple[BoardView, Array, list[int]]:
    """Return the measured points, their noise (n,) px, and the markers that were not found."""
    floor, seen = setup.floor, _still_markers(stills, setup)
    points, pixels, sigmas, unseen = [], [], [], []
    for point in floor.points:
        if point.marker is not None and point.marker not in seen:
            unseen.append(point.marker)
            continue
        points.append((point.x, point.y, point.z))
        pixels.append(point.pixel if point.marker is None else seen[point.marker])
        sigmas.append(floor.pixel_sigma if point.marker is None else MARKER_SIGMA)
    if len(points) < MIN_POINTS:
        raise ImpError(
            f"floor.points: {len(points)} of {len(floor.points)} are found in the video, and {MIN_POINTS} "
            f"are needed; marker {', '.join(map(str, unseen))} of {setup.marker.dictionary} is not found"
        )
    view = BoardView(np.array(points, dtype=np.float64), np.array(pixels, dtype=np.float64))
    return view, np.array(sigmas), unseen


def _still_markers(stills: list[Any], setup: Setup) -> dict[int, Array]:
    """Return the median positions (2,) px of the middles of all markers."""
    finder = MarkerFinder(setup.marker.dictionary)
    pixels: dict[int, list[Array]] = {}
    for picture in stills:
        for number, corners in finder.all(picture):
            pixels.setdefault(number, []).append(middle(corners))
    return {number: np.median(found, axis=0) for number, found in pixels.items()}


def _follow(
    video: VideoFile, setup: Setup, progress: Progress
) -> tuple[Array, Array, Array, Array]:
    """Return times (n,) and corners (n, 4, 2) of the marker, times without it, and with two."""
    finder, last = MarkerFinder(setup.marker.dictionary), None
    times: list[float] = []
    corners: list[Array] = []
    hidden: list[float] = []
    doubled: list[float] = []
    progress("marker", 0, video.pictures)
    for number, (time, picture) in enumerate(video, 1):
        mine = finder.one(picture, setup.marker.id, last)
        last = mine[0] if len(mine) == 1 else None
        if last is not None:
            times.append(time)
            corners.append(last)
        else:
            (hidden if not mine else doubled).append(time)
        progress("marker", number, video.pictures)
    return np.array(times), np.array(corners).reshape(-1, 4, 2), np.array(hidden), np.array(doubled)
