"""Places are found exactly, whatever the guess; what is not one place is refused."""

import math

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.numeric import wrapped
from tests.recognition.plans import (
    CORRIDOR,
    OFFICE,
    QUERY_CELL,
    REFERENCE_CELL,
    moved,
    place,
    walls,
    way,
)

from impslam.geometry.se2 import between, compose
from impslam.recognition.correlative import Window
from impslam.recognition.places import Recogniser
from impslam.recognition.verify import ClosureStrength

THERE, BACK = way(-6.0, -0.3, 5.0, -0.2, 12), way(1.5, 0.2, -0.5, 0.1, 5)
REFERENCE = place(OFFICE, THERE, THERE[6], REFERENCE_CELL)
QUERY = place(OFFICE, BACK, BACK[2], QUERY_CELL, seed=1)
TRUTH = between(THERE[6], BACK[2])


def assert_at(closure, truth, metres=0.02, radians=0.004):
    assert closure is not None
    x, y, heading = between(truth, closure.pose)
    assert math.hypot(x, y) < metres
    assert abs(heading) < radians


@pytest.mark.parametrize("size", [0.5, 1.2, 4.0, 8.0])
def test_the_pose_is_found_from_anywhere_in_the_window(size, rng):
    recogniser = Recogniser()
    for _ in range(20):
        half = np.array([size, size, min(0.1 * size, 0.5)])
        guess = TRUTH + half * rng.uniform(-0.75, 0.75, 3)
        closure = recogniser.find_closure(REFERENCE, QUERY, guess, Window(*half))
        assert_at(closure, TRUTH)
        assert closure.verdict == ClosureStrength.STRONG
        assert np.linalg.eigvalsh(closure.information)[0] > 0.0


def test_the_pose_is_found_without_any_guess():
    closure = Recogniser().find_closure(REFERENCE, QUERY, np.zeros(3), Window(15.0, 8.0, math.pi))
    assert_at(closure, TRUTH)


def test_frames_do_not_matter(rng):
    for _ in range(5):
        T, U = (rng.uniform([-30, -30, -3], [30, 30, 3]) for _ in range(2))
        truth = compose(compose(T, TRUTH), np.zeros(3))
        reference = moved(REFERENCE, T)
        query = moved(QUERY, np.array([0.0, 0.0, U[2]]))
        truth = compose(truth, np.array([0.0, 0.0, -U[2]]))
        guess = truth + np.array([1.0, -0.8, 0.1])
        assert_at(Recogniser().find_closure(reference, query, guess, Window(2.0, 2.0, 0.3)), truth)


def test_a_corridor_fixes_the_heading_and_the_position_across_it():
    there, back = way(-3.0, 0.0, 3.0, 0.0, 8), way(1.0, 0.1, -1.0, 0.1, 5)
    reference = place(CORRIDOR, there, there[4], REFERENCE_CELL)
    query = place(CORRIDOR, back, back[2], QUERY_CELL, seed=1)
    recogniser = Recogniser()
    truth = between(there[4], back[2])
    guess = truth + np.array([1.0, 0.3, 0.05])
    closure = recogniser.find_closure(reference, query, guess, Window(4.0, 4.0, 0.3))
    assert not closure.has_position
    assert np.abs(wrapped(closure.pose - truth, 2))[1:].max() < 0.01
    sigma = np.sqrt(np.diagonal(np.linalg.inv(closure.information)))
    assert sigma[0] > 3.9
    assert sigma[1:].max() < 0.03


def test_an_aisle_is_not_moved_through_its_shelf():
    """The next aisle is 4.2 m away. Moved by the depth of the shelf, its back would be its front."""
    shelves = [
        room(x, x + 10.0, y, y + 1.15) for x in (-3.4, 9.7) for y in (-6.85, -2.65, 1.55, 5.75)
    ]
    shop = np.concatenate([walls([-8.5, -20, -8.5, 20]), *shelves])
    there, back = way(-5.0, 0.0, 7.0, 0.0, 16), way(1.0, 4.2, -3.0, 4.2, 9)
    reference = place(shop, there, there[8], REFERENCE_CELL)
    query = place(shop, back, back[4], QUERY_CELL, seed=1)
    truth, recogniser = between(there[8], back[4]), Recogniser()
    for off in (0.0, 0.4, -0.4):
        guess = truth + np.array([off, off, 0.0])
        closure = recogniser.find_closure(reference, query, guess, Window(2.4, 2.4, 0.4))
        if closure is not None:
            assert_at(closure, truth, metres=0.3)


def test_a_corridor_leaves_open_where_along_it():
    there, back = way(-3.0, 0.0, 3.0, 0.0, 8), way(1.0, 0.1, -1.0, 0.1, 5)
    reference = place(CORRIDOR, there, there[4], REFERENCE_CELL)
    query = place(CORRIDOR, back, back[2], QUERY_CELL, seed=1)
    truth = between(there[4], back[2])
    closure = Recogniser().find_closure(reference, query, truth, Window(0.4, 0.4, 0.1))
    along, across = closure.information[0, 0], closure.information[1, 1]
    assert across > 100.0 * along


