"""What every estimator keeps, whatever it estimates with."""

from dataclasses import replace

import numpy as np
import pytest
from tests.filters.worlds import CYLINDERS, MODELS, drive, observe
from tests.numeric import wrapped

from impslam.component import build, components
from impslam.geometry.se2 import compose
from impslam.map import Keyframe
from impslam.types import Increment

PARTS = {"filter": "riekf", "association": "known", "lifecycle": "immediate"}
"""Parts that are exact: what is seen is known at once, by its label."""

LANDMARKS_WHEN_ASKED = {"graph", "grid_particles", "hypotheses"}
"""Estimators whose revisions list no landmarks."""

NONE = 1e-16
"""Told as the noise of exact data, for estimators that draw at random."""


@pytest.fixture(params=sorted(components("estimator")))
def make(request):
    """Return what makes an estimator that starts at a pose."""
    if library := components("estimator")[request.param].library:
        pytest.importorskip(library)

    def begin(pose=(0.0, 0.0, 0.0)):
        made = build("estimator", {"kind": request.param})
        parts = {role: build(role, {"kind": PARTS[role]}) for role in made.parts}
        made.start(np.array(pose), models=MODELS, **parts)
        return made

    return begin


def keyframe(k, motion, seen=()):
    none = np.zeros((3, 3))
    return Keyframe(
        k, motion.stamp, motion, none[0], none[0], none, None, 0, observations=tuple(seen)
    )


def run(made, steps=40, rng=None, told=1.0):
    """Return the true poses and the revisions of a drive; `told` is what variances are multiplied by."""
    poses, revisions = [], []
    for k, (pose, motion) in enumerate(drive(steps, rng)):
        poses.append(pose)
        moved = replace(motion, covariance=told * motion.covariance)
        seen = [o.with_noise(told * o.R) for o in observe(pose, rng)]
        revisions.append(made.add(keyframe(k, moved, seen)))
    return poses, revisions


def newest(revision, k):
    """Return the pose and covariance that a revision gives its own keyframe."""
    assert revision.ids[-1] == k
    return revision.poses[-1], revision.covariances[-1]


def told(revision):
    arrays = [revision.ids, revision.poses, revision.covariances]
    return [a.tobytes() for a in arrays] + [revision.added, revision.origins, revision.removed]


def test_a_drive_without_noise_is_exact(make):
    made = make()
    poses, revisions = run(made, told=NONE)
    for k, (pose, revision) in enumerate(zip(poses, revisions, strict=True)):
        assert revision.refused == ""
        assert np.abs(wrapped(newest(revision, k)[0] - pose, 2)).max() < 1e-9
    points = [m.position for m in made.landmarks() if m.kind == "cylinder"]
    for centre in CYLINDERS:
        assert np.abs(np.array(points) - centre).max(axis=1).min() < 1e-9


