"""Distances from the cells of a grid to the nearest marked one."""

from __future__ import annotations

from typing import Any

import numpy as np

from impslam.types import Mask


def distances(marked: Mask, cell: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return the distance in m from each cell of a mask (h, w) to the nearest marked one; inf without one.

    `cell` is the side of a cell in m.
    """
    import cv2  # noqa: PLC0415  slow to import

    if not marked.any():
        return np.full(marked.shape, np.inf, np.float32)
    unmarked = (~marked).astype(np.uint8)
    cells = cv2.distanceTransform(unmarked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(cells * np.float32(cell), np.float32)
