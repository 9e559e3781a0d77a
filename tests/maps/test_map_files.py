"""Maps and landmark tables come back as they were written."""

import numpy as np
import pytest

from impslam.errors import ImpError
from impslam.imported_map import read_grid
from impslam.maps.files import (
    FREE,
    FREE_BELOW,
    OCCUPIED,
    OCCUPIED_ABOVE,
    UNKNOWN,
    MapImage,
    map_image,
    write_map,
)
from impslam.maps.grid import OccupancyGrid
from impslam.maps.landmark_table import COLUMNS, read_landmarks, write_landmarks
from impslam.types import Landmark


def test_a_map_comes_back(tmp_path, rng):
    pixels = rng.choice(np.array([FREE, UNKNOWN, OCCUPIED], np.uint8), (7, 11))
    image = MapImage(pixels, 0.05, np.array([-1.25, 3.4]))
    write_map(tmp_path, image)
    back = read_grid(tmp_path / "map.yaml")
    cells = np.array([FREE, UNKNOWN, OCCUPIED])[back.cells[::-1]]
    np.testing.assert_array_equal(cells, pixels)
    np.testing.assert_allclose(back.origin, [-1.25, 3.4, 0.0])
    assert back.resolution == 0.05
    assert image.extent == pytest.approx((-1.25, -0.7, 3.4, 3.75))


def test_pixels_that_look_like_white_space_come_back(tmp_path):
    pixels = np.full((2, 3), 10, np.uint8)
    write_map(tmp_path, MapImage(pixels, 0.05, np.zeros(2)))
    assert (tmp_path / "map.pgm").read_bytes().endswith(b"255\n" + pixels.tobytes())
    assert read_grid(tmp_path / "map.yaml").cells.shape == (2, 3)


def test_greys_reload_as_what_they_mean():
    p = (255 - np.array([FREE, UNKNOWN, OCCUPIED])) / 255
    assert p[0] < FREE_BELOW <= p[1] <= OCCUPIED_ABOVE < p[2]


def test_row_zero_is_the_top_and_the_origin_the_lower_left_corner():
    grid = OccupancyGrid(1.0)
    grid.logodds = np.zeros((4, 5), np.float32)
    grid.logodds[1, 2], grid.logodds[2, 3] = 3.0, -3.0
    grid.corner = np.array([-10, 20])
    image = map_image(grid)
    np.testing.assert_array_equal(image.pixels, [[UNKNOWN, FREE], [OCCUPIED, UNKNOWN]])
    np.testing.assert_allclose(image.origin, [-8.0, 21.0])


def test_an_empty_grid_is_one_unknown_cell(tmp_path):
    write_map(tmp_path, map_image(OccupancyGrid()))
    assert (tmp_path / "map.pgm").read_bytes() == b"P5\n1 1\n255\n%c" % UNKNOWN


def landmarks():
    cov = np.array([[1e-4, -2e-5], [-2e-5, 3e-4]])
    ends = np.array([[1.0, 2.0], [3.0, 4.0]])
    wall = {"r": 1.5, "alpha": -0.5}
    return [
        Landmark(3, "cylinder", np.array([1.0, -2.0]), {"radius": 0.15}, cov, None, 7, 1.5, 99.25),
        Landmark(4, "wall", np.array([0.0, 1.5]), wall, 2 * cov, ends, 9, 2.0, 3.0),
        Landmark(5, "door", np.array([0.0, 1.5]), {"width": 0.9}, cov, None, 1, 2.0, 2.0),
    ]


def test_landmarks_come_back(tmp_path):
    path = tmp_path / "landmarks.csv"
    write_landmarks(path, landmarks())
    header = path.read_text().splitlines()[0].split(",")
    assert header == [*COLUMNS, "width"]
    for mark, back in zip(landmarks(), read_landmarks(path), strict=True):
        assert (back.id, back.kind, back.observations) == (mark.id, mark.kind, mark.observations)
        assert (back.first_stamp, back.last_stamp) == (mark.first_stamp, mark.last_stamp)
        assert back.parameters == mark.parameters
        np.testing.assert_allclose(back.position, mark.position)
        np.testing.assert_allclose(back.covariance, mark.covariance)
        if mark.end_points is None:
            assert back.end_points is None
        else:
            np.testing.assert_allclose(back.end_points, mark.end_points)


def test_no_landmarks_are_a_header(tmp_path):
    write_landmarks(tmp_path / "landmarks.csv", [])
    assert (tmp_path / "landmarks.csv").read_text() == ",".join(COLUMNS) + "\n"
    assert read_landmarks(tmp_path / "landmarks.csv") == []


def test_a_bad_row_says_where(tmp_path):
    path = tmp_path / "landmarks.csv"
    write_landmarks(path, landmarks())
    path.write_text(path.read_text().replace("cylinder,1.0", "cylinder,one"))
    with pytest.raises(ImpError, match="line 2: not a landmark"):
        read_landmarks(path)
    with pytest.raises(ImpError, match="cannot be read"):
        read_landmarks(tmp_path / "none.csv")
