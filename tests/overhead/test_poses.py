import numpy as np
from tests.overhead.scenes import calibrated, true_camera

from impslam.evaluation.consistency import chi2_bounds, nees, pose_errors
from impslam.geometry.se2 import compose
from impslam.overhead.camera import CalibratedCamera
from impslam.overhead.poses import corners_in_base, find_poses

SIDE, HEIGHT, HEIGHT_SIGMA = 0.1, 0.2, 0.002
NOISE = 0.1  # px
MOUNT = np.array([0.03, -0.02, 0.4])
CORNERS = corners_in_base(SIDE, MOUNT)


def seen(camera: CalibratedCamera, poses: np.ndarray, height: float = HEIGHT) -> np.ndarray:
    """Corners (n, 4, 2) px of the marker of a robot at poses (n, 3)."""
    marks = [
        compose(np.tile(pose, (4, 1)), np.column_stack([CORNERS, np.zeros(4)])) for pose in poses
    ]
    points = np.array(marks)
    points[..., 2] = height
    return camera.project(points.reshape(-1, 3)).reshape(-1, 4, 2)


def poses(number: int, rng: np.random.Generator) -> np.ndarray:
    """Poses all over the floor, at every heading."""
    return rng.uniform((-0.7, -0.5, -np.pi), (2.7, 1.5, np.pi), (number, 3))


def test_without_noise_poses_are_exact_at_every_heading() -> None:
    true = poses(100, np.random.default_rng(0))
    found = find_poses(true_camera(), seen(true_camera(), true), CORNERS, HEIGHT, 0.0)
    np.testing.assert_allclose(pose_errors(found.poses, true), 0.0, atol=1e-9)


def test_the_height_of_the_marker_matters() -> None:
    true = poses(100, np.random.default_rng(0))
    wrong = find_poses(true_camera(), seen(true_camera(), true), CORNERS, 0.0, 0.0)
    assert np.hypot(*(wrong.poses - true)[:, :2].T).max() > 0.05


def test_covariance_is_consistent_with_noise_of_corners() -> None:
    rng, camera = np.random.default_rng(1), true_camera()
    true = poses(2000, rng)
    pixels = seen(camera, true)
    found = find_poses(
        camera, pixels + NOISE * rng.standard_normal(pixels.shape), CORNERS, HEIGHT, 0.0
    )
    assert abs(found.sigma / np.hypot(NOISE, 0.03) - 1.0) < 0.03
    expected = 3.0 * NOISE**2 / found.sigma**2  # `ALIASING` is not in these corners
    values = nees(pose_errors(found.poses, true), found.covariances)
    assert abs(values.mean() / expected - 1.0) < 0.05
    assert found.good.mean() > 0.999


def test_errors_of_calibration_and_height_are_in_the_covariance() -> None:
    values = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        true, height = poses(50, rng), HEIGHT + HEIGHT_SIGMA * rng.standard_normal()
        pixels = seen(true_camera(), true, height)
        pixels += NOISE * rng.standard_normal(pixels.shape)
        found = find_poses(calibrated(rng, boards=4).camera, pixels, CORNERS, HEIGHT, HEIGHT_SIGMA)
        values.append(nees(pose_errors(found.poses, true), found.covariances)[0])
    low, high = chi2_bounds(3, len(values), 0.999)
    assert low < np.mean(values) < high


def test_corners_that_fit_no_marker_are_not_good() -> None:
    rng = np.random.default_rng(2)
    pixels = seen(true_camera(), poses(50, rng))
    pixels += NOISE * rng.standard_normal(pixels.shape)
    pixels[7, 2] += 3.0  # a corner that somebody's foot is on
    found = find_poses(true_camera(), pixels, CORNERS, HEIGHT, 0.0)
    assert np.flatnonzero(~found.good).tolist() == [7]
