"""A camera five metres up, with simulated calibration data and markers, without pictures."""

import cv2
import numpy as np

from impslam.overhead.calibration import BoardView, CameraCalibration, calibrate
from impslam.overhead.camera import LENS, SIZE, CalibratedCamera, project

SIZE_PX = (1280, 720)
CORNER, SURVEY, PIXEL = 0.1, 0.002, 0.2  # px, m, px


def true_camera() -> CalibratedCamera:
    """Looks down from 5 m, a little aslant."""
    turned = cv2.Rodrigues(np.array([0.05, -0.03, 0.0]))[0] @ np.diag([1.0, -1.0, -1.0])
    vector = np.zeros(SIZE)
    vector[:3] = cv2.Rodrigues(turned)[0].ravel()
    vector[3:6] = -turned @ np.array([1.0, 0.5, 5.0])
    vector[6:] = 1300, 1300, 640, 358, -0.12, 0.02, 0.0005, -0.0005, 0.0
    return CalibratedCamera(*SIZE_PX, vector, np.zeros((SIZE, SIZE)))


def calibrated(
    rng: np.random.Generator,
    noise: float = 1.0,
    boards: int = 9,
    wrong: tuple[int, np.ndarray] | None = None,
) -> CameraCalibration:
    """Calibrate the camera by boards and seven measured points; `wrong` shifts one of them, m."""
    true = true_camera()
    border = np.array(
        [[40, 40], [640, 30], [1240, 40], [1250, 360], [1240, 680], [640, 690], [40, 680]]
    )
    points = np.column_stack([true.on_plane(border.astype(float), 0.0), np.zeros(7)])
    pixels = true.project(points) + noise * PIXEL * rng.standard_normal((7, 2))
    points[:, :2] += noise * SURVEY * rng.standard_normal((7, 2))
    if wrong is not None:
        points[wrong[0]] += wrong[1]
    views = [board(true, k, noise, rng) for k in range(boards)]
    return calibrate(SIZE_PX, views, BoardView(points, pixels), SURVEY, np.full(7, PIXEL))


def board(true: CalibratedCamera, number: int, noise: float, rng: np.random.Generator) -> BoardView:
    """A board of 9 x 6 corners somewhere in the picture."""
    x, y = np.meshgrid(0.04 * (np.arange(9) - 4), 0.04 * (np.arange(6) - 2.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(54)])
    place = 0.6 * (np.array([number % 3, number // 3 % 3]) / 2 - 0.5) * SIZE_PX / 1300
    pose = np.array([*rng.uniform(-0.6, 0.6, 3), *place, 1.0])
    pixels = project(np.concatenate([pose, true.vector[LENS]]), points)
    return BoardView(points, pixels + noise * CORNER * rng.standard_normal(pixels.shape))
