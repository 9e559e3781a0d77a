import numpy as np
import pytest
from tests.numeric import jacobian
from tests.overhead.scenes import PIXEL, SIZE_PX, SURVEY, calibrated, true_camera

from impslam.errors import ImpError
from impslam.overhead.calibration import BoardView, calibrate
from impslam.overhead.camera import linearised, project


def test_projection_and_on_plane_are_inverse() -> None:
    camera, rng = true_camera(), np.random.default_rng(0)
    pixels = rng.uniform((0, 0), SIZE_PX, (200, 2))
    for height in (0.0, 0.2, 1.5):
        laid = np.column_stack([camera.on_plane(pixels, height), np.full(200, height)])
        np.testing.assert_allclose(camera.project(laid), pixels, atol=1e-6)
    np.testing.assert_allclose(camera.centre, [1.0, 0.5, 5.0], atol=1e-12)


def test_derivatives_of_projection() -> None:
    camera, points = true_camera(), np.array([[0.3, -0.2, 0.0], [2.0, 1.4, 0.7]])
    found = jacobian(lambda vector: project(vector, points).ravel(), camera.vector, 1e-5)
    np.testing.assert_allclose(linearised(camera.vector, points)[1], found, rtol=1e-4, atol=1e-3)


def test_without_noise_the_camera_is_found_exactly() -> None:
    found = calibrated(np.random.default_rng(1), noise=0.0).camera
    pixels = np.array([[10.0, 10.0], [640.0, 360.0], [1270.0, 700.0]])
    for height in (0.0, 0.3):
        laid = found.on_plane(pixels, height)
        np.testing.assert_allclose(laid, true_camera().on_plane(pixels, height), atol=2e-4)


def test_covariance_includes_the_lens_if_only_points_are_given() -> None:
    rng = np.random.default_rng(2)
    with_board, without = calibrated(rng), calibrated(rng, boards=0)
    assert np.isnan(without.board_rms)
    assert without.camera.covariance[6, 6] > 100 * with_board.camera.covariance[6, 6]
    error = without.camera.vector[6] - true_camera().vector[6]
    assert abs(error) < 3 * np.sqrt(without.camera.covariance[6, 6])


def test_points_on_a_line_or_too_few_are_rejected() -> None:
    line = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    seen = true_camera().project(line)
    for number, told in ((3, "at least 4"), (5, "spread them out")):
        view = BoardView(line[:number], seen[:number])
        with pytest.raises(ImpError, match=told):
            calibrate(SIZE_PX, [], view, SURVEY, np.full(number, PIXEL))


# Without a board, a lens fits even most of an error of 5 cm; its covariance is large.
@pytest.mark.parametrize(
    ("boards", "shift", "numbers"), [(3, 0.05, range(7)), (0, 0.5, [0, 1, 2, 5, 6])]
)
def test_a_wrong_point_is_noticed_and_correct_ones_never(boards, shift, numbers) -> None:
    for seed in range(20):
        assert calibrated(np.random.default_rng(seed), boards=boards).odd_point is None
    for number in numbers:
        wrong = number, np.array([shift, 0.0, 0.0])
        found = calibrated(np.random.default_rng(number), boards=boards, wrong=wrong)
        assert found.odd_point is not None


def test_the_point_that_deviates_most_is_the_wrong_one() -> None:
    found = calibrated(np.random.default_rng(1), wrong=(1, np.array([0.3, 0.0, 0.0]))).odd_point
    assert found is not None
    assert abs(found[0] - true_camera().on_plane(np.array([[640.0, 30.0]]), 0.0)[0, 0] - 0.3) < 0.01