def test_the_joint_covariance_is_that_of_the_landmarks_in_their_order(make):
    made = make()
    run(made, 12, np.random.default_rng(4))
    for _ in ("before refining", "after it"):
        joint, found = made.landmark_covariance(), made.landmarks()
        assert [mark.id for mark in found] == sorted(mark.id for mark in found)
        assert joint.shape in {(0, 0), (2 * len(found),) * 2}
        for k in range(len(joint) // 2):
            own = slice(2 * k, 2 * k + 2)
            np.testing.assert_allclose(joint[own, own], found[k].covariance, rtol=1e-9, atol=1e-15)
        assert len(joint) or made.name not in {"landmarks", "hypotheses"}
        made.refine()


def test_landmarks_have_mean_attributes_without_a_heading_in_base_link(make):
    made = make()
    for k, (pose, motion) in enumerate(drive(8)):
        attributes = {"radius": 0.1 + 0.01 * (k % 2), "heading": 3.0}
        seen = [replace(o, attributes=attributes) for o in observe(pose)]
        made.add(keyframe(k, motion, seen))
    for mark in made.landmarks():
        assert "heading" not in mark.parameters
        assert mark.parameters["radius"] == pytest.approx(0.105)


def test_it_starts_at_the_given_pose(make):
    start = np.array([3.0, -2.0, 2.5])
    poses, revisions = run(make(start), 10, told=NONE)
    for k, (pose, revision) in enumerate(zip(poses, revisions, strict=True)):
        expected = compose(start, pose)
        assert np.abs(wrapped(newest(revision, k)[0] - expected, 2)).max() < 1e-9


def test_a_revision_has_a_pose_and_a_covariance_for_each_keyframe_and_the_same_bytes_again(make):
    runs = [make(), make()]
    one, two = (run(made, 20, np.random.default_rng(2))[1] for made in runs)
    for k, revision in enumerate(one):
        m = len(revision.ids)
        assert revision.ids.dtype == np.int64
        assert (np.diff(revision.ids) > 0).all()
        assert revision.ids[0] >= 0
        assert revision.ids[-1] == k
        assert revision.poses.shape == (m, 3)
        assert revision.covariances.shape == (m, 3, 3)
        for P in revision.covariances:
            np.testing.assert_allclose(P, P.T, atol=1e-15)
            assert np.linalg.eigvalsh(P)[0] > 0.0
    assert [told(r) for r in one] == [told(r) for r in two]
    for a, b in zip(*(made.landmarks() for made in runs), strict=True):
        assert a.position.tobytes() == b.position.tobytes()


def test_landmarks_are_those_that_were_born_and_are_not_gone(make):
    made, known, size = make(), set(), 0
    if made.name in LANDMARKS_WHEN_ASKED:
        pytest.skip("it tells of landmarks only when asked")
    rng = np.random.default_rng(3)
    for k, (pose, motion) in enumerate(drive(30, rng)):
        seen = observe(pose, rng)[: 2 + k // 3]
        revision = made.add(keyframe(k, motion, seen))
        assert known.isdisjoint(revision.added)
        assert len(revision.origins) == len(revision.added)
        assert all(0 <= origin < len(seen) for origin in revision.origins)
        assert set(revision.removed) <= known | set(revision.added)
        assert {m.landmark for m in revision.matches} <= known
        known = (known | set(revision.added)) - set(revision.removed)
        assert {mark.id for mark in made.landmarks()} == known
        assert made.state_size >= size or revision.removed
        size = made.state_size
    assert len(known) == 9


BAD = {
    "z is not a number": lambda o: replace(o, z=np.full_like(o.z, np.nan)),
    "R is not a number": lambda o: replace(o, R=np.full_like(o.R, np.nan)),
    "R is infinite": lambda o: replace(o, R=np.full_like(o.R, np.inf)),
    "R is no covariance": lambda o: replace(o, R=-np.eye(len(o.z))),
    "R is singular": lambda o: replace(o, R=np.zeros_like(o.R)),
    "R lacks the shared error": lambda o: replace(o, shared=np.ones_like(o.z), sensor="lidar"),
    "R is indefinite": lambda o: replace(o, R=np.ones_like(o.R) - 0.5 * np.eye(len(o.z))),
}


def test_a_keyframe_that_cannot_be_used_moves_the_robot_and_nothing_else(make):
    """It goes on as a twin does that was shown the motion alone."""
    made, twin, k = make(), make(), 12
    rng, again = np.random.default_rng(4), np.random.default_rng(4)
    *_, pose = run(made, k, rng)[0]
    run(twin, k, again)
    P = np.diag([0.02, 0.01, 0.02]) ** 2
    for name, spoil in BAD.items():
        for is_bad in (True, False, False):
            motion = Increment(k + 1.0, np.array([0.3, 0.0, 0.15]), P, 1.0)
            pose = compose(pose, motion.d_pose)
            seen = observe(pose)
            if is_bad:
                revision = made.add(keyframe(k, motion, (spoil(seen[0]), *seen[1:])))
                by_motion = twin.add(keyframe(k, motion))
                assert "\n" not in revision.refused, name
                assert f"{k + 1}.000 s" in revision.refused, name
                assert revision.matches == revision.added == revision.removed == (), name
                np.testing.assert_array_equal(revision.poses, by_motion.poses, name)
                np.testing.assert_array_equal(revision.covariances, by_motion.covariances, name)
            else:
                later = keyframe(k, motion, seen)
                assert told(made.add(later)) == told(twin.add(later)), name
            k += 1


def test_a_keyframe_without_a_finite_motion_changes_no_landmark(make):
    made, twin = make(), make()
    run(made, 12)
    run(twin, 12)
    lost = (0.0, np.nan), (np.nan, 1e-4), (np.inf, 1e-4), (np.nan, np.nan)
    for k, (d_pose, P) in enumerate(lost, 12):
        motion = Increment(k + 1.0, np.full(3, d_pose), P * np.eye(3), 1.0)
        assert "not finite" in made.add(keyframe(k, motion)).refused
        for a, b in zip(made.landmarks(), twin.landmarks(), strict=True):
            np.testing.assert_array_equal(a.position, b.position)
            np.testing.assert_array_equal(a.covariance, b.covariance)


def test_nothing_given_is_changed(make):
    made = make()
    run(made, 5)
    ((pose, motion),) = drive(1)
    seen = observe(pose)
    before = [a.copy() for o in seen for a in (o.z, o.R)] + [motion.d_pose.copy()]
    made.add(keyframe(5, motion, seen))
    after = [a for o in seen for a in (o.z, o.R)] + [motion.d_pose]
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_revision_does_not_change_later(make):
    made = make()
    _, revisions = run(made, 5)
    before = [told(revision) for revision in revisions]
    run(made, 10)
    assert [told(revision) for revision in revisions] == before
