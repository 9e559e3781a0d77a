"""Corners of a printed board in pictures: a chessboard, or one with markers (ChArUco)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import cv2
import numpy as np

from impslam.overhead.calibration import BoardView
from impslam.overhead.setup import Board, dictionary

MIN_CORNERS = 8  # of a ChArUco board in a view


def find_boards(pictures: Iterable[Any], board: Board) -> list[BoardView]:
    """Return the views of a board in the pictures that show it."""
    find = _charuco(board) if board.kind == "charuco" else _chessboard(board)
    views = (find(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)) for picture in pictures)
    return [view for view in views if view is not None]


def _chessboard(board: Board) -> Callable[[Any], BoardView | None]:
    """Return a function that finds the inner corners of a chessboard, all or none."""
    size = (board.columns - 1, board.rows - 1)
    across, down = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    points = np.column_stack([across.ravel(), down.ravel(), np.zeros(across.size)])
    points = points.astype(np.float64) * board.square

    def find(grey: Any) -> BoardView | None:
        good, corners = cv2.findChessboardCornersSB(grey, size)
        return BoardView(points, corners.reshape(-1, 2).astype(np.float64)) if good else None

    return find


def _charuco(board: Board) -> Callable[[Any], BoardView | None]:
    """Return a function that finds the visible corners of a ChArUco board."""
    printed = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square,
        board.ratio * board.square,
        dictionary(board.dictionary),
    )
    detector = cv2.aruco.CharucoDetector(printed)
    points = np.asarray(printed.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

    def find(grey: Any) -> BoardView | None:
        corners, numbers, *_ = detector.detectBoard(grey)
        if numbers is None or len(numbers) < MIN_CORNERS:
            return None
        return BoardView(points[np.ravel(numbers)], corners.reshape(-1, 2).astype(np.float64))

    return find
