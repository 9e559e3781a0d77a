"""Frames in space, and the pose of a laser in the plane."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from impslam.errors import MessageError
from impslam.sources.transforms import FrameTransform, FrameTree, flattened, rigid

ANGLES = st.floats(-math.pi, math.pi)
LENGTHS = st.floats(-5.0, 5.0)


def pose(xyz=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)):
    return rigid(np.array(xyz, float), Rotation.from_euler("xyz", rpy).as_quat())


def tree(*links):
    found = FrameTree()
    for parent, child, T in links:
        assert found.add(FrameTransform(parent, child, T))
    return found


@given(ANGLES, ANGLES, ANGLES, LENGTHS, LENGTHS)
def test_a_transform_is_that_of_its_quaternion(roll, pitch, yaw, x, y):
    T = pose((x, y, 1.0), (roll, pitch, yaw))
    np.testing.assert_allclose(
        T[:3, :3], Rotation.from_euler("xyz", (roll, pitch, yaw)).as_matrix(), atol=1e-12
    )
    np.testing.assert_array_equal(T[:, 3], [x, y, 1.0, 1.0])


@pytest.mark.parametrize(
    ("shift", "turn", "said"),
    [
        ((0.0, 0.0, math.nan), (0.0, 0.0, 0.0, 1.0), "not finite"),
        ((0.0, 0.0, 0.0), (0.0, math.inf, 0.0, 1.0), "not finite"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), "length 0 instead of 1"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.6, 0.9), "length 1.08 instead of 1"),
    ],
)
def test_invalid_transforms_are_rejected(shift, turn, said):
    with pytest.raises(MessageError, match=said):
        rigid(np.array(shift), np.array(turn))


@given(LENGTHS, LENGTHS, ANGLES, st.booleans(), st.floats(-math.pi, math.pi))
def test_beams_of_a_flattened_laser_point_where_they_do_in_space(x, y, yaw, down, angle):
    T = pose((x, y, 0.3), (math.pi if down else 0.0, 0.0, yaw))
    planar = flattened(T)
    assert planar.upside_down == down
    assert planar.tilt < 1e-7
    end = (T @ [math.cos(angle), math.sin(angle), 0.0, 1.0])[:2]
    px, py, heading = planar.pose
    heading += -angle if down else angle
    np.testing.assert_allclose(end, [px + math.cos(heading), py + math.sin(heading)], atol=1e-8)


def test_tilt_of_upright_and_upside_down_lasers():
    for roll in (0.0, math.pi):
        assert flattened(pose(rpy=(roll, math.radians(30), 1.0))).tilt == pytest.approx(
            math.radians(30)
        )


def test_a_chain_leads_up_and_down_the_tree():
    a, b, c, d = (pose((k, 0.5, 0.1), (0.1 * k, 0.2, 0.3 * k)) for k in range(1, 5))
    known = tree(("top", "base", a), ("top", "mast", b), ("mast", "arm", c), ("arm", "laser", d))
    T, links = known.chain("base", "laser")
    np.testing.assert_allclose(T, np.linalg.inv(a) @ b @ c @ d, atol=1e-12)
    assert [link.child for link in links] == ["base", "laser", "arm", "mast"]
    back, _ = known.chain("laser", "base")
    np.testing.assert_allclose(T @ back, np.eye(4), atol=1e-12)
    same, links = known.chain("laser", "laser")
    np.testing.assert_array_equal(same, np.eye(4))
    assert not links


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_link_that_is_published_in_reverse_is_inverted(order):
    """A sensor carries no robot: where base has another parent, it is not the sensor."""
    T = pose((0.5, 0.2, 0.1), (0.1, 0.2, 0.3))
    ways = ("laser", "base", T), ("odom", "base", pose((3.0, 0.0, 0.0)))
    known = FrameTree({"laser"})
    assert all(known.add(FrameTransform(*ways[k])) for k in order)
    np.testing.assert_allclose(known.chain("base", "laser")[0], np.linalg.inv(T), atol=1e-12)
    assert [link.parent for link in known.up("laser")] == ["base", "odom"]
    assert known.add(FrameTransform("laser", "base", np.eye(4)))  # published again
    np.testing.assert_allclose(known.chain("base", "laser")[0], np.eye(4), atol=1e-12)


def test_missing_links_and_loops_are_errors():
    T = np.eye(4)
    known = tree(("odom", "base", T), ("mast", "laser", T), ("a", "b", T), ("b", "a", T))
    with pytest.raises(MessageError, match="laser leads up to mast, base to odom"):
        known.chain("base", "laser")
    with pytest.raises(MessageError, match="loop: a -> b -> a"):
        known.chain("base", "a")


def test_a_loop_above_base_does_not_matter():
    T = np.eye(4)
    known = tree(("odom", "base", T), ("base", "laser", T), ("map", "odom", T), ("odom", "map", T))
    assert len(known.chain("base", "laser")[1]) == 1


def test_the_first_of_two_parents_counts():
    known = tree(("base", "laser", pose((1.0, 0.0, 0.0))))
    assert not known.add(FrameTransform("mast", "laser", pose((2.0, 0.0, 0.0))))
    assert known.add(FrameTransform("base", "laser", pose((3.0, 0.0, 0.0))))
    assert known.chain("base", "laser")[0][0, 3] == 3.0