def test_a_place_that_looks_partly_alike_is_refused():
    """The same room, but for a wall where the query saw free space."""
    divided = np.concatenate([OFFICE, walls([0.3, -1.5, 0.3, 1.0], [-2.5, -1.5, -2.5, 1.0])])
    there = way(-2.0, -0.3, 0.0, -0.2, 6)
    reference = place(divided, there, there[3], REFERENCE_CELL)
    recogniser = Recogniser()
    truth = between(there[3], BACK[2])
    for size in (0.4, 2.0):
        assert recogniser.find_closure(reference, QUERY, truth, Window(size, size, 0.2)) is None
    assert recogniser.counts["contradicted"] + recogniser.counts["no peak"] == 2


AISLES = np.concatenate([room(-4.0, 4.0, -1.0, 1.0), room(-4.0, 4.0, 2.0, 4.0)])


def test_the_next_aisle_is_not_the_one_that_looks_alike():
    """Shelves 3 m apart: what the query shows is where the robot believes to be."""
    here, beside = way(-3.0, 0.0, 3.0, 0.0, 8), way(-1.0, 3.0, 1.0, 3.0, 5)
    reference = place(AISLES, here, here[6], REFERENCE_CELL)
    query = place(AISLES, beside, beside[2], QUERY_CELL, seed=1)
    truth = between(here[6], beside[2])
    recogniser = Recogniser()
    assert recogniser.find_closure(reference, query, truth, Window(3.2, 3.2, 0.3)) is None
    assert recogniser.counts["unlikely"] == 1
    alike = truth - np.array([0.0, 3.0, 0.0])
    assert_at(recogniser.find_closure(reference, query, alike, Window(1.0, 1.0, 0.3)), alike, 0.05)


def test_a_place_beyond_three_sigma_is_found_if_the_guess_is_contradicted():
    closure = Recogniser().find_closure(
        REFERENCE, QUERY, TRUTH + np.array([0.0, 2.7, 0.0]), Window(3.0, 3.0, 0.3)
    )
    assert_at(closure, TRUTH)


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_a_true_place_half_hidden_is_found(size):
    """People stand around the robot, and the reference was seen from the other end."""
    people = np.array([[0.9, 0.9, 0.2], [0.6, -0.7, 0.2], [-0.4, 0.8, 0.15], [1.9, -0.9, 0.25]])
    query = place(OFFICE, BACK, BACK[2], QUERY_CELL, circles=people, seed=2)
    there = way(-5.0, -0.3, 0.0, -0.2, 8)
    reference = place(OFFICE, there, there[5], REFERENCE_CELL)
    truth = between(there[5], BACK[2])
    guess = truth + 0.5 * np.array([size, -size, 0.1])
    closure = Recogniser().find_closure(reference, query, guess, Window(size, size, 0.2))
    assert_at(closure, truth, 0.03, 0.006)


def test_results_are_the_same_to_the_byte_whatever_came_before(rng):
    used = Recogniser()
    for _ in range(3):
        guess = TRUTH + rng.uniform(-1.0, 1.0, 3) * [2.0, 2.0, 0.2]
        window = Window(2.5, 2.5, 0.3)
        used.find_closure(moved(REFERENCE, rng.normal(size=3)), QUERY, guess, window)
        contradicted = used.contradiction(REFERENCE, QUERY, guess)
        assert contradicted == Recogniser().contradiction(REFERENCE, QUERY, guess)
        used.find_closure(moved(REFERENCE, rng.normal(size=3)), QUERY, guess, window)
        first = used.find_closure(REFERENCE, QUERY, guess, window)
        again = Recogniser().find_closure(REFERENCE, QUERY, guess, window)
        assert first.pose.tobytes() == again.pose.tobytes()
        assert first.information.tobytes() == again.information.tobytes()
        assert (first.support, first.score) == (again.support, again.score)


def test_too_few_points_are_counted():
    recogniser = Recogniser()
    few = QUERY._replace(features=QUERY.features[:59].copy())
    assert recogniser.find_closure(REFERENCE, few, TRUTH, Window(1.0, 1.0, 0.1)) is None
    assert recogniser.counts["attempts"] == recogniser.counts["too few points"] == 1


def test_errors_are_no_larger_than_the_information_says():
    recogniser, d2 = Recogniser(), []
    for seed in range(30):
        query = place(OFFICE, BACK, BACK[2], QUERY_CELL, noise=0.02, seed=seed)
        closure = recogniser.find_closure(REFERENCE, query, TRUTH, Window(0.3, 0.3, 0.1))
        error = closure.pose - TRUTH
        d2.append(error @ closure.information @ error)
    assert np.mean(d2) < 3.0


def test_information_turns_with_the_reference(rng):
    guess, window = TRUTH + np.array([0.1, -0.1, 0.03]), Window(0.3, 0.3, 0.1)
    closure = Recogniser().find_closure(REFERENCE, QUERY, guess, window)
    T = rng.uniform([-30.0, -30.0, -3.0], [30.0, 30.0, 3.0])
    c, s = np.cos(T[2]), np.sin(T[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    turned = Recogniser().find_closure(moved(REFERENCE, T), QUERY, compose(T, guess), window)
    assert_at(turned, compose(T, closure.pose), 0.01, 0.002)
    expected = turn @ closure.information @ turn.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(turned.information / scale, expected / scale, atol=0.15)
