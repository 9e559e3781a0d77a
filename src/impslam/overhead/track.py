"""From a video to the robot's path: calibrate, follow the marker, solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from impslam.errors import ImpError
from impslam.overhead.boards import find_boards
from impslam.overhead.calibration import FEWEST, Calibration, View, calibrate
from impslam.overhead.discs import Cylinder, find_cylinders
from impslam.overhead.markers import MarkerFinder, middle
from impslam.overhead.poses import Poses, corners_in_base, find_poses
from impslam.overhead.setup import CORNER, Setup
from impslam.overhead.video import Video, pictures_of
from impslam.types import Array

VIEWS = 40  # of the board, at most
STILLS = 15  # pictures over whose median nothing moves

Progress = Callable[[str, int, int], None]
"""Is called with the name of a stage, how much of it is done, and how much there is."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What a video tells.

    Attributes
    ----------
    stamps : (n,) s, of the pictures with a pose
    found : the poses in them
    hidden : (h,) s, stamps of pictures without the marker
    unfit : (u,) s, stamps of pictures whose corners fit no marker that lies flat, or that show two
    calibration : of the camera
    unseen : numbers of markers on the floor that were not found
    cylinders : those with discs
    still : the scene without what moves, (height, width, 3)
    """

    stamps: Array
    found: Poses
    hidden: Array
    unfit: Array
    calibration: Calibration
    unseen: list[int]
    cylinders: list[Cylinder]
    still: Any


def track(path: Path, setup: Setup, beside: Path, progress: Progress) -> Tracked:
    """Return the path of the robot in a video.

    Parameters
    ----------
    setup : what was measured beforehand
    beside : folder that paths in the setup are relative to

    Raises
    ------
    ImpError
        If the video or the board cannot be read, the camera cannot be calibrated, or the marker is in
        no picture.
    """
    with Video(path) as video:
        boards = _boards(setup, beside, progress)
        stills = video.some(STILLS)
        ground, sigma, unseen = _ground(stills, setup)
        size = video.width, video.height
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


def _boards(setup: Setup, beside: Path, progress: Progress) -> list[View]:
    if setup.board is None:
        return []
    place = beside / setup.board.views
    pictures = pictures_of(place, VIEWS)
    progress("board", 0, len(pictures))
    views = []
    for number, picture in enumerate(pictures, 1):
        views += find_boards([picture], setup.board)
        progress("board", number, len(pictures))
    if len(views) < 3:
        raise ImpError(
            f"{place}: the board of {setup.board.columns} x {setup.board.rows} squares is in "
            f"{len(views)} of {len(pictures)} pictures; at least 3 must show all of it"
        )
    return views


def _ground(stills: list[Any], setup: Setup) -> tuple[View, Array, list[int]]:
    """Return the measured points, the noise (n,) px of each, and the markers that were not seen."""
    floor, seen = setup.floor, _seen(stills, setup)
    points, pixels, sigmas, unseen = [], [], [], []
    for point in floor.points:
        if point.marker is not None and point.marker not in seen:
            unseen.append(point.marker)
            continue
        points.append((point.x, point.y, point.z))
        pixels.append(point.pixel if point.marker is None else seen[point.marker])
        sigmas.append(floor.pixel_sigma if point.marker is None else CORNER)
    if len(points) < FEWEST:
        raise ImpError(
            f"floor.points: {len(points)} of {len(floor.points)} are seen in the video, and {FEWEST} "
            f"are needed; marker {', '.join(map(str, unseen))} of {setup.marker.dictionary} is not"
        )
    view = View(np.array(points, dtype=np.float64), np.array(pixels, dtype=np.float64))
    return view, np.array(sigmas), unseen


def _seen(stills: list[Any], setup: Setup) -> dict[int, Array]:
    """Return the middles (2,) px of the markers that lie still."""
    finder = MarkerFinder(setup.marker.dictionary)
    places: dict[int, list[Array]] = {}
    for picture in stills:
        for number, corners in finder.all(picture):
            places.setdefault(number, []).append(middle(corners))
    return {number: np.median(found, axis=0) for number, found in places.items()}


def _follow(video: Video, setup: Setup, progress: Progress) -> tuple[Array, Array, Array, Array]:
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
