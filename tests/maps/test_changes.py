"""Two maps of a room in which things were moved."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.maps.drawn import mapped
from tests.recognition.plans import walls, way

from impslam.maps.changes import changes

ROOM = room(0.0, 8.0, 0.0, 6.0)
WALL = walls([3.0, 4.0, 5.0, 4.0])
POST, MOVED = np.array([[6.0, 4.5, 0.15]]), np.array([[2.0, 4.5, 0.15]])
HIDING = walls([0.0, 5.0, 8.0, 5.0])
DRIVE = np.concatenate([way(1.0, 1.0, 7.0, 1.5, 12), way(7.0, 2.0, 1.0, 2.0, 12)])


def drawn(plan, circles=None, seed=0, T=(0.0, 0.0, 0.0)):
    return mapped(plan, DRIVE, circles, seed=seed, T=T)


def test_nothing_changes_in_a_room_that_is_mapped_twice():
    found = changes(
        drawn(np.concatenate([ROOM, WALL])), drawn(np.concatenate([ROOM, WALL]), seed=1)
    )
    assert found == ((), ())


@pytest.mark.parametrize("error", [(0.08, -0.08, 0.0), (0.0, 0.0, 0.01)])
def test_no_changes_with_an_alignment_error_of_centimetres(error):
    plan = np.concatenate([ROOM, WALL])
    assert changes(drawn(plan), drawn(plan, seed=1, T=error)) == ((), ())


def test_a_wall_that_was_taken_away_is_gone():
    found = changes(drawn(np.concatenate([ROOM, WALL])), drawn(ROOM, seed=1))
    (gone,) = found.gone
    assert not found.new
    np.testing.assert_allclose(gone.position, [4.0, 4.0], atol=0.1)
    assert gone.length == pytest.approx(2.0, abs=0.2)
    assert np.abs(gone.cells[:, 1] - 4.0).max() < 0.1


def test_a_wall_that_was_built_is_new():
    found = changes(drawn(ROOM), drawn(np.concatenate([ROOM, WALL]), seed=1))
    (new,) = found.new
    assert not found.gone
    assert new.length == pytest.approx(2.0, abs=0.2)


def test_a_cylinder_that_was_moved_is_gone_and_new():
    found = changes(drawn(ROOM, POST), drawn(ROOM, MOVED, seed=1))
    (gone,), (new,) = found
    np.testing.assert_allclose(gone.position, [6.0, 4.4], atol=0.1)
    np.testing.assert_allclose(new.position, [2.0, 4.4], atol=0.1)
    assert gone.length == pytest.approx(0.3, abs=0.1)


def test_walls_that_are_not_seen_later_are_not_gone():
    hidden = np.concatenate([ROOM, HIDING])
    found = changes(drawn(ROOM, np.array([[4.0, 5.5, 0.2]])), drawn(hidden, seed=1))
    assert not found.gone
    assert max(new.length for new in found.new) > 6.0


def test_a_single_scan_is_not_enough():
    after = mapped(ROOM, way(1.0, 1.0, 1.4, 1.0, 1), seed=1)
    assert changes(drawn(np.concatenate([ROOM, WALL])), after) == ((), ())


def test_a_wall_that_is_only_seen_along_itself_is_not_gone():
    """Beams that graze it erase its cells from the later grid, and yet end on it farther on."""
    far = np.concatenate([way(0.5, 5.8, 1.0, 5.8, 3), way(7.5, 5.75, 7.0, 5.75, 3)])
    one, other = mapped(ROOM, DRIVE), mapped(ROOM, far, seed=1)
    assert changes(one, other).gone == ()


def test_scans_that_are_not_placed_see_through_nothing():
    before, after = mapped(np.concatenate([ROOM, WALL]), DRIVE), mapped(ROOM, DRIVE, seed=1)
    rows = after.keyframes
    lost = replace(after, keyframes=replace(rows, placed=np.zeros(len(rows), bool)))
    assert changes(before, lost) == ((), ())
